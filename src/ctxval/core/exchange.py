"""Tasks and controllers as files, for a rig or another program.

A file is JSON; a controller can also be NPZ with the same names. The file names its own format. Numbers are read back
bit for bit. Nothing in such a file is ever run, and a damaged or forged file raises an :class:`InputError`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, as_finite, as_floats
from ctxval._util.checked import Seconds, require
from ctxval._util.files import Archive, read_bytes, read_json, written_whole
from ctxval._util.representation import ShortRepr, shown
from ctxval.core.controller import AffineFeedback, ControllerWithMemory, Limits
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError

CONTROLLER_FORMAT, TASK_FORMAT, VERSION = "ctxval controller", "ctxval task", 1
LAW = "u = min(max(inputs[t] + gains[t] (x - states[t]), low), high) at the steps t = 0, ..., horizon - 1"

Names = Mapping[str, str]  #: the names of states or inputs, and their units


@dataclass(frozen=True, eq=False)
class ControllerFile(ShortRepr):
    """A controller that was read from a file, with the names of its states and inputs and their units, in order."""

    controller: AffineFeedback
    dt: float
    states: dict[str, str]
    inputs: dict[str, str]


def write_controller(
    path: str | Path, controller: Any, *, dt: float, states: Names | None = None, inputs: Names | None = None
) -> None:
    """Write the controller of one task, affine feedback as LQR and iLQR design it, as ``.json`` or ``.npz``.

    States and inputs are names and units of the components; ``x0, x1, ...`` and ``u0, u1, ...`` by default.

    Raises:
        InputError: if the controller is no affine feedback.
        ShapeError: if it is a batch.
    """
    if not isinstance(controller, AffineFeedback):
        if isinstance(controller, ControllerWithMemory):
            loop = "run it step by step in Python, as controllers.started(controller, task)"
            raise InputError(f"a controller with memory cannot be written to a file, got {shown(controller)}: {loop}.")
        raise InputError(f"only affine feedback, as of LQR and iLQR, can be written to a file, got {controller!r}.")
    if controller.gains.ndim != 3 or controller.inputs.ndim != 2:
        raise ShapeError(f"the controller must be for one task, with gains (H, m, n), got {controller.gains.shape}.")
    horizon, m, n = controller.gains.shape
    about = {
        "format": CONTROLLER_FORMAT,
        "version": VERSION,
        "law": LAW,
        "dt": require("dt", Seconds, dt),
        "horizon": horizon,
    }
    about |= _named("state", states, n) | _named("input", inputs, m)
    known = {"gains": controller.gains, "inputs": controller.inputs, "states": controller.states[:horizon]}
    arrays = {name: as_finite(f"the controller's {name}", array) for name, array in known.items()}
    if controller.limits is not None:
        limits = Limits.of(controller.limits, m)
        arrays |= {"low": limits.low, "high": limits.high}
    _write(Path(path), about, arrays)


def read_controller(path: str | Path) -> ControllerFile:
    """Read a controller from a ``.json`` or ``.npz`` file.

    Raises:
        InputError: if the file is not valid.
        ShapeError: if its arrays do not belong together.
    """
    with _reading(Path(path), CONTROLLER_FORMAT) as content:
        gains, inputs, states = (as_finite(name, content[name]) for name in ("gains", "inputs", "states"))
        if gains.ndim != 3 or inputs.shape != gains.shape[:2] or states.shape != (len(gains), gains.shape[2]):
            got = f"{gains.shape}, {inputs.shape} and {states.shape}"
            raise ShapeError(f"it needs gains (H, m, n), inputs (H, m) and states (H, n), got {got}.")
        horizon, m, n = gains.shape
        if content["horizon"] != horizon:
            got = str(content["horizon"])[:40]
            raise InputError(f"its horizon must be the number of its gains, {horizon}, got {got}.")
        limits = None
        if content.get("low") is not None or content.get("high") is not None:
            low = [-np.inf if value is None else value for value in content["low"]]
            high = [np.inf if value is None else value for value in content["high"]]
            limits = Limits.of(Limits(as_floats("limits", low), as_floats("limits", high)), m)
        dt, names = require("dt", Seconds, content["dt"]), (_names("state", content, n), _names("input", content, m))
        return ControllerFile(AffineFeedback(gains, inputs, states, limits), float(dt), *names)


def write_task(path: str | Path, task: Task, *, states: Names | None = None) -> None:
    """Write one task as JSON; states are names and units of its states, ``x0, x1, ...`` by default."""
    if task.batch_shape:
        raise ShapeError(f"the file of a task must hold one task, got a batch of shape {task.batch_shape}.")
    about = {"format": TASK_FORMAT, "version": VERSION, "dt": task.dt, "horizon": task.horizon}
    about |= _named("state", states, task.initial_state.size)
    about |= {"name": task.name} if task.name else {}
    if task.environment:
        about["environment"] = {name: given.tolist() for name, given in task.environment.items()}
    _write(Path(path), about, {"initial_state": task.initial_state, "reference": task.reference})


def read_task(path: str | Path) -> Task:
    """Read one task from a JSON file."""
    with _reading(Path(path), TASK_FORMAT) as content:
        start = as_finite("initial_state", content["initial_state"])
        more: dict[str, Any] = {"name": str(content.get("name", "")), "environment": content.get("environment", {})}
        return Task(start, horizon=content["horizon"], dt=content["dt"], reference=content["reference"], **more)


def _write(path: Path, about: dict[str, Any], arrays: Mapping[str, Array]) -> None:
    if path.suffix not in (".npz", ".json"):
        raise InputError(f"the file must end in .json or .npz, got {str(path)!r}.")
    with written_whole(path) as file:
        if path.suffix == ".npz":
            np.savez_compressed(file, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)
        else:
            content = about | {name: array.tolist() for name, array in arrays.items()}
            for name in {"low", "high"} & set(arrays):  # of which JSON cannot hold infinite ones
                content[name] = [limit if np.isfinite(limit) else None for limit in content[name]]
            lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in content.items())
            file.write(f"{{\n{lines}\n}}\n".encode())


@contextmanager
def _reading(path: Path, expected: str) -> Iterator[Mapping[str, Any]]:
    try:
        if path.suffix == ".npz":
            arrays = Archive(read_bytes(path))
            numbers = {name: arrays.numbers(name) for name in arrays.names if name != "about"}
            content = {**json.loads(arrays.text("about")), **numbers}
        else:
            content = read_json(path)
        if not isinstance(content, Mapping):
            raise InputError("it must be a JSON object.")
        if content["format"] != expected:
            raise InputError(f"its format must be {expected!r}, got {str(content['format'])[:40]!r}.")
        if content["version"] != VERSION:
            raise InputError(f"this version of ctxval reads version {VERSION}, got {str(content['version'])[:40]}.")
        yield content
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError, RecursionError) as error:
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {str(error)[:100]}"
        raise InputError(f"{path} cannot be read as a {expected}: {reason.removesuffix('.')}.") from error


def _named(kind: str, names: Names | None, count: int) -> dict[str, list[str]]:
    named = {f"{'x' if kind == 'state' else 'u'}{i}": "" for i in range(count)} if names is None else dict(names)
    if len(named) != count:
        raise ShapeError(f"there must be {count} names of {kind}s, got {', '.join(named) or 'none'}.")
    return {f"{kind}_names": list(named), f"{kind}_units": list(named.values())}


def _names(kind: str, content: Mapping[str, Any], count: int) -> dict[str, str]:
    names, units = content[f"{kind}_names"], content[f"{kind}_units"]
    if not all(isinstance(text, str) for text in (*names, *units)) or not len(set(names)) == len(units) == count:
        got = f"{str(names)[:60]} and {str(units)[:60]}"
        raise InputError(f"it needs the names and units of {count} {kind}s, got {got}.")
    return dict(zip(names, units, strict=True))
