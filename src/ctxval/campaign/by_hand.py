"""Trials that people execute: the files that they take with them, and the recordings that they bring back."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval._util.files import csv_rows
from ctxval._util.texts import unguarded
from ctxval.campaign.known import KnownExecution, TrialResult, check_known
from ctxval.campaign.trials import OpenTrial
from ctxval.core.controller import AffineFeedback
from ctxval.core.exchange import write_controller, write_task
from ctxval.core.experiment import Experiment, labels_of
from ctxval.core.plan import Plan
from ctxval.core.space import TaskSpace
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.errors import InputError

_RESULTS = ("trajectory", "distance", "failed")

_MOST_TABLE = 16 * 2**20
"""Bytes that a table of runs may have."""


def write_files(folder: Path, experiment: Experiment, opened: OpenTrial) -> list[str]:
    """Write a trial's task, its controller and what the model expects into a folder; all of them or none.

    A controller that is no affine feedback has no file.

    Raises:
        InputError: the folder cannot be written, or there are other files in it.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            names = _written(fresh, experiment, opened)
            fresh.chmod(0o755)
            folder.mkdir(exist_ok=True)
            for name in names:
                os.replace(fresh / name, folder / name)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    except OSError as error:
        raise InputError(
            f"the files of trial {opened.number} cannot be written to {folder}: {error.strerror}; the trial is open, "
            f"and `ctxval ask STORE --trial {opened.number} --out FOLDER` writes them elsewhere."
        ) from error
    return names


def _written(folder: Path, experiment: Experiment, opened: OpenTrial) -> list[str]:
    plan = opened.plan
    states, inputs = _names(experiment, plan)
    write_task(folder / "task.json", plan.task, states=states)
    plan.model_trajectory.to_csv(folder / "model.csv", states=list(states), inputs=list(inputs))
    if not isinstance(plan.controller, AffineFeedback):
        return ["task.json", "model.csv"]
    files = ["controller.json", "controller.npz"]
    for name in files:
        write_controller(folder / name, plan.controller, dt=plan.task.dt, states=states, inputs=inputs)
    return ["task.json", *files, "model.csv"]


def _names(experiment: Experiment, plan: Plan) -> tuple[dict[str, str], dict[str, str]]:
    return experiment.names(plan.model_trajectory.states.shape[-1], plan.model_trajectory.inputs.shape[-1])


def read_recording(
    path: Path, experiment: Experiment, plan: Plan, *, npz: bool | None = None, resample: bool = False
) -> Trajectory:
    """Read what happened from a CSV file with named columns, or from an NPZ file.

    Args:
        path: the file.
        experiment: names the columns.
        plan: of the trial that it should be of.
        npz: which kind of file it is; its suffix says so by default.
        resample: bring it to the task's times.

    Raises:
        InputError: the file cannot be read or resampled; the message says what is missing.
    """
    _require_file(path)
    if path.suffix == ".npz" if npz is None else npz:
        recording = Trajectory.from_npz(path)
    else:
        states, inputs = _names(experiment, plan)
        recording = Trajectory.from_csv(path, states=labels_of(states), inputs=labels_of(inputs))
        if inputs and not recording.inputs.shape[-1]:
            raise InputError(f"{path} must have the columns of the inputs, {', '.join(inputs)}.")
    return recording.resampled(plan.task.times) if resample else recording


def _require_file(path: Path) -> None:
    """Say what a reader of the content would say less clearly."""
    try:
        found, folder = path.is_file(), path.is_dir()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    if not found:
        raise InputError(f"{path} cannot be read: it is a folder." if folder else f"there is no file {path}.")


@dataclass(frozen=True, eq=False)
class KnownRun:
    """An execution that was made before.

    Attributes:
        where: the file and line that it is from.
        parameters: of its task.
        trajectory, distance, failed: one of them: the file of what happened, the distance, why there is no result.
    """

    where: str
    parameters: Mapping[str, Any]
    trajectory: Path | None = None
    distance: float | None = None
    failed: str | None = None

    def checked(
        self, validation: Validation, experiment: Experiment, resample: bool, tolerance: float
    ) -> KnownExecution:
        """Return the execution with its recording, if it has one, after a check that it can be taken in.

        Raises:
            InputError: it cannot.
        """
        point = validation.space.point(self.parameters)
        recording = None
        if self.trajectory is not None:
            recording = read_recording(self.trajectory, experiment, validation.plan(point), resample=resample)
        return check_known(validation, point, TrialResult(recording, self.distance, self.failed), tolerance)


def read_runs(files: Sequence[Path], parameters: Mapping[str, Any] | None, space: TaskSpace) -> list[KnownRun]:
    """Read known runs from tables, or from one trajectory whose parameters are given.

    A table is a CSV file with a column for each task parameter (``name[0]``, ... for a vector), and the columns
    trajectory (a file, seen from the table), distance or failed, of which one is filled in each row.

    Raises:
        InputError: a file cannot be read, or is no such table; the message says what is missing.
    """
    if parameters is not None:
        if len(files) != 1:
            raise InputError(f"--set gives the parameters of one trajectory, got {len(files)} files.")
        return [KnownRun(str(files[0]), parameters, trajectory=files[0])]
    return [run for path in files for run in _table(path, space)]


