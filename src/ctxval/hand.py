"""Trials that people execute: the files that they take with them, and the recordings that they bring back."""

from __future__ import annotations

import csv
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval.campaign import Campaign, OpenTrial
from ctxval.controller import AffineFeedback
from ctxval.errors import InputError
from ctxval.exchange import write_controller, write_task
from ctxval.experiment import Experiment, labels_of
from ctxval.space import TaskSpace
from ctxval.texts import unguarded
from ctxval.trajectory import Trajectory
from ctxval.validation import Plan

_RESULTS = ("trajectory", "distance", "failed")


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
    if not path.is_file():
        raise InputError(f"{path} cannot be read: it is a folder." if path.is_dir() else f"there is no file {path}.")


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
        self, campaign: Campaign, experiment: Experiment, resample: bool, tolerance: float
    ) -> Trajectory | None:
        """Return its recording, if it has one, after a check that all of it can be taken in.

        Raises:
            InputError: it cannot.
        """
        point = campaign.validation.space.point(self.parameters)
        recording = None
        if self.trajectory is not None:
            recording = read_recording(self.trajectory, experiment, campaign.validation.plan(point), resample=resample)
        campaign.known(self.parameters, recording, distance=self.distance, failed=self.failed, tolerance=tolerance)
        return recording


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
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            reader.fieldnames = [unguarded(name) for name in reader.fieldnames or ()]
            rows = [(reader.line_num, row) for row in reader]
            header = [name for name in reader.fieldnames or () if name]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as a table of runs: {error}.") from error
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


def _run(path: Path, line: int, row: Mapping[str, str | None], space: TaskSpace) -> KnownRun:
    where = f"{path}, line {line}"
    point = [_number(where, name, row[name]) for name in space.names]
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


def parameters_from(settings: Sequence[str]) -> dict[str, Any]:
    """Return task parameters from texts ``name=value``; the values of a vector are parted by commas.

    Raises:
        InputError: a text is no such thing, or a name is there twice.
    """
    found: dict[str, Any] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name or name in found:
            raise InputError(f"a task parameter is given once, as name=value, got {text!r}.")
        numbers = [_number("--set", name, part) for part in value.split(",")]
        found[name] = numbers if "," in value else numbers[0]
    return found
