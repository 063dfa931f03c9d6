"""``ctxval start`` and ``watch``: what logs show, as a first statement, and whether a certificate still holds."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.checked import NonNegativeFloat, require
from ctxval._util.progress import advance, stage
from ctxval._util.refusals import reworded
from ctxval._util.representation import counted, task_text
from ctxval._util.tables import CsvTable
from ctxval._util.texts import shell_word
from ctxval._util.toml import require_unedited, write_toml
from ctxval.campaign.by_hand import parameters_from, read_runs
from ctxval.campaign.choices import Execution
from ctxval.campaign.watching import FALSE_ALARMS
from ctxval.cli.base import FALSIFIED, Allowed, command, notes, out, print_columns, require_outputs
from ctxval.cli.config.stored_settings import Limits, Opened, open_store
from ctxval.cli.recordings import Logs, print_breaks, print_errors
from ctxval.core.labels import require_names
from ctxval.core.trajectory import Trajectory
from ctxval.data import Field, LogMapping, Observer
from ctxval.errors import ExecutionError, InputError
from ctxval.models import write_model
from ctxval.report.sections.repeat import run_command
from ctxval.studies.survey import Survey, survey


@command(false_alarms=f"{FALSE_ALARMS:g}")
def watch(
    store: Path,
    logs: list[Path],
    reading: Logs,
    allowed: Allowed,
    threshold: float | None = None,
    false_alarms: float = FALSE_ALARMS,
    parameters: list[str] | None = None,
    resample: bool = False,
    start_tolerance: float | None = None,
) -> Any:
    require("start tolerance", NonNegativeFloat | None, start_tolerance)
    opened = open_store(store, allowed)
    limit, _ = Limits(threshold).completed_by(opened.settings, opened.experiment)
    if limit is None:
        why = "neither the store nor the experiment has one"
        raise InputError(f"a threshold is needed: give --threshold, because {why}.")
    how = {"resample": resample, "start_tolerance": start_tolerance}
    runs = list(_runs(opened, logs, reading, parameters, how))  # all are read before any is judged
    watching = opened.campaign.watch(limit, false_alarms)
    judged, seen, skipped = list[dict[str, Any]](), list[dict[str, Any]](), list[dict[str, str]]()
    if resample:
        missing = "steps with missing samples are no steps of the system, and look like a change"
        notes.say(f"--resample interpolates: {missing}.")
    with stage("judging", len(runs), "runs"):
        for name, execution, task in runs:
            try:
                if execution.trajectory is None:
                    raise ExecutionError(execution.failed or "it has no trajectory")
                before, state = watching.state, watching.update(execution, task, name=name)
            except ExecutionError as error:
                skipped.append({"run": name, "reason": str(error)})
            else:  # the statistic of this run that differs most from those certified
                ratios = {of.name: of.ratio(len(state.runs)) for of in state.channels if of.later[-1] is not None}
                most = max(ratios, key=ratios.__getitem__)
                latest = {"run": name, "distance": state.distances[-1], "statistic": most, "ratio": ratios[most]}
                (seen if state is before else judged).append({**latest, "evidence": state.evidence})
            advance(1)
    for each in judged:
        parts = [f"{each['statistic']} {each['ratio']:.2g} times those certified"]
        if each["distance"] is not None:
            parts.insert(0, f"distance {each['distance']:.4g} {opened.experiment.units}".rstrip())
        out.say(f"{each['run']}: {', '.join(parts)}, evidence of a change {each['evidence']:.2g}")
    for each in seen:
        notes.say((f"{each['run']} is not counted", "yellow"), ": it is the recording of an earlier run once more.")
    for failure in skipped:
        notes.say((f"{failure['run']} is not judged", "yellow"), f": {failure['reason']}")
    if not judged:
        raise InputError("no run can be judged: a trajectory of at least one complete execution is needed.")
    state, again = watching.state, watching.again()
    first, colon, rest = state.sentence.partition(":")
    out.say((first.upper(), "bold red" if state.expired else "bold green"), f"{colon}{rest}.", wrap=True)
    if skipped:
        are = "is" if len(skipped) == 1 else "are"
        text = f"{len(skipped)} of {len(runs)} runs {are} not judged, and nothing is said of them"
        out.say((text, "yellow"), "; an execution that fails may itself be a change.", wrap=True)
    for trial in again:
        out.say(f"execute again: trial {trial.number}, {task_text(trial.parameters)}")
    if again:
        out.say(f"next: {_next(opened, allowed, store, limit, again[0].number)}")
    repeated = [{"trial": trial.number, "task": trial.parameters} for trial in again]
    report: dict[str, Any] = {
        "runs": judged,
        "skipped": skipped,
        "counted_before": [each["run"] for each in seen],
        "again": repeated,
    }
    report |= {"watch": state.to_json(), "store": str(store)}
    return report, FALSIFIED if state.expired else 0


def _next(opened: Opened, allowed: Allowed, store: Path, threshold: float, trial: int) -> str:
    """Return the command that goes on after an alarm."""
    by_people = getattr(opened.experiment.validation.system, "manual", False)
    if by_people or any(each.told for each in opened.campaign.trials):
        return shlex.join(["ctxval", "ask", str(store), "--again", str(trial), "--because", "REASON"])
    settings, target = opened.settings.model_copy(update={"threshold": threshold}), allowed.experiment or ""
    if not target and settings.file is not None and settings.folder not in (None, Path.cwd()):
        target = str(Path(settings.folder or "", settings.file))
    # In another store, because the executions of this one are those of the system before.
    other = store.with_name(f"{store.stem}.changed{store.suffix}")
    return run_command(settings.model_dump(mode="json"), settings.budget, "--store", str(other), target=target)


_Run = tuple[str, Execution, Mapping[str, Any] | None]
"""The name of a recording, the recording or the reason why it cannot be judged, and its task if that is known."""


def _runs(
    opened: Opened, logs: Sequence[Path], reading: Logs, parameters: list[str] | None, how: Mapping[str, Any]
) -> Iterator[_Run]:
    """Yield the runs in tables, in a trajectory whose task is given, and in recordings whose tasks are unknown."""
    validation, space = opened.campaign.validation, opened.campaign.validation.space
    mapping = reading.stated() or opened.settings.log_mapping
    if mapping is not None:
        mapping = replace(mapping, **reading.changes)
    given = parameters_from(parameters, space) if parameters else None
    if given is not None and len(logs) != 1:
        raise InputError(f"--set gives the parameters of one trajectory, got {len(logs)} files.")
    for path in logs:
        # A table of runs names their trajectories.
        is_table = path.suffix == ".csv" and path.is_file() and "trajectory" in CsvTable(path, 16 * 2**20).names
        if given is None and not is_table:
            yield from _without_task(opened, path, reading)
            continue
        for run in read_runs([path], given, space, mapping=mapping, **how):
            try:
                _, execution = run.checked(validation, opened.experiment)
            except ExecutionError as error:
                execution = Execution(failed=str(error))
            yield run.where, execution, run.parameters


def _without_task(opened: Opened, path: Path, reading: Logs) -> Iterator[_Run]:
    """Yield recordings in pieces that are as long as a task, because a statistic of a longer run has another law."""
    validation = opened.campaign.validation
    task = validation.plan(0.5 * (validation.space.low + validation.space.high)).task
    recordings = replace(reading, dt=reading.dt or task.dt).read([path], opened.settings, opened.experiment)
    for number, recording in enumerate(recordings.runs):
        whole = recording.trajectory
        name = str(path) if len(recordings.runs) == 1 else f"{path}, recording {number + 1}"
        pieces = max(1, whole.horizon // task.horizon)
        if 2 * whole.horizon < task.horizon:
            yield name, Execution(failed=f"it has {whole.horizon} steps, and a task has {task.horizon}"), None
            continue
        for piece in range(pieces):
            first, last = piece * task.horizon, min((piece + 1) * task.horizon, whole.horizon)
            part = Trajectory(whole.times[first : last + 1], whole.states[first : last + 1], whole.inputs[first:last])
            yield name if pieces == 1 else f"{name}, part {piece + 1}", Execution(part), None


@command()
def start(logs: list[Path], reading: Logs, out_: Path = Path("start"), force: bool = False, seed: int = 0) -> Any:
    files = {name: out_ / name for name in ("mapping.toml", "model.npz", "experiment.toml")}
    require_outputs({f"--out {name}": path for name, path in files.items()}, [*logs, reading.mapping], force=force)
    if not force:
        require_unedited(files["mapping.toml"])
        require_unedited(files["experiment.toml"])
    stated = reading.stated()
    result = survey(logs, stated, time=reading.time, dt=reading.dt, seed=seed)
    with reworded("give the fields other names with --state NAME=FIELD and --input NAME=FIELD", InputError):
        require_names(result.recordings.states, result.recordings.inputs)
    _print_survey(result)
    write_toml(files["mapping.toml"], mapping_content(result.mapping, result.recordings.dt))
    write_model(files["model.npz"], result.best.model)
    if result.recordings.inputs:
        write_toml(files["experiment.toml"], experiment_content(result))
    else:
        del files["experiment.toml"]
    out.say("")
    out.say(f"{', '.join(files)} in {out_}")
    if result.recordings.inputs:
        where = shell_word(files["experiment.toml"])
        out.say(f"next: edit {where}, and then ctxval check {where}")
    return {**result.to_json(), "files": [str(path) for path in files.values()]}


def _print_survey(result: Survey) -> None:
    recordings = result.recordings
    steps = f"{recordings.steps} steps of {recordings.dt:g} s"
    logs, runs = counted(len(result.sources), "log"), counted(len(recordings.runs), "recording")
    out.say(f"{logs}, {runs}, {steps}")
    rows = []
    for field in result.fields[:24]:
        every = f"{field.period:.3g} s" if field.period else "-"
        values = f"{field.low:.4g} to {f'{field.high:.4g} {field.unit}'.rstrip()}" if field.records else "-"
        rows.append((field.path, field.role or "-", every, values, field.remark))
    print_columns(["field", "taken as", "every", "values", "remark"], rows, "fields of the logs", left=2)
    if len(result.fields) > 24:
        out.say(f"and {len(result.fields) - 24} other fields; --json lists them.")
    for guess in result.guesses:
        out.say(("guessed: ", "yellow"), guess, wrap=True)
    print_breaks(recordings)
    print_errors(result.fit.fitted, "error on others")
    out.say("")
    for sentence in result.replay.insights:
        out.say(("- ", "bold"), sentence, wrap=True)
    out.say((f"{result.statement[:1].upper()}{result.statement[1:]}.", "bold"), wrap=True)


def mapping_content(mapping: LogMapping, dt: float) -> dict[str, Any]:
    """Return the content of a TOML file from which :meth:`LogMapping.from_toml` makes a mapping."""
    usual = vars(Field("x"))

    def content_of(field: Field) -> Any:
        changed = {name: value for name, value in vars(field).items() if value != usual[name] and value != ""}
        return field.path if set(changed) == {"path"} else changed

    content: dict[str, Any] = {"dt": dt}
    for name in ("time", "time_unit", "delay", "longest_gap", "lags", "valid"):
        if value := getattr(mapping, name):
            content[name] = value
    for kind in ("states", "inputs"):
        content[kind] = {name: content_of(field) for name, field in getattr(mapping, kind).items()}
    if isinstance(mapping.observer, Observer):
        content["observer"] = {"function": {"ref": mapping.observer.reference}, "states": dict(mapping.observer.states)}
    return content


def experiment_content(result: Survey) -> Any:
    """Return an experiment to edit, a document of tomlkit: goals in the recorded range of the first state, and LQR."""
    import tomlkit  # imported here: `watch` does not need it

    recordings = result.recordings
    states, inputs = dict(recordings.states), dict(recordings.inputs)
    x = np.concatenate([run.trajectory.states for run in recordings.runs])
    u = np.concatenate([run.trajectory.inputs for run in recordings.runs])
    unit, dt = next(iter(states.values())), float(recordings.dt)

    def numbers(values: Any) -> list[float]:
        return [float(f"{value:.3g}") for value in values]

    content: Any = tomlkit.parse((Path(__file__).parent / "example" / "start.toml.txt").read_text("utf-8"))
    content["units"] = unit
    content["space"]["goal"] = [*numbers(np.quantile(x[:, 0], [0.05, 0.95])), *([unit] if unit else [])]
    start = numbers(np.median([run.trajectory.states[0] for run in recordings.runs], axis=0))
    goal = ["goal", *[0.0] * (len(states) - 1)]
    horizon = int(min(max(result.reach[1], 10), 200))
    content["task"].update({"initial_state": start, "goal": goal, "horizon": horizon, "dt": dt})
    content["system"].update({"dt": dt})
    for kind, units in (("states", states), ("inputs", inputs)):
        content[kind].update(units)
        content["system"][kind].update(units)
    for weight, values in (("Q", x), ("R", u)):
        content["synthesizer"][weight] = numbers(1 / np.maximum(values.var(axis=0), 1e-12))
    return content
