"""Trials that people execute: the files of the task and controller, and the recordings of the results."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.files import csv_rows
from ctxval._util.texts import unguarded
from ctxval.campaign.choices import OpenTrial
from ctxval.campaign.known import KnownExecution, TrialResult, check_known
from ctxval.core.controller import AffineFeedback
from ctxval.core.exchange import write_controller, write_task
from ctxval.core.experiment import Experiment
from ctxval.core.labels import labels_of
from ctxval.core.plan import Plan
from ctxval.core.space import TaskSpace
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.core.validation import Validation
from ctxval.data import LogMapping, is_log, read_recordings
from ctxval.errors import InputError

_RESULTS = ("trajectory", "distance", "failed")

_MOST_TABLE = 16 * 2**20
"""Largest size of a table of runs in bytes."""


def write_files(folder: Path, experiment: Experiment, opened: OpenTrial) -> list[str]:
    """Write the task, the controller and the model's trajectory of a trial into a folder, either all files or none.

    Only a controller that is affine feedback is written. Returns the names of the files.

    Raises:
        InputError: if the folder cannot be written.
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
            f"the files of trial {opened.number} cannot be written to {folder}: {error.strerror}. The trial is open: "
            f"`ctxval ask STORE --trial {opened.number} --out FOLDER` writes them to another folder."
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
    path: Path,
    experiment: Experiment,
    plan: Plan,
    *,
    npz: bool | None = None,
    resample: bool = False,
    mapping: LogMapping | None = None,
) -> Trajectory:
    """Read a recorded trajectory from a CSV file with named columns, from an NPZ file, or from a log of another kind.

    Args:
        path: the file.
        experiment: gives the names of the columns.
        plan: the plan of the trial.
        npz: whether it is an NPZ file; by default, the suffix decides.
        resample: interpolate the recording to the times of the task.
        mapping: which fields of a log are states and inputs; None if the file has the names of the experiment.

    Raises:
        InputError: if the file cannot be read or resampled; the message says what is missing.
    """
    if is_log(path) or (mapping is not None and npz is not True and path.is_file()):
        logged = _logged(path, plan, mapping)
        return logged.resampled(plan.task.times) if resample else logged
    _require_file(path)
    states, inputs = _names(experiment, plan)
    if path.suffix == ".npz" if npz is None else npz:
        recording = Trajectory.from_npz(path)
    else:
        recording = Trajectory.from_csv(path, states=labels_of(states), inputs=labels_of(inputs))
        if inputs and not recording.inputs.shape[-1]:
            raise InputError(f"{path} must have the columns of the inputs, {', '.join(inputs)}.")
    if recording.states.ndim != 2:
        raise InputError(f"{path} must be one recording, got a batch of shape {recording.states.shape}.")
    _require_finite(path, recording, list(states), list(inputs))
    return recording.resampled(plan.task.times) if resample else recording


def _require_finite(path: Path, recording: Trajectory, states: list[str], inputs: list[str]) -> None:
    """Refuse a complete recording with a number that is missing or infinite; the message says where."""
    if recording.ended != COMPLETE:
        return  # the reason why it ended is reported instead
    for names, values in ((states, recording.states), (inputs, recording.inputs)):
        wrong = np.argwhere(~np.isfinite(values[:, : len(names)]))
        if len(wrong):
            row, column = wrong[0]
            raise InputError(
                f"{path} is not finite: {names[column]} is {values[row, column]} at {recording.times[row]:g} s. "
                "If the execution has no usable recording, report it with --failed."
            )


def _logged(path: Path, plan: Plan, mapping: LogMapping | None) -> Trajectory:
    """Return the only recording in a log, at the time step of the task."""
    found = read_recordings([path], mapping, dt=plan.task.dt)
    if len(found.runs) > 1 or found.breaks:
        why = f"; it was split: {found.breaks[0]}" if found.breaks else ""
        raise InputError(f"{path} must be one recording without gaps, and has {len(found.runs)}{why}.")
    return found.runs[0].trajectory


def _require_file(path: Path) -> None:
    """Refuse a path that is not a readable file, with a clearer message than that of a reader."""
    try:
        found, folder = path.is_file(), path.is_dir()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    if not found:
        raise InputError(f"{path} cannot be read: it is a folder." if folder else f"there is no file {path}.")


