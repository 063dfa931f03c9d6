"""``ctxval replay``: compare a model with recordings of its system."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.cli.base import command, out, print_columns
from ctxval.cli.commands import app
from ctxval.cli.log_options import (
    Delay,
    Dt,
    Inputs,
    LogOptions,
    Logs,
    MappingFile,
    RandomSeed,
    States,
    Steps,
    TimeField,
    numbers,
    print_breaks,
)
from ctxval.cli.options import AsJson, named_values
from ctxval.cli.outputs import Force, require_outputs
from ctxval.config.named_model import named_model
from ctxval.config.settings import read_settings
from ctxval.core.experiment import Experiment
from ctxval.data import Recordings
from ctxval.errors import InputError
from ctxval.replay import PredictedTask, ReplayReport
from ctxval.replay import replay as compared
from ctxval.replay.report import STEPS
from ctxval.report.replay_page import write_replay_page

ModelName = Annotated[
    str | None,
    typer.Option(
        "--model",
        help="Model to compare: an ONNX file, an NPZ file with the matrices A and B, an MJCF file or a result of "
        "mujoco.sysid, an experiment file, a reference module:attr, or a name such as Linear (default: the model of "
        "the experiment).",
    ),
]
ModelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--option", metavar="NAME=VALUE", help="Argument of the model, such as increments=true. Repeat --option."
    ),
]
Target = Annotated[
    str | None,
    typer.Option(
        "--experiment",
        help="Experiment whose tasks are judged too: a case, an experiment file, or module:attr. Its table "
        "recordings is the mapping of the logs, unless another one is given. Its system is never executed.",
    ),
]
Executions = Annotated[int, typer.Option(min=1, help="Number of executions that are proposed with --experiment.")]
Html = Annotated[
    Path | None,
    typer.Option("--html", help="Also write everything as one HTML page, which opens no connection, to this file."),
]


@app.command()
@command
def replay(
    logs: Logs,
    model: ModelName = None,
    option: ModelOption = None,
    experiment: Target = None,
    mapping: MappingFile = None,
    state: States = None,
    input_: Inputs = None,
    time: TimeField = None,
    dt: Dt = None,
    delay: Delay = None,
    steps: Steps = None,
    executions: Executions = 10,
    seed: RandomSeed = 0,
    html: Html = None,
    force: Force = False,
    as_json: AsJson = False,
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
    found = LogOptions(mapping, state, input_, time, dt, delay).read(logs, settings, made)
    if model is None and made is not None:
        chosen = made.validation.model
    else:
        chosen = named_model(str(model), named_values(option), found.dt)
    report = compared(
        chosen,
        found,
        steps=STEPS if steps is None else numbers(steps),
        validation=None if made is None else made.validation.with_model(chosen),
        executions=executions,
        seed=seed,
    )
    units = "" if made is None else made.units
    if not as_json:
        _print(report, found, units)
    if html is None:
        return report.to_json()
    written = write_replay_page(report, html, name=_name(model, made), units=units)
    if not as_json:
        out.say("")
        out.say(f"report: {written}")
    return {**report.to_json(), "report": str(written)}


def _name(model: str | None, experiment: Experiment | None) -> str:
    """Return the name of the model for the heading of the page: that of its file, or of the experiment."""
    if model is not None:
        return Path(model).name
    return "" if experiment is None else experiment.name


def _print(report: ReplayReport, found: Recordings, units: str) -> None:
    data = report.data
    seconds = data.steps * data.dt
    names = ", ".join(data.states), ", ".join(data.inputs) or "none"
    out.say(f"{data.recordings} recordings, {data.steps} steps of {data.dt:g} s ({seconds:.4g} s)")
    out.say(f"states: {names[0]}; inputs: {names[1]}")
    print_breaks(found)
    _print_errors(report)
    _print_residuals(report)
    if report.tasks is not None:
        _print_tasks("largest predicted distances, which no execution has tested", report.tasks.worst, units)
        upper = f"{report.tasks.upper:.4g} {units}".rstrip()
        out.say(f"largest distance over all tasks: {report.tasks.median:.4g}, at most {upper} in 95 % of the draws")
        _print_tasks("executions that would tell most of the largest distance", report.tasks.executions, units)
    out.say("")
    for sentence in report.insights:
        out.say(("- ", "bold"), sentence, wrap=True)


def _print_errors(report: ReplayReport) -> None:
    rows = [
        (
            error.state,
            str(error.steps),
            f"{error.rms:.3g} {error.unit}".rstrip(),
            f"{error.lowest:.3g} to {error.highest:.3g}",
            f"{error.upper:.3g}",
            f"{100 * error.relative:.3g} %",
        )
        for error in sorted(report.errors, key=lambda error: list(report.data.states).index(error.state))
    ]
    columns = ("steps", "rms error", "of recordings", "95 % below", "of the change")
    print_columns(("state",), columns, rows, "error of the prediction")


def _print_residuals(report: ReplayReport) -> None:
    rows = [
        (
            residual.state,
            f"{residual.rms:.3g} {residual.unit}".rstrip(),
            f"{100 * residual.explained:.0f} %",
            f"{100 * residual.linear:.0f} %",
            f"{residual.rest:.3g} {residual.unit}".rstrip(),
            f"{100 * residual.history:.0f} %",
        )
        for residual in report.residuals
    ]
    columns = ("rms", "explained by (x, u)", "affine part", "rest", "explained by the step before")
    if rows:
        print_columns(("state",), columns, rows, "one-step residual on held-out recordings")


def _print_tasks(title: str, tasks: Sequence[PredictedTask], units: str) -> None:
    columns = [f"distance [{units}]" if units else "distance", "90 % between"]
    rows = [
        [
            ", ".join(f"{name} = {_short(value)}" for name, value in task.parameters.items()),
            f"{task.median:.4g}",
            f"{task.low:.4g} and {task.high:.4g}",
        ]
        for task in tasks
    ]
    if any(task.resolved is not None for task in tasks):
        columns.append("resolved")
        for row, task in zip(rows, tasks, strict=True):
            row.append(f"{100 * (task.resolved or 0):.0f} %")
    print_columns(("task",), columns, rows, title)


def _short(value: Any) -> str:
    return f"[{', '.join(f'{v:.4g}' for v in value)}]" if isinstance(value, list) else f"{value:.4g}"
