"""``ctxval replay``, ``ctxval fit`` and ``ctxval collect``: recordings of the system, and models learned from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from ctxval._util.texts import shortened
from ctxval.cli.base import CANNOT_GO_ON, FALSIFIED, command, err, notes, out, print_columns
from ctxval.cli.config.check import task_text
from ctxval.cli.config.references import reference, require_function
from ctxval.cli.config.settings import Settings, named_model, read_settings
from ctxval.cli.options import named_values, parsed, require_outputs
from ctxval.core.experiment import Experiment
from ctxval.core.labels import labels_of, names_of
from ctxval.data import Field, LogMapping, Recordings, read_recordings
from ctxval.errors import ExecutionError, InputError
from ctxval.report.replay_page import write_replay_page
from ctxval.studies.fitting import FitReport, FittedParameter, fit
from ctxval.studies.fitting.excitation import Excitation, SignalKind
from ctxval.studies.fitting.fit import HOLD_OUT, KINDS
from ctxval.studies.fitting.fit import STEPS as FITTED
from ctxval.studies.fitting.model_file import BESIDE, SUFFIXES, require_suffix, write_model_file
from ctxval.studies.replay import PredictedTask, ReplayReport
from ctxval.studies.replay import replay as compared
from ctxval.studies.replay.report import STEPS as REPLAYED

DEFAULT_STEPS: dict[str, Any] = {"replayed": ",".join(map(str, REPLAYED)), "fitted": ",".join(map(str, FITTED))}
"""Words of the text of ``--steps``."""


# Commands


@command(**DEFAULT_STEPS)
def replay(
    logs: list[Path],
    model: str | None = None,
    option: list[str] | None = None,
    experiment: str | None = None,
    mapping: Path | None = None,
    state: list[str] | None = None,
    input_: list[str] | None = None,
    time: str | None = None,
    dt: float | None = None,
    delay: float | None = None,
    steps: str | None = None,
    executions: int = 10,
    seed: int = 0,
    html: Path | None = None,
    force: bool = False,
) -> Any:
    """Compare a model with recordings of its system. Nothing is executed, and no experiment file is needed.

    The command shows errors over one and several steps on recordings that the model has not seen, where they are large,
    how much of them a better model could explain, and mistakes of timing. With --experiment it also predicts the worst
    tasks, and proposes the executions that would tell most.
    """
    require_outputs({"--html .html": html}, [*logs, model, experiment, mapping], force=force)
    settings = None if experiment is None else read_settings(experiment, {})
    made = None if settings is None else settings.load()
    if model is None and made is None:
        raise InputError("a model is needed: give --model, or --experiment for the model of an experiment.")
    recordings = read_logs(logs, mapping, state, input_, settings, made, time=time, dt=dt, delay=delay)
    if model is None and made is not None:
        chosen, name = made.validation.model, made.name
    else:
        chosen, name = named_model(str(model), named_values(option), recordings.dt), Path(str(model)).name
    report = compared(
        chosen,
        recordings,
        steps=REPLAYED if steps is None else numbers(steps),
        validation=None if made is None else made.validation.with_model(chosen),
        executions=executions,
        seed=seed,
    )
    units = "" if made is None else made.units
    _print_replay(report, recordings, units)
    if html is None:
        return report.to_json()
    written = write_replay_page(report, html, name=name, units=units)
    out.say("")
    out.say(f"report: {written}")
    return {**report.to_json(), "report": str(written)}


def _print_replay(report: ReplayReport, recordings: Recordings, units: str) -> None:
    data = report.data
    out.say(f"{data.recordings} recordings, {data.steps} steps of {data.dt:g} s ({data.steps * data.dt:.4g} s)")
    out.say(f"states: {', '.join(data.states)}; inputs: {', '.join(data.inputs) or 'none'}")
    print_breaks(recordings)
    order = list(data.states).index
    errors = [
        (
            each.state,
            str(each.steps),
            f"{each.rms:.3g} {each.unit}".rstrip(),
            f"{each.lowest:.3g} to {each.highest:.3g}",
            f"{each.upper:.3g}",
            f"{100 * each.relative:.3g} %",
        )
        for each in sorted(report.errors, key=lambda error: order(error.state))
    ]
    columns: tuple[str, ...] = ("state", "steps", "rms error", "of recordings", "95 % below", "of the change")
    print_columns(columns, errors, "error of the prediction")
    residuals = [
        (
            each.state,
            f"{each.rms:.3g} {each.unit}".rstrip(),
            f"{100 * each.explained:.0f} %",
            f"{100 * each.linear:.0f} %",
            f"{each.rest:.3g} {each.unit}".rstrip(),
            f"{100 * each.history:.0f} %",
        )
        for each in report.residuals
    ]
    columns = ("state", "rms", "explained by (x, u)", "affine part", "rest", "explained by the step before")
    if residuals:
        print_columns(columns, residuals, "one-step residual on held-out recordings")
    if report.tasks is not None:
        _print_tasks("largest predicted distances, which no execution has tested", report.tasks.worst, units)
        upper = f"{report.tasks.upper:.4g} {units}".rstrip()
        out.say(f"largest distance over all tasks: {report.tasks.median:.4g}, at most {upper} in 95 % of the draws")
        _print_tasks("executions that would tell most of the largest distance", report.tasks.executions, units)
    out.say("")
    for sentence in report.insights:
        out.say(("- ", "bold"), sentence, wrap=True)


def _print_tasks(title: str, tasks: Sequence[PredictedTask], units: str) -> None:
    columns = ["task", f"distance [{units}]" if units else "distance", "90 % between"]
    rows = [[task_text(each.parameters), f"{each.median:.4g}", f"{each.low:.4g} and {each.high:.4g}"] for each in tasks]
    if any(each.resolved is not None for each in tasks):
        columns.append("resolved")
        for row, each in zip(rows, tasks, strict=True):
            row.append(f"{100 * (each.resolved or 0):.0f} %")
    print_columns(columns, rows, title)


@command("fit", kinds=", ".join(KINDS), **DEFAULT_STEPS)
def fit_models(
    logs: list[Path],
    kind: str | None = None,
    step: str | None = None,
    parameter: list[str] | None = None,
    vectorized: bool = False,
    mapping: Path | None = None,
    state: list[str] | None = None,
    input_: list[str] | None = None,
    time: str | None = None,
    dt: float | None = None,
    delay: float | None = None,
    given: str | None = None,
    hold_out: float = HOLD_OUT,
    steps: str | None = None,
    out_: Path | None = None,
    force: bool = False,
    seed: int = 0,
) -> Any:
    """Learn models from recordings, and compare their errors on recordings that were held out.

    The most accurate model is that with the smallest error after the largest number of steps. Its file contains the
    recorded steps that it was learned from, so that the search `auto` begins with them. If its error after one step or
    after the largest number of steps is at least the recorded change, the command ends with status 1.
    """
    kinds: Any = kind.split(",") if kind else (["parameters"] if step is not None else list(KINDS[:3]))
    if (step is None) != (not parameter):
        raise InputError("--step and --parameter must be given together.")
    bounds = named_values(parameter, "--parameter")
    require_model_file(out_, [*logs, mapping, given], force=force)
    recordings = read_logs(logs, mapping, state, input_, time=time, dt=dt, delay=delay)
    report = fit(
        recordings,
        [name.strip() for name in kinds],
        step=step_function(step),
        bounds=bounds,
        vectorized=vectorized,
        given=None if given is None else named_model(given, {}, recordings.dt),
        hold_out=hold_out,
        steps=FITTED if steps is None else numbers(steps),
        seed=seed,
    )
    print_breaks(recordings)
    _print_fit(report)
    if not report.fitted:
        return {**report.to_json(), "files": []}, CANNOT_GO_ON
    written, learned = list[str](), [model for model in report.fitted if model.kind != "given"]
    best = (learned or report.fitted)[0]
    if out_ is not None:
        holds = [model for model in learned if isinstance(model.model, SUFFIXES[out_.suffix])]
        if not holds:
            kinds_learned = ", ".join(model.kind for model in report.fitted)
            raise InputError(
                f"no model that was learned ({kinds_learned}) can be written to a file that ends in {out_.suffix}."
            )
        best = holds[0]
        written = write_model_file(out_, best.model, step)
        out.say(f"the {best.kind} model is in {' and '.join(written)}")
    if best.useless is not None:
        notes.say(("not good: ", "bold red"), f"{best.useless}.", wrap=True)
    return {**report.to_json(), "files": written}, 0 if best.useless is None else FALSIFIED


def step_function(step: str | None) -> Any:
    """Return the function that --step names; None if there is none."""
    return None if step is None else require_function(f"--step {step}", reference(step), "(x, u, theta) -> x_next")


def require_model_file(path: Path | None, inputs: Iterable[object], *, force: bool) -> None:
    """Check that the file of a model and those beside it can be written, before anything is learned or executed."""
    if path is not None:
        require_suffix(path)
        beside = {f"FILE{suffix}": path.with_suffix(suffix) for suffix in BESIDE}
        require_outputs({"--out": path, **beside}, inputs, force=force)


def print_parameters(parameters: Sequence[FittedParameter]) -> None:
    """Print parameters with their intervals."""
    for each in parameters:
        note = f"; {each.note}" if each.note else ""
        between = f"between {each.low:.6g} and {each.high:.6g} with confidence 0.95{note}"
        out.say((each.name, "bold"), f" = {each.value:.6g}, {between}")


def _print_fit(report: FitReport) -> None:
    held, own = report.held_out, report.learned_from
    out.say(
        f"learned from {own.steps} steps of {len(own.runs)} recordings; errors on {held.steps} steps of "
        f"{len(held.runs)} others"
    )
    order = list(held.states).index
    rows = [
        (
            model.kind,
            each.state,
            str(each.steps),
            f"{each.rms:.3g} {each.unit}".rstrip(),
            f"{100 * each.relative:.3g} %",
        )
        for model in report.fitted
        for each in sorted(model.errors, key=lambda error: order(error.state))
    ]
    columns = ("model", "state", "steps", "rms error", "of the change")
    print_columns(columns, rows, "error on held-out recordings", left=2)
    for model in report.fitted:
        print_parameters(model.parameters)
        for note in model.notes:
            out.say((f"{model.kind}: ", "bold"), note, wrap=True)
    for failure in report.failed:
        notes.say((f"{failure.kind}: ", "yellow"), shortened(failure.reason))


@command(signals=", ".join(get_args(SignalKind)))
def collect(
    target: str,
    amplitude: str,
    out_: Path = Path("logs"),
    runs: int = 10,
    kind: str = "multisine",
    limits: str | None = None,
    seed: int = 0,
    option: list[str] | None = None,
) -> Any:
    """Execute random tasks with a signal added to the inputs, and record them for `ctxval fit` and `ctxval replay`.

    Each execution is written to the folder when it ends. If the command is interrupted, run it again: executions whose
    files exist are not repeated.
    """
    settings = read_settings(target, {"options": named_values(option), "seed": seed})
    experiment = settings.load()
    allowed = None if limits is None else parsed(limits)
    size = parsed(amplitude)
    if not isinstance(size, int | float | list):
        raise InputError(f"--amplitude must be a number or a list such as [1.0, 0.5], got {amplitude!r}.")
    made = Excitation(experiment.validation, kind, size, allowed, seed)  # type: ignore[arg-type]
    try:
        out_.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out_} cannot be made: {error.strerror}.") from error
    recorded, failed, known = list[str](), list[dict[str, Any]](), 0
    for number in range(runs):
        path = out_ / f"run{number:04d}.csv"
        if path.exists():
            known += 1
            continue
        try:
            run = made.run(number)
            states, inputs = experiment.names(run.states.shape[-1], run.inputs.shape[-1])
            run.to_csv(path, states=labels_of(states), inputs=labels_of(inputs))
            recorded.append(str(path))
        except ExecutionError as error:
            failed.append({"run": number, "reason": str(error)})
            err.say((f"run {number} failed", "yellow"), f": {error}")
    out.say(f"{len(recorded)} executions recorded in {out_}, {known} were there before, {len(failed)} failed.")
    report = {"recorded": recorded, "known": known, "failed": failed, "folder": str(out_)}
    return (report, CANNOT_GO_ON) if failed and not recorded and not known else report


# Logs


def read_logs(
    logs: Sequence[Path],
    mapping: Path | None,
    states: Sequence[str] | None,
    inputs: Sequence[str] | None,
    settings: Settings | None = None,
    experiment: Experiment | None = None,
    **stated: Any,
) -> Recordings:
    """Return the recordings in logs.

    Args:
        logs: files or folders.
        mapping: the file of the mapping; None for ``states`` and ``inputs``, for that of the settings, or for that of
            usual names.
        states, inputs: texts ``NAME=FIELD``.
        settings, experiment: of an experiment whose recordings these are.
        stated: other fields of the mapping that the command line may state: the time, dt and the delay.
    """
    if not (states or inputs):
        given = None if settings is None else settings.log_mapping
        used = given if mapping is None else LogMapping.from_toml(mapping)
    elif mapping is not None:
        raise InputError("--mapping cannot be combined with --state and --input.")
    elif not states:
        raise InputError("--input needs --state: name the fields of all states too.")
    else:
        used = LogMapping(_fields(states), _fields(inputs or ()))
    changes = {name: value for name, value in stated.items() if value is not None}
    own_states, own_inputs = ({}, {}) if experiment is None else _names(experiment)
    recordings = read_recordings(logs, used, states=own_states, inputs=own_inputs, **changes)
    units = [*recordings.states.values(), *recordings.inputs.values()]
    own_units = [*own_states.values(), *own_inputs.values()]
    same = (len(own_states), len(own_inputs)) == (len(recordings.states), len(recordings.inputs))
    if not same or own_states.keys() & own_inputs.keys():
        return recordings
    if any(unit not in ("", own) for unit, own in zip(units, own_units, strict=True)):
        return recordings
    return replace(recordings, states=own_states, inputs=own_inputs)


def _names(experiment: Experiment) -> tuple[dict[str, str], dict[str, str]]:
    """Return the names and units of the states and inputs of an experiment, as far as they are known."""
    system = experiment.validation.system
    states, inputs = experiment.states or names_of(system, "states"), experiment.inputs or names_of(system, "inputs")
    return experiment.names(len(states), len(inputs)) if states else ({}, {})


def _fields(given: Sequence[str]) -> dict[str, Field]:
    fields: dict[str, Field] = {}
    for text in given:
        name, equals, path = text.partition("=")
        name, path = (name.strip(), path.strip()) if equals else (text.strip(), text.strip())
        if not name or not path or name in fields:
            raise InputError(f"each state and input must be given once, as NAME=FIELD, got {text!r}.")
        fields[name] = Field(path)
    return fields


def numbers(text: str) -> list[int]:
    """Return the numbers of steps in a text with commas between them."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--steps must be positive integers with commas between them, such as 1,10,50, got {text!r}.")
    return [int(part) for part in parts]


def print_breaks(recordings: Recordings) -> None:
    """Print how logs were read, and where they were split."""
    for note in recordings.notes:
        out.say((note, "dim"))
    for split in recordings.breaks[:5]:
        notes.say(("split:", "yellow"), f" {split}")
    if len(recordings.breaks) > 5:
        notes.say(f"and {len(recordings.breaks) - 5} other places; --json lists them.")