@dataclass(frozen=True, eq=False)
class KnownRun:
    """An earlier execution, as a file describes it.

    Exactly one of ``trajectory``, ``distance`` and ``failed`` is given.

    Attributes:
        where: the file and the line of the description.
        parameters: the task parameters.
        trajectory: the file of the recorded trajectory.
        distance: the distance d(p).
        failed: the reason why there is no result.
    """

    where: str
    parameters: Mapping[str, Any]
    trajectory: Path | None = None
    distance: float | None = None
    failed: str | None = None

    def checked(
        self,
        validation: Validation,
        experiment: Experiment,
        resample: bool,
        tolerance: float | None,
        mapping: LogMapping | None = None,
    ) -> KnownExecution:
        """Return the execution with its recording, if it has one, after all checks; nothing is stored.

        Args:
            validation: the map p -> d(p).
            experiment: gives the names of the columns.
            resample: interpolate the recording to the times of the task.
            tolerance: the start tolerance; None for that of the validation.
            mapping: which fields of a log are states and inputs; None if files have the names of the experiment.

        Raises:
            ExecutionError, InputError: if it is not an execution of this task.
        """
        point = validation.space.point(self.parameters)
        recording = None
        if self.trajectory is not None:
            plan = validation.plan(point)
            recording = read_recording(self.trajectory, experiment, plan, resample=resample, mapping=mapping)
        return check_known(validation, point, TrialResult(recording, self.distance, self.failed), tolerance)


def read_runs(files: Sequence[Path], parameters: Mapping[str, Any] | None, space: TaskSpace) -> list[KnownRun]:
    """Read earlier runs from tables, or from one trajectory if its parameters are given.

    A table is a CSV file with a column for each task parameter (``name[0]``, ... for a vector), and the columns
    trajectory (a path relative to the folder of the table), distance or failed. Each row has a value in exactly one of
    these three columns.

    Raises:
        InputError: if a file cannot be read or is not such a table; the message says what is missing.
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
            f"it has {', '.join(header) or 'none'}. For one trajectory, give --set NAME=VALUE."
        )
    if len(set(header)) != len(header):
        raise InputError(f"{path} must not have two columns of the same name, got {', '.join(header)}.")
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

    The forms are ``goal=1.5``, ``goal = 1.5 rad``, ``goal=[1.5, 0.5]``, ``goal=1.5,0.5``, ``goal[0]=1.5`` together with
    every other component, and several parameters in one text: ``goal = 1.5, load = 0.2``.

    Raises:
        UnknownNameError: if there is no such parameter.
        InputError: if a text has another form, if a unit is not that of the parameter, or if a component is missing or
            given twice.
    """
    found: dict[str, Any] = {}
    for text in settings:
        for name, value in _assignments(text):
            if name in found:
                raise InputError(f"each task parameter must be given once, as name=value, got {text!r}.")
            found[name] = _value(name, value, space)
    return _whole(found, space)


def _assignments(text: str) -> Iterator[tuple[str, str]]:
    """Yield names and values; a text after a comma that has no name is a further value of the last name."""
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
            raise InputError(f"each task parameter must be given once, as name=value, got {text!r}.")
    yield open_name, ",".join(values)


def _value(name: str, text: str, space: TaskSpace) -> float | list[float]:
    """Return the number or the list of numbers in a text, which may have the unit of the parameter."""
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
    """Return values by parameter, with the single components of a vector put together.

    Raises:
        InputError: if a component is missing, or if its vector is given too.
    """
    found = {name: value for name, value in given.items() if name in space.units or name not in space.names}
    for name in {name.partition("[")[0]: None for name in given if name not in found}:
        columns = space.columns(name)
        components = space.names[columns] if isinstance(columns, slice) else ()
        missing = [component for component in components if component not in given]
        if name in found:
            raise InputError(f"--set: {name} must be given once, either completely or by its components.")
        if missing:
            raise InputError(f"--set: {name} must be given completely: {', '.join(missing)} is missing.")
        found[name] = [given[component] for component in components]
    return found
