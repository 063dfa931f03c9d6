"""A functional mock-up unit (FMU), as Simulink, Modelica tools and others export them, as the true system."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctxval.arrays import Array
from ctxval.controller import Controller
from ctxval.errors import ExecutionError, InputError, UnknownNameError
from ctxval.systems.episode import require_one, require_started, run_episode
from ctxval.task import Task
from ctxval.trajectory import Trajectory

_LOADING = threading.Lock()
"""FMPy changes the working directory while it loads a library."""


class FMU:
    """An FMU for co-simulation, FMI 2 or 3, as the true system.

    Every execution has an instance of its own: parameters and the initial state are set as start values, inputs are
    held over a step, and the instance is freed however the execution ends. An FMU holds machine code, which runs.

    Args:
        path: the ``.fmu`` file.
        states: names of the variables that are the state, real numbers.
        inputs: names of the input variables, real numbers.
        start: for a state's name the variable whose start value sets it; the state's own variable by default.
        parameters: values of other variables, set before the initialisation.
        step: the communication step size, seconds; a task's dt must be a whole multiple of it, and is it by default.

    Raises:
        InputError: FMPy is not installed, or the file is no FMU that can be used.
        UnknownNameError: the FMU has no variable of that name.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        states: Sequence[str],
        inputs: Sequence[str],
        start: Mapping[str, str] | None = None,
        parameters: Mapping[str, float | int | bool | str] | None = None,
        step: float | None = None,
    ) -> None:
        self.path = Path(path).absolute()
        self.states, self.inputs = _names("states", states), _names("inputs", inputs)
        self.start = {name: name for name in self.states} | dict(start or {})
        self.parameters = dict(parameters or {})
        if step is not None and not (np.isfinite(step) and step > 0):
            raise InputError(f"step must be a positive number of seconds, got {step!r}.")
        self.step = step
        self._open()

    def _open(self) -> None:
        """Unpack the file and look up the variables, here and again in another process."""
        self._description, self._folder = _unpacked(self.path)
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._digest = hashlib.sha256(self.path.read_bytes()).hexdigest()[:16]
        known = {variable.name: variable for variable in self._description.modelVariables}
        foreign = sorted(set(self.start) - set(self.states))
        if foreign:
            raise UnknownNameError.among("state", foreign[0], self.states)
        for name in (*self.states, *self.inputs, *self.start.values(), *self.parameters):
            if name not in known:
                raise UnknownNameError.among("variable of the FMU", name, known)
        self._outputs = _references(known, self.states)
        self._inputs = _references(known, self.inputs)
        self._starts = _references(known, [self.start[name] for name in self.states])
        self._parameters = [(known[name], value) for name, value in self.parameters.items()]
        try:
            with self._instance() as instance:
                instance.initialise()
        except ExecutionError as error:
            raise InputError(str(error)) from error

    def describe(self) -> dict[str, Any]:
        """Return what identifies this system in a store."""
        fields = ("states", "inputs", "start", "parameters", "step")
        return {"fmu": self._digest, **{name: getattr(self, name) for name in fields}}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the task's initial state over its horizon.

        Raises:
            InputError: the task's dt is no multiple of the step, or the initial state cannot be set.
            ShapeError: states or inputs are not as many as the names.
            ExecutionError: the FMU refuses to start.
        """
        require_one(task)
        substeps = self._substeps(task)
        with self._instance() as instance:
            instance.set_start(task.initial_state)
            instance.initialise()
            require_started(task, instance.state())
            instance.substeps, instance.step = substeps, task.dt / substeps
            return run_episode(instance.advance, controller, task, len(self.inputs))

    def _substeps(self, task: Task) -> int:
        ratio = 1.0 if self.step is None else task.dt / self.step
        if ratio < 0.5 or not np.isclose(ratio, round(ratio), rtol=1e-9, atol=0):
            raise InputError(f"the task's dt must be a whole multiple of the step {self.step:g} s, got {task.dt:g} s.")
        return round(ratio)

    @contextlib.contextmanager
    def _instance(self) -> Iterator[_Instance]:
        from fmpy.simulation import instantiate_fmu

        try:
            with _LOADING:
                fmu = instantiate_fmu(self._folder, self._description, fmi_type="CoSimulation")
        except Exception as error:  # FMPy raises Exception itself
            raise ExecutionError(f"the FMU {self.path.name} cannot be instantiated: {error}") from error
        instance = _Instance(self, fmu)
        try:
            yield instance
        finally:
            instance.free()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._open()


class _Instance:
    """One simulation, and what FMI 2 and 3 call differently."""

    def __init__(self, system: FMU, fmu: Any) -> None:
        self.system, self.fmu = system, fmu
        self.is_fmi3 = system._description.fmiVersion.startswith("3")
        self.step, self.substeps, self.steps = 0.0, 1, 0
        self.set = fmu.setFloat64 if self.is_fmi3 else fmu.setReal
        self.get = fmu.getFloat64 if self.is_fmi3 else fmu.getReal
        self.initialised = False

    def set_start(self, x: Array) -> None:
        starts = self.system._starts
        if len(x) != len(starts):
            return  # require_started says so
        try:
            self.set(starts, x.tolist())
        except Exception as error:
            names = ", ".join(self.system.start.values())
            raise InputError(f"the FMU does not let the start values of {names} be set: {error}") from error

    def initialise(self) -> None:
        try:
            for variable, value in self.system._parameters:
                _set_parameter(self.fmu, variable, value)
            if not self.is_fmi3:
                self.fmu.setupExperiment(startTime=0.0)
            self.fmu.enterInitializationMode()
            self.fmu.exitInitializationMode()
        except Exception as error:
            raise ExecutionError(f"the FMU {self.system.path.name} cannot be initialised: {error}") from error
        self.initialised = True

    def state(self) -> Array:
        return np.array(self.get(self.system._outputs), dtype=np.float64)

    def advance(self, u: Array) -> tuple[Array, str]:
        """Hold the inputs over one control step; return the state, and why it failed if it did."""
        nothing = np.full(len(self.system.states), np.nan)
        try:
            if len(u):
                self.set(self.system._inputs, u.tolist())
            for _ in range(self.substeps):
                # A product, not a sum: the time of a long run is exact.
                ended = self.fmu.doStep(self.steps * self.step, self.step)
                self.steps += 1
                if ended is not None and ended[1]:
                    return nothing, "the FMU terminated the simulation"
            return self.state(), ""
        except Exception as error:
            return nothing, f"the FMU failed ({error})"

    def free(self) -> None:
        if self.initialised:
            with contextlib.suppress(Exception):  # it may have failed before
                self.fmu.terminate()
        with contextlib.suppress(Exception):
            self.fmu.freeInstance()


def _unpacked(path: Path) -> tuple[Any, str]:
    """Return the model description and a new folder with the FMU's content."""
    try:
        import fmpy
    except ImportError as error:
        raise InputError('FMPy is not installed: pip install "ctxval[fmu]".') from error
    try:
        description = fmpy.read_model_description(str(path))
    except Exception as error:  # of many kinds: no file, no zip, no XML, not after the schema
        raise InputError(f"{path} cannot be read as an FMU: {error}") from error
    if description.coSimulation is None or not description.fmiVersion.startswith(("2", "3")):
        raise InputError(
            f"{path} must be an FMU for co-simulation, FMI 2 or 3; it is of FMI {description.fmiVersion}"
            f"{'' if description.coSimulation else ' without co-simulation'}."
        )
    folder = tempfile.mkdtemp(prefix="ctxval-fmu-")
    fmpy.extract(str(path), folder)
    return description, folder


def _names(what: str, names: Sequence[str]) -> tuple[str, ...]:
    listed = (names,) if isinstance(names, str) else tuple(names)
    if len(set(listed)) != len(listed) or (what == "states" and not listed):
        raise InputError(f"{what} must be the names of different variables, got {list(listed)}.")
    return listed


def _references(known: Mapping[str, Any], names: Sequence[str]) -> list[int]:
    for name in names:
        variable = known[name]
        if variable.type not in ("Real", "Float64") or variable.dimensions:
            kind = f"{variable.type}{' array' if variable.dimensions else ''}"
            raise InputError(f"the FMU's variable {name!r} must be one real number, it is of type {kind}.")
    return [known[name].valueReference for name in names]


def _set_parameter(fmu: Any, variable: Any, value: Any) -> None:
    enumeration = "Int64" if hasattr(fmu, "setInt64") else "Integer"
    kind = enumeration if variable.type == "Enumeration" else variable.type
    getattr(fmu, f"set{kind}")([variable.valueReference], [value])
