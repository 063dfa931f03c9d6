"""The process in which an FMU runs and which it may crash; :mod:`ctxval.systems.fmu` starts this file as a program.

Each line of input is a request in JSON, with an action and its arguments; each line of output is its result in JSON.
Nothing of ctxval is imported, so that the process needs only the time of FMPy to start.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import IO, Any


class Refused(Exception):  # noqa: N818
    """The FMU refused a request; its arguments are a sentence, and whether the user's input is the cause."""


@contextlib.contextmanager
def refused(sentence: str, *, input_is_wrong: bool = False) -> Iterator[None]:
    """Turn an exception, of which FMPy raises the most general kind, into a refusal."""
    try:
        yield
    except Exception as error:
        raise Refused(f"{sentence}: {error}", input_is_wrong) from error


class Unit:
    """An unpacked FMU with one instance at a time; it hides the different names of FMI 2 and 3.

    States and inputs are value references; ``start`` are names of the variables whose start values set the state.
    """

    def __init__(
        self, folder: str, name: str, states: list[int], inputs: list[int], start: list[str], parameters: dict[str, Any]
    ) -> None:
        import fmpy

        self.folder, self.name, self.states, self.inputs, self.start = folder, name, states, inputs, start
        self.description = fmpy.read_model_description(folder)
        known = {variable.name: variable for variable in self.description.modelVariables}
        self.start_references = [known[variable].valueReference for variable in start]
        self.parameters = [(known[variable], value) for variable, value in parameters.items()]
        self.is_fmi3 = self.description.fmiVersion.startswith("3")
        self.fmu: Any = None
        self.initialised = False

    def begin(self, x: list[float | None], step: float, substeps: int) -> list[float]:
        """Start a simulation; start values that are None are the FMU's own. Return the state in which it starts."""
        from fmpy.simulation import instantiate_fmu

        self.steps, self.step, self.substeps = 0, step, substeps
        with refused(f"the FMU {self.name} cannot be instantiated"):
            self.fmu = instantiate_fmu(self.folder, self.description, fmi_type="CoSimulation")
        kind = "Float64" if self.is_fmi3 else "Real"
        self._set, self._get = (getattr(self.fmu, f"{act}{kind}") for act in ("set", "get"))
        # The campaign's process reports a wrong number of states.
        if len(x) == len(self.start) and (chosen := [i for i, value in enumerate(x) if value is not None]):
            what = f"the FMU does not let the start values of {', '.join(self.start[i] for i in chosen)} be set"
            with refused(what, input_is_wrong=True):
                self._set([self.start_references[i] for i in chosen], [x[i] for i in chosen])
        with refused(f"the FMU {self.name} cannot be initialised"):
            enumeration = "Int64" if hasattr(self.fmu, "setInt64") else "Integer"
            for variable, value in self.parameters:
                of_type = enumeration if variable.type == "Enumeration" else variable.type
                getattr(self.fmu, f"set{of_type}")([variable.valueReference], [value])
            if not self.is_fmi3:
                self.fmu.setupExperiment(startTime=0.0)
            self.fmu.enterInitializationMode()
            self.fmu.exitInitializationMode()
        self.initialised = True
        return self._state()

    def _state(self) -> list[float]:
        return [float(value) for value in self._get(self.states)]

    def advance(self, u: list[float]) -> tuple[list[float] | None, str]:
        """Hold the inputs over one control step; return the state, or None and the reason of the failure."""
        try:
            if u:
                self._set(self.inputs, u)
            for _ in range(self.substeps):
                # A product, not a sum, so that the time of a long simulation is exact.
                ended = self.fmu.doStep(self.steps * self.step, self.step)
                self.steps += 1
                if ended is not None and ended[1]:
                    return None, "terminated: the FMU ended the simulation"
            return self._state(), ""
        except Exception as error:
            return None, f"the FMU failed ({error})"

    def free(self) -> None:
        fmu, self.fmu = self.fmu, None
        if fmu is None:
            return
        if self.initialised:
            with contextlib.suppress(Exception):  # the FMU may have failed before
                fmu.terminate()
        self.initialised = False
        with contextlib.suppress(Exception):
            fmu.freeInstance()


def serve(requests: IO[str], answers: IO[str]) -> None:
    """Answer each request, until there are no more."""
    unit = Unit(**json.loads(requests.readline()))
    acts: dict[str, Callable[..., Any]] = {"begin": unit.begin, "advance": unit.advance, "free": unit.free}
    for line in requests:
        act, *arguments = json.loads(line)
        try:
            answer: dict[str, Any] = {"value": acts[act](*arguments)}
        except Refused as error:
            answer = dict(zip(("refused", "input"), error.args, strict=True))
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _watch(parent: int) -> None:
    """End this process when the campaign's process ends, even during a step that does not end."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def main() -> None:
    """Serve the process that started this one. What an FMU reads and prints is kept apart from requests and answers."""
    threading.Thread(target=_watch, args=(int(sys.argv[1]),), daemon=True).start()
    requests, answers = os.fdopen(os.dup(0), encoding="utf-8"), os.fdopen(os.dup(1), "w", encoding="utf-8")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    serve(requests, answers)
    # An FMU could still crash when it is unloaded, so the process ends without unloading it.
    os._exit(0)


if __name__ == "__main__":
    main()
