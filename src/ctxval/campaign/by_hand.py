"""Trials that people execute: the files of the task and controller, and the results that they report."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ctxval._util.columns import column_of, conversion
from ctxval._util.tables import CsvTable
from ctxval._util.texts import number_in, shortened, unguarded
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.choices import Execution, OpenTrial
from ctxval.campaign.telling import SuppliedResult, require_file
from ctxval.core.controller import AffineFeedback
from ctxval.core.exchange import write_controller, write_task
from ctxval.core.experiment import Experiment
from ctxval.core.plan import Plan, StartOffset
from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TASK
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import InputError

_RESULTS = ("trajectory", "distance", "failed")

TRIAL_FILES = ("task.json", "controller.json", "controller.npz", "model.csv")
"""The files of a trial that a person executes."""


def write_files(folder: Path, experiment: Experiment, opened: OpenTrial) -> list[str]:
    """Write the files of a trial into a folder, all or none; return their names. Only affine feedback is written."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            plan, nominal = opened.plan, opened.plan.model_trajectory
            states, inputs = experiment.names(nominal.states.shape[-1], nominal.inputs.shape[-1])
            write_task(fresh / "task.json", experiment.validation.recorded_task(plan.task), states=states)
            nominal.to_csv(fresh / "model.csv", states=list(states), inputs=list(inputs))
            names = ["task.json", "model.csv"]
            if isinstance(plan.controller, AffineFeedback):
                for name in ("controller.json", "controller.npz"):
                    write_controller(fresh / name, plan.controller, dt=plan.task.dt, states=states, inputs=inputs)
                names = list(TRIAL_FILES)
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


class KnownRun(NamedTuple):
    """An earlier execution: the place of its description in a file, the task, and the result."""

    where: str
    parameters: Mapping[str, Any]
    result: SuppliedResult

    def checked(self, validation: Validation, experiment: Experiment) -> tuple[Plan, Execution]:
        """Return the plan of the task and the measured execution; nothing is stored."""
        try:
            plan = validation.plan(validation.space.point(self.parameters))
            recording = self.result.read(experiment, plan)
            execution = Execution.reported(recording, self.result.distance, self.result.failed)
            return plan, execution.measured(validation, plan, self.result.start_tolerance)
        except InputError as error:
            raise InputError(f"{self.where}: {error}") from error


def read_runs(
    files: Sequence[Path], parameters: Mapping[str, Any] | None, space: TaskSpace, **reading: Any
) -> list[KnownRun]:
    """Read earlier runs from tables, or from one trajectory if its parameters are given.

    A table is a CSV file with a column for each task parameter (``name[0]``, ... for a vector), and the columns
    trajectory (a path relative to the folder of the table), distance or failed. Each row has a value in exactly one of
    these three columns. Keywords are options of each :class:`SuppliedResult` for the reading of recordings.
    """
    if parameters is not None:
        if len(files) != 1:
            raise InputError(f"--set gives the parameters of one trajectory, got {len(files)} files.")
        return [KnownRun(str(files[0]), parameters, SuppliedResult(files[0], **reading))]
    return [run for path in files for run in _table(path, space, reading)]


def _table(path: Path, space: TaskSpace, reading: Mapping[str, Any]) -> list[KnownRun]:
    require_file(path)
    table = CsvTable(path, 16 * 2**20, plain=True)
    names = space.names if space.members is None else (TASK,)
    columns = {name: column_of(str(path), table.names, name) for name in names}
    if None in columns.values() or not any(name in table.names for name in _RESULTS):
        raise InputError(
            f"{path} must be a table with the columns {', '.join(names)} and one of {', '.join(_RESULTS)}; "
            f"it has {', '.join(filter(None, table.names)) or 'none'}. For one trajectory, give --set NAME=VALUE."
        )
    units = {name: space.units.get(name, space.units.get(name.partition("[")[0], "")) for name in columns}
    named = [(name, *column) for name, column in columns.items() if column is not None]
    try:
        factors = {name: (column, conversion(unit, units[name]) if unit else 1.0) for name, column, unit in named}
    except InputError as error:
        raise InputError(f"{path}: a column of a parameter has another unit: {error}") from error
    runs = []
    for line, cells in table.rows():
        where, row = f"{table.path}, line {line}", dict(zip(table.names, cells, strict=True))
        if space.members is None:
            point = [factor * table.number(line, name, row[column]) for name, (column, factor) in factors.items()]
            parameters = space.describe_point(space.parameters(point).points)
        else:
            parameters = {TASK: unguarded(row[factors[TASK][0]].strip())}
        given = {name: unguarded(row.get(name, "").strip()) for name in _RESULTS}
        if sum(bool(text) for text in given.values()) != 1:
            raise InputError(f"{where}: exactly one of {', '.join(_RESULTS)} must be filled in.")
        file = path.parent / given["trajectory"]
        # One outside of the table's folder is refused before it is opened.
        if len(given["trajectory"]) >= 255 or not file.resolve().is_relative_to(path.parent.resolve()):
            got = shortened(given["trajectory"], 60)
            raise InputError(f"{where}: trajectory must be a file in the folder of the table, got {got!r}.")
        result = SuppliedResult(
            file if given["trajectory"] else None,
            table.number(line, "distance", given["distance"]) if given["distance"] else None,
            given["failed"] or None,
            **reading,
        )
        runs.append(KnownRun(where, parameters, result))
    if not runs:
        raise InputError(f"{path} has no run below its header.")
    return runs


