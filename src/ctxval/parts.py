"""The parts of an experiment by name, as experiment files give them; nothing in them is code but ``module:attr``."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.errors import PydanticUserError
from pydantic_core import SchemaError

from ctxval import controllers, distances, models, systems
from ctxval.errors import CtxvalError, InputError, ShapeError, UnknownNameError
from ctxval.files import read_bytes
from ctxval.npz import Archive
from ctxval.space import Parameters, TaskSpace
from ctxval.task import Task
from ctxval.texts import reason_of
from ctxval.trajectory import Trajectory, Transitions

_ROOMS: dict[str, tuple[ModuleType, tuple[str, ...]]] = {
    "system": (systems, ("FMU", "Function", "Gymnasium", "Manual", "MuJoCo", "Simulated", "Subprocess")),
    "model": (models, ("Function", "GaussianProcessModel", "Linear", "Onnx", "ScikitLearn", "state_space")),
    "synthesizer": (controllers, ("ILQR", "LQR", "MPC", "OnnxPolicy", "Policy", "StationaryLQR")),
    "distance": (distances, ("FinalState", "GoalError", "MeanDeviation", "WholeTrajectory")),
}


def part(kind: str, given: str | Mapping[str, Any]) -> Any:
    """Return a system, model, synthesizer or distance.

    Args:
        kind: which of them.
        given: ``module:attr``; or a table with ``type``, a built-in name or ``module:attr``, and its arguments. An
            argument ``{ref = "module:attr"}`` is what that names. A model with ``data``, files of trajectories, is
            learned from them.

    Raises:
        UnknownNameError: there is no such part, or it takes no such argument.
        InputError: it cannot be made so; the message says why.
    """
    table = {"type": given} if isinstance(given, str) else dict(given)
    name = table.pop("type", None)
    if not isinstance(name, str):
        raise InputError(f"[{kind}] needs a type, such as {_ROOMS[kind][1][0]!r} or 'module:attr'.")
    arguments = {key: argument(value) for key, value in table.items()}
    build = _named(kind, name)
    if ":" in name and not isinstance(build, type) and not _is_maker(build, arguments):
        return build
    if kind == "model" and "data" in arguments and hasattr(build, "fit"):
        build, arguments = build.fit, {**arguments, "data": recorded(arguments["data"])}
    return made(f"the {kind} {name}", build, arguments)


def _is_maker(found: Any, arguments: Mapping[str, Any]) -> bool:
    """Return whether what a reference names makes the part, and is not the part itself."""
    return inspect.isfunction(found) and bool(arguments)


def _named(kind: str, name: str) -> Any:
    room, names = _ROOMS[kind]
    if ":" in name:
        return reference(name)
    if name not in names:
        raise UnknownNameError.among(kind, name, names)
    return getattr(room, name)


def made(what: str, build: Any, arguments: Mapping[str, Any]) -> Any:
    """Call what makes a part.

    Raises:
        UnknownNameError: it takes no such argument.
        InputError: it refuses these arguments.
    """
    try:
        signature = inspect.signature(build)
        if not any(p.kind is p.VAR_KEYWORD for p in signature.parameters.values()):
            for key in arguments:
                if key not in signature.parameters:
                    raise UnknownNameError.among(f"argument of {what}", key, signature.parameters)
        return build(**arguments)
    except CtxvalError:
        raise
    except Exception as error:
        raise InputError(f"{what} cannot be made: {reason_of(error)}.") from error


def argument(value: Any) -> Any:
    """Return an argument as it is, or what ``{ref = "module:attr"}`` names."""
    if isinstance(value, Mapping):
        if set(value) == {"ref"}:
            return reference(str(value["ref"]))
        return {key: argument(item) for key, item in value.items()}
    return value


def reference(text: str) -> Any:
    """Import ``module:attr``; this runs the module's code.

    Raises:
        InputError: it cannot be loaded.
    """
    module_name, _, attribute = text.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        return getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise InputError(f"{text} cannot be loaded: {error}.") from error
    except CtxvalError:
        raise
    except Exception as error:
        raise InputError(f"{module_name} failed while it was loaded: {reason_of(error)}.") from error


def recorded(files: Any) -> Transitions:
    """Return the transitions in recorded trajectories, CSV or NPZ, or in an NPZ file with x, u and x_next.

    Raises:
        InputError: a file cannot be read.
    """
    paths = [files] if isinstance(files, str) else files
    if not isinstance(paths, list) or not paths or not all(isinstance(path, str) for path in paths):
        raise InputError(f"data must be files of recorded trajectories, got {files!r}.")
    return Transitions.joined([_transitions(Path(path)) for path in paths])


def _transitions(path: Path) -> Transitions:
    if path.suffix != ".npz":
        return Trajectory.from_csv(path).transitions()
    try:
        arrays = Archive(read_bytes(path))
        if "x_next" in arrays:
            return Transitions(*(arrays.numbers(name) for name in ("x", "u", "x_next")))
    except ShapeError:
        raise
    except InputError as error:
        raise InputError(f"{path} cannot be read as recorded data: {error}.") from error
    return Trajectory.from_npz(path).transitions()


# Tasks


@dataclass(frozen=True)
class TaskTable:
    """A task function without code: every component is a number, or a task parameter by name.

    Attributes:
        initial_state, goal: ``1.5``, ``"name"``, ``"-name"`` or ``"name[2]"``; no goal is zero.
        horizon: number of steps.
        dt: seconds in a step.
    """

    initial_state: tuple[float | str, ...]
    goal: tuple[float | str, ...] | None
    horizon: int
    dt: float

    def __call__(self, p: Parameters) -> Task:
        """Return the task, or the batch of tasks."""
        start = [_component(entry, p) for entry in self.initial_state]
        goal = None if self.goal is None else [_component(entry, p) for entry in self.goal]
        return Task(start, goal=goal, horizon=self.horizon, dt=self.dt)


def _component(entry: float | str, p: Parameters) -> Any:
    if not isinstance(entry, str):
        return entry
    name, _, index = entry.removeprefix("-").partition("[")
    value = p[name.strip()]
    if index:
        value = value[..., int(index.removesuffix("]"))]
    return -value if entry.startswith("-") else value


_TASK_KEYS = ("initial_state", "goal", "horizon", "dt")


def task_function(given: str | Mapping[str, Any], space: TaskSpace, system: Any) -> Any:
    """Return the map p -> task of an experiment file: ``module:attr``, or a table.

    Raises:
        InputError: the table misses something, or names what is no task parameter.
    """
    if isinstance(given, str):
        return reference(given)
    for key in given:
        if key not in _TASK_KEYS:
            raise UnknownNameError.among("entry of [task]", key, _TASK_KEYS)
    table = {"dt": getattr(system, "dt", None), **given}
    missing = [key for key in ("initial_state", "horizon", "dt") if table.get(key) is None]
    if missing:
        raise InputError(f"[task] needs {', '.join(missing)}.")
    goal = table.get("goal")
    found = TaskTable(
        _components("initial_state", table["initial_state"]),
        None if goal is None else _components("goal", goal),
        table["horizon"],
        table["dt"],
    )
    try:
        found(space.parameters(space.low))
    except CtxvalError:
        raise
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(f"[task] cannot be used: {error}.") from error
    return found


def _components(name: str, entries: Any) -> tuple[float | str, ...]:
    valid = isinstance(entries, list) and entries
    if not valid or not all(isinstance(e, int | float | str) and not isinstance(e, bool) for e in entries):
        raise InputError(f"{name} of [task] must be a list of numbers and of names of parameters, got {entries!r}.")
    return tuple(entries)


# Options of plain types


def require_types(what: str, function: Any, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options, lists made tuples where the function wants tuples.

    Raises:
        InputError: an option has another type than the function's annotation says.
    """
    target = getattr(function, "__init__") if isinstance(function, type) else function  # noqa: B009
    try:
        hints = get_type_hints(target)
    except (NameError, TypeError):
        return dict(options)
    return {name: _typed(f"{what}: {name}", hints.get(name, Any), value) for name, value in options.items()}


def _typed(what: str, hint: Any, value: Any) -> Any:
    try:
        adapter = TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))
    except (PydanticUserError, SchemaError, TypeError):
        # A protocol, which no plain value has.
        if isinstance(value, str | int | float | list | dict):
            raise InputError(f"{what}: it is an object of Python, {{ ref = 'module:attr' }}, got {value!r}.") from None
        return value
    given = tuple(value) if isinstance(value, list) else value
    try:
        return adapter.validate_python(given, strict=True)
    except ValidationError as error:
        message = error.errors()[0]["msg"].lower()
        raise InputError(f"{what}: {message}, got {value!r}.") from error


def space_of(bounds: Mapping[str, Sequence[Any]]) -> TaskSpace:
    """Return a task space from ``name = [low, high, "unit"]``.

    Raises:
        InputError: bounds cannot be used.
    """
    return TaskSpace(**{name: tuple(bound) for name, bound in bounds.items()})