def _table(path: Path, space: TaskSpace) -> list[KnownRun]:
    _require_file(path)
    try:
        lines = list(csv_rows(path, _MOST_TABLE))
    except InputError as error:
        raise InputError(f"{path} cannot be read as a table of runs: {error}.") from error
    columns = [unguarded(name) for name in (lines[0][1] if lines else ())]
    header = [name for name in columns if name]
    rows = [(line, dict(zip(columns, cells, strict=False))) for line, cells in lines[1:]]
    missing = [name for name in space.names if name not in header]
    if missing or not any(name in header for name in _RESULTS):
        raise InputError(
            f"{path} must be a table with the columns {', '.join(space.names)} and one of {', '.join(_RESULTS)}; "
            f"it has {', '.join(header) or 'none'}. For one trajectory say --set NAME=VALUE."
        )
    if len(set(header)) != len(header):
        raise InputError(f"{path} must have columns of different names, got {', '.join(header)}.")
    if not rows:
        raise InputError(f"{path} has no run below its header.")
    return [_run(path, line, row, space) for line, row in rows]


def _run(path: Path, line: int, row: Mapping[str, str], space: TaskSpace) -> KnownRun:
    where = f"{path}, line {line}"
    point = [_number(where, name, row.get(name)) for name in space.names]
    given = {name: unguarded((row.get(name) or "").strip()) for name in _RESULTS}
    if sum(bool(text) for text in given.values()) != 1:
        raise InputError(f"{where}: exactly one of {', '.join(_RESULTS)} must be filled in.")
    parameters = space.describe_point(space.parameters(point).points)
    if given["trajectory"]:
        return KnownRun(where, parameters, trajectory=path.parent / given["trajectory"])
    if given["distance"]:
        return KnownRun(where, parameters, distance=_number(where, "distance", given["distance"]))
    return KnownRun(where, parameters, failed=given["failed"])


def _number(where: str, name: str, text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise InputError(f"{where}: {name} must be a number, got {text!r}.") from None


_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(.*)", re.DOTALL)


def parameters_from(settings: Sequence[str], space: TaskSpace) -> dict[str, Any]:
    """Return task parameters from texts, in every form in which the command line prints them.

    ``goal=1.5``, ``goal = 1.5 rad``, ``goal=[1.5, 0.5]``, ``goal=1.5,0.5``, ``goal[0]=1.5`` with every other component,
    and several in one text: ``goal = 1.5, load = 0.2``.

    Raises:
        UnknownNameError: there is no such parameter.
        InputError: a text is no such thing, a unit is not the parameter's, a component is missing or given twice.
    """
    found: dict[str, Any] = {}
    for text in settings:
        for name, value in _assignments(text):
            if name in found:
                raise InputError(f"a task parameter is given once, as name=value, got {text!r}.")
            found[name] = _value(name, value, space)
    return _whole(found, space)


def _assignments(text: str) -> Iterator[tuple[str, str]]:
    """Yield names and values; what follows a comma without a name is a further value."""
    open_name, values = "", list[str]()
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if equals and open_name:
            yield open_name, ",".join(values)
        if equals:
            open_name, values = name.strip(), [value]
        else:
            values.append(part)
        if not open_name:
            raise InputError(f"a task parameter is given once, as name=value, got {text!r}.")
    yield open_name, ",".join(values)


def _value(name: str, text: str, space: TaskSpace) -> float | list[float]:
    """Return a number or several, with the parameter's unit or without."""
    base = name if name in space.units else name.partition("[")[0]
    listed = text.strip()
    if listed.startswith("["):
        inside, bracket, unit = listed[1:].partition("]")
        if not bracket:
            raise InputError(f"{name} must be a list such as [1.5, 0.5], got {listed!r}.")
        return [_quantity(name, f"{number} {unit}", space.units.get(base, "")) for number in inside.split(",")]
    numbers = [_quantity(name, number, space.units.get(base, "")) for number in listed.split(",")]
    return numbers if len(numbers) > 1 else numbers[0]


def _quantity(name: str, text: str, unit: str) -> float:
    matched = _NUMBER.fullmatch(text)
    if matched is None:
        return _number("--set", name, text.strip())  # NaN and infinity are refused elsewhere
    given = matched[2].strip().removeprefix("[").removesuffix("]").strip()
    if given and given != unit:
        declared = f"in {unit}" if unit else "a number without a unit"
        raise InputError(f"--set: {name} must be {declared}, got {text.strip()!r}.")
    return float(matched[1])


def _whole(given: Mapping[str, Any], space: TaskSpace) -> dict[str, Any]:
    """Return values by parameter, vectors of which single components were given put together.

    Raises:
        InputError: a component is missing, or its vector is given too.
    """
    found = {name: value for name, value in given.items() if name in space.units or name not in space.names}
    for name in {name.partition("[")[0]: None for name in given if name not in found}:
        columns = space.columns(name)
        components = space.names[columns] if isinstance(columns, slice) else ()
        missing = [component for component in components if component not in given]
        if name in found:
            raise InputError(f"--set: {name} is given once, whole or by its components.")
        if missing:
            raise InputError(f"--set: {name} must be given whole, {', '.join(missing)} is missing.")
        found[name] = [given[component] for component in components]
    return found
