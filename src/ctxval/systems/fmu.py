"""A functional mock-up unit (FMU), which Simulink, Modelica tools and others export, as the true system."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import PositiveInt, require_known
from ctxval._util.files import require_regular_file
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.registry import part
from ctxval.core.controller import Controller
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.errors import ExecutionError, InputError
from ctxval.systems.episode import require_one, require_started, run_episode
from ctxval.systems.subprocess import signal_name

_PROGRAM = Path(__file__).with_name("fmu_process.py")


@part(files=("source",))
class FMU:
    """An FMU for co-simulation, FMI 2 or 3, as the true system.

    Every execution has its own instance: parameters and the initial state are set as start values, inputs are held
    over a step, and the instance is freed however the execution ends. An FMU contains machine code. It runs in a
    separate process, which is kept for the next execution; if the FMU crashes this process, the execution has failed.

    Args:
        source: the ``.fmu`` file.
        states, inputs: the variables that make up the state, and the inputs, with their units; all are real numbers.
        start: the variable whose start value sets a state, by the name of the state; by default its own variable. A
            state that the FMU calculates (``initial="calculated"``) often needs one, such as ``{"T": "T_start"}``.
        parameters: values of other variables, set before the initialisation.
        substeps: number of communication steps in one control step.

    Raises:
        InputError: if there are no states, or if a variable is missing.
    """

    def __init__(
        self,
        source: str | Path,
        *,
        states: Mapping[str, str],
        inputs: Mapping[str, str],
        start: Mapping[str, str] | None = None,
        parameters: Mapping[str, float | int | bool | str] | None = None,
        substeps: PositiveInt = 1,
    ) -> None:
        self.path = Path(source).absolute()
        self.states, self.inputs = dict(states), dict(inputs)
        if not self.states:
            raise InputError("states must be names of variables with their units, got none.")
        self.start = {name: name for name in self.states} | dict(start or {})
        self.parameters, self.substeps = dict(parameters or {}), substeps
        self._open()

    def _open(self) -> None:
        """Unpack the file and look up the variables; a copy of this object in another process does so again."""
        self._description, self._unpacked = _unpacked(self.path)
        # The key is the process that started them, because a fork of it must not use the same ones.
        self._idle: dict[int, list[_Process]] = {}
        weakref.finalize(self, _clean, self._idle, self._unpacked, os.getpid())
        self._digest = hashlib.sha256(self.path.read_bytes()).hexdigest()[:16]
        known = {variable.name: variable for variable in self._description.modelVariables}
        require_known("state", self.start, self.states)
        named = (*self.states, *self.inputs, *self.start.values(), *self.parameters)
        require_known("variable of the FMU", named, known)
        start = [self.start[name] for name in self.states]
        _references(known, start)
        for what, variables in (
            ("start", [name for name in start if name not in self.states]),
            ("parameters", self.parameters),
        ):
            if fixed := [name for name in variables if not _has_start(known[name])]:
                raise InputError(f"{what} must name variables with a start value, got {_told(known[fixed[0]])}.")
        if read := [name for name in self.inputs if not _is_input(known[name])]:
            raise InputError(f"inputs must name inputs or tunable parameters of the FMU, got {_told(known[read[0]])}.")
        self._calculated = [i for i, name in enumerate(self.states) if not _has_start(known[name])]
        self._candidates = [each.name for each in known.values() if each.causality == "parameter" and _has_start(each)]
        references = {"states": _references(known, self.states), "inputs": _references(known, self.inputs)}
        file = {"folder": self._unpacked, "name": self.path.name}
        self._setup = file | references | {"start": start, "parameters": self.parameters}
        try:
            with self._process() as process:
                process.ask("begin", [], 0.0, 1)
                process.ask("free")
        except _CrashError as crash:
            raise InputError(f"{self.path.name}: {crash} when it was initialised.") from crash
        except ExecutionError as error:
            raise InputError(str(error)) from error

    def describe(self) -> dict[str, Any]:
        fields = ("states", "inputs", "start", "parameters", "substeps")
        return {"fmu": self._digest, **{name: getattr(self, name) for name in fields}}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        require_one(task)
        with self._process() as process:
            self._start(process, task)
            trajectory = run_episode(process.advance, controller, task, len(self.inputs))
            process.sound = trajectory.ended == COMPLETE
            with contextlib.suppress(_CrashError):  # the execution is over
                process.ask("free")
            return trajectory

    def _start(self, process: _Process, task: Task) -> None:
        """Start an instance in the task's initial state.

        A state that is calculated by the description of the FMU may have no start value, and many FMUs calculate it in
        their first step only. So a very short step of another instance shows where such a state starts.
        """
        values: list[float | None] = task.initial_state.tolist()
        names, step = list(self.states), task.dt / self.substeps
        shown = list[float]()
        if self._calculated and len(values) == len(self.states):
            try:
                process.ask("begin", values, 1e-9 * step, 1)
            except InputError:  # the FMU refuses start values that its description does not have
                process.ask("free")
                own = [i for i in self._calculated if self.start[names[i]] == names[i]]
                values = [None if i in own else value for i, value in enumerate(values)]
                process.ask("begin", values, 1e-9 * step, 1)
            shown = process.ask("advance", [])[0] or []
            process.ask("free")
        state = process.ask("begin", values, step, self.substeps)
        for i in self._calculated if shown else ():
            state[i] = shown[i]
        try:
            require_started(task, np.array(state))
        except InputError as error:
            if not shown:
                raise
            hidden = ", ".join(names[i] for i in self._calculated)
            advice = (
                f"the FMU calculates {hidden}, and `start` names the parameters that set them: {self._candidates[:20]}"
            )
            raise InputError(f"{str(error).removesuffix('.')}; {advice}.") from error

    @contextlib.contextmanager
    def _process(self) -> Iterator[_Process]:
        idle = self._idle.setdefault(os.getpid(), [])
        try:
            process = idle.pop()
        except IndexError:
            process = _Process(self._setup)
        ended = False
        try:
            yield process
            ended = True
        finally:
            if ended and process.sound:
                idle.append(process)
            else:
                process.end()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._open()


class _CrashError(ExecutionError):
    """The FMU has crashed its process."""


class _Process:
    """The process that runs an FMU (:mod:`ctxval.systems.fmu_process`); if it is sound, it can be used again."""

    def __init__(self, setup: Mapping[str, Any]) -> None:
        path = os.pathsep.join(entry for entry in sys.path if entry)
        self.sound, self.size = True, len(setup["states"])
        # -P, because modules in the folder of the program have the same names as other modules. A session of its own,
        # because Ctrl-C is for the campaign, which ends after the running executions.
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_PROGRAM), str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            encoding="utf-8",
            env={**os.environ, "PYTHONPATH": path},
            start_new_session=True,
        )
        self._send(setup)

    def _send(self, message: Any) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # the process has crashed, which reading the answer reports
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def ask(self, act: str, *arguments: Any) -> Any:
        assert self._process.stdout is not None
        self._send([act, *arguments])
        line = self._process.stdout.readline()
        if not line.endswith("\n"):
            self.sound = False
            status = self._process.wait()
            how = signal_name(-status) if status < 0 else f"status {status}"
            raise _CrashError(f"the FMU crashed its process ({how})")
        answer = json.loads(line)
        if "refused" in answer:
            raise (InputError if answer["input"] else ExecutionError)(answer["refused"])
        return answer["value"]

    def advance(self, u: Array) -> tuple[Array, str]:
        """Hold the inputs over one control step; return the state, and the reason if the step failed."""
        try:
            state, reason = self.ask("advance", u.tolist())
        except _CrashError as crash:
            state, reason = None, str(crash)
        return np.full(self.size, np.nan) if state is None else np.array(state), reason

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()


def _clean(idle: dict[int, list[_Process]], unpacked: str, owner: int) -> None:
    for process in idle.pop(os.getpid(), []):
        process.end()
    if os.getpid() == owner:  # not in a fork of the process that unpacked the file
        shutil.rmtree(unpacked, ignore_errors=True)


def _unpacked(path: Path) -> tuple[Any, str]:
    fmpy = require_extra("fmpy", "fmu", "FMUs need")
    # Errors of many kinds: no file, not a zip, not XML, not valid by the schema.
    with reworded(f"{path} cannot be read as an FMU", Exception):
        require_regular_file(path)
        description = fmpy.read_model_description(str(path))
    if description.coSimulation is None or not description.fmiVersion.startswith(("2", "3")):
        got = f"FMI {description.fmiVersion}{'' if description.coSimulation else ' without co-simulation'}"
        raise InputError(f"{path} must be an FMU for co-simulation, FMI 2 or 3, got {got}.")
    folder = tempfile.mkdtemp(prefix="ctxval-")
    with ExitStack() as stack, reworded(f"{path} cannot be unpacked", Exception):
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        fmpy.extract(str(path), folder)
        stack.pop_all()
    return description, folder


def _has_start(variable: Any) -> bool:
    """Return whether the description of an FMU gives a variable a start value that may be set."""
    return bool(variable.variability != "constant" and variable.initial in ("exact", "approx"))


def _is_input(variable: Any) -> bool:
    kinds = variable.causality, variable.variability
    return kinds[0] == "input" or kinds == ("parameter", "tunable")


def _told(variable: Any) -> str:
    return f"{variable.name} (causality {variable.causality}, {variable.variability}, initial {variable.initial})"


def _references(known: Mapping[str, Any], names: Iterable[str]) -> list[int]:
    for name in names:
        variable = known[name]
        if variable.type not in ("Real", "Float64") or variable.dimensions:
            kind = f"{variable.type}{' array' if variable.dimensions else ''}"
            raise InputError(f"the FMU's variable {name!r} must be one real number, it is of type {kind}.")
    return [known[name].valueReference for name in names]