_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?![\d_])(.*)", re.DOTALL)


def parameters_from(settings: Sequence[str], space: TaskSpace) -> dict[str, Any]:
    """Return task parameters from texts, in every form in which the command line prints them.

    The forms are ``goal=1.5``, ``goal = 1.5 rad``, ``goal=[1.5, 0.5]``, ``goal=1.5,0.5``, ``goal[0]=1.5`` together with
    every other component, and several parameters in one text: ``goal = 1.5, load = 0.2``.
    """
    if space.members is not None:
        name, equals, task = ",".join(settings).partition("=")
        if name.strip() != TASK or not equals:
            raise InputError(f"a task of a suite must be given by its name, as {TASK}=NAME, got {settings[0]!r}.")
        return {TASK: task.strip()}
    given: dict[str, Any] = {}
    for text in settings:
        # A text after a comma that has no name is a further value of the last name.
        for assignment in re.split(r",(?=[^,=]*=)", text):
            name, equals, value = assignment.partition("=")
            name = name.strip()
            if not equals or not name or name in given:
                raise InputError(f"each task parameter must be given once, as name=value, got {text!r}.")
            given[name] = _value(name, value.strip(), space)
    whole = {name: value for name, value in given.items() if name in space.units or name not in space.names}
    for name in {name.partition("[")[0]: None for name in given if name not in whole}:
        columns = space.columns(name)
        components = space.names[columns] if isinstance(columns, slice) else ()
        missing = [component for component in components if component not in given]
        if name in whole:
            raise InputError(f"--set: {name} must be given once, either completely or by its components.")
        if missing:
            raise InputError(f"--set: {name} must be given completely: {', '.join(missing)} is missing.")
        whole[name] = [given[component] for component in components]
    return whole


def _value(name: str, text: str, space: TaskSpace) -> float | list[float]:
    """Return the number or the list of numbers in a text, which may have the unit of the parameter."""
    unit = space.units.get(name if name in space.units else name.partition("[")[0], "")
    inside, given_unit, is_list = text, "", text.startswith("[")
    if is_list:
        inside, bracket, given_unit = text[1:].partition("]")
        if not bracket:
            raise InputError(f"{name} must be a list such as [1.5, 0.5], got {text!r}.")
    numbers = []
    for number in inside.split(","):
        quantity = f"{number} {given_unit}"
        matched = _QUANTITY.fullmatch(quantity)
        try:
            # NaN and infinity are refused elsewhere.
            numbers.append(number_in(quantity if matched is None else matched[1], float))
        except ValueError:
            raise InputError(f"--set: {name} must be a number, got {quantity.strip()!r}.") from None
        given = "" if matched is None else matched[2].strip().removeprefix("[").removesuffix("]").strip()
        if given and given != unit:
            declared = f"in {unit}" if unit else "a number without a unit"
            raise InputError(f"--set: {name} must be {declared}, got {quantity.strip()!r}.")
    return numbers if is_list or len(numbers) > 1 else numbers[0]


def tell_result(campaign: Campaign, experiment: Experiment, trial: OpenTrial | int, result: SuppliedResult) -> Trial:
    """Check and store the result of an open trial."""
    recording = None
    if result.recording is not None:
        trial = trial if isinstance(trial, OpenTrial) else campaign.reopen(trial, ended=result.replace is not None)
        recording = result.read(experiment, trial.plan)
    return campaign.tell(
        trial,
        recording,
        distance=result.distance,
        failed=result.failed,
        start_tolerance=result.start_tolerance,
        replace=result.replace,
    )


def result_sentence(trial: Trial, units: str = "", start: StartOffset | None = None, inputs: str | None = None) -> str:
    """Return the result of a trial in one sentence, with how its recording differs from its task and controller."""
    if trial.state == "unmeasured":
        return f"trial {trial.number} is stored without a distance: {trial.failure}"
    if trial.distance is None:
        return f"trial {trial.number} failed: {trial.failure}"
    sentence = f"trial {trial.number} has the distance {trial.distance:.4g} {units}".rstrip()
    if start is not None and start.size:
        sentence += f"; its start was off by {start.text}"
    if inputs is not None:
        sentence += (
            f"; its inputs are not those of the controller at the recorded states ({inputs}): check that it is a "
            "recording of this trial in the units of the experiment, and begins when the controller does (`ctxval tell "
            "--replace` corrects it)"
        )
    return sentence


def parameters_of_trial(campaign: Campaign, number: int) -> Mapping[str, Any]:
    """Return the parameters of the task of a trial."""
    known = {trial.number: trial.parameters for trial in campaign.trials}
    if number not in known:
        raise InputError(f"there is no trial {number}; there are {len(known)}, numbered from 0.")
    return known[number]
