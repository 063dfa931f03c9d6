"""``ctxval replay``: compare a model with recordings of its system."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from ctxval.cli.base import command, out
from ctxval.cli.commands import app
from ctxval.cli.log_options import Delay, Dt, Inputs, LogOptions, Logs, MappingFile, States, TimeField, print_breaks
from ctxval.cli.options import AsJson, named_values
from ctxval.cli.outputs import Force, require_outputs
from ctxval.cli.screen import line
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
Steps = Annotated[
    str | None,
    typer.Option(help=f"Numbers of steps after which errors are computed (default: {','.join(map(str, STEPS))})."),
]
Executions = Annotated[int, typer.Option(min=1, help="Number of executions that are proposed with --experiment.")]
Html = Annotated[
    Path | None,
    typer.Option("--html", help="Also write everything as one HTML page, which opens no connection, to this file."),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]


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
    seed: Seed = 0,
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


def numbers(text: str) -> list[int]:
    """Return the numbers of steps in a text with commas between them."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--steps must be positive integers with commas between them, such as 1,10,50, got {text!r}.")
    return [int(part) for part in parts]


# What is printed


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
    table = Table(box=None, pad_edge=False)
    table.add_column("state")
    for name in ("steps", "rms error", "of recordings", "95 % below", "of the change"):
        table.add_column(name, justify="right")
    for one in sorted(report.errors, key=lambda one: list(report.data.states).index(one.state)):
        spread = f"{one.lowest:.3g} to {one.highest:.3g}"
        unit = f" {one.unit}" if one.unit else ""
        cells = (f"{one.rms:.3g}{unit}", spread, f"{one.upper:.3g}", f"{100 * one.relative:.3g} %")
        table.add_row(line(one.state), str(one.steps), *map(line, cells))
    print_titled("error of the prediction", table)


def _print_residuals(report: ReplayReport) -> None:
    if not report.residuals:
        return
    table = Table(box=None, pad_edge=False)
    table.add_column("state")
    for name in ("rms", "explained by (x, u)", "affine part", "rest", "explained by the step before"):
        table.add_column(name, justify="right")
    for one in report.residuals:
        shares = [f"{100 * share:.0f} %" for share in (one.explained, one.linear, one.history)]
        unit = f" {one.unit}" if one.unit else ""
        cells = (f"{one.rms:.3g}{unit}", shares[0], shares[1], f"{one.rest:.3g}{unit}", shares[2])
        table.add_row(line(one.state), *map(line, cells))
    print_titled("one-step residual on held-out recordings", table)


def _print_tasks(title: str, tasks: Sequence[PredictedTask], units: str) -> None:
    table = Table(box=None, pad_edge=False)
    resolved = any(one.resolved is not None for one in tasks)
    for name in ("task", f"distance {f'[{units}]' if units else ''}".strip(), "90 % between"):
        table.add_column(name, justify="left" if name == "task" else "right")
    if resolved:
        table.add_column("resolved", justify="right")
    for one in tasks:
        at = ", ".join(f"{name} = {_short(value)}" for name, value in one.parameters.items())
        cells = [at, f"{one.median:.4g}", f"{one.low:.4g} and {one.high:.4g}"]
        table.add_row(*map(line, [*cells, f"{100 * (one.resolved or 0):.0f} %"] if resolved else cells))
    print_titled(title, table)


def print_titled(title: str, table: Table) -> None:
    """Print a table with a title above it."""
    out.say("")
    out.say((title, "bold"))
    out.print(table)


def _short(value: Any) -> str:
    return f"[{', '.join(f'{v:.4g}' for v in value)}]" if isinstance(value, list) else f"{value:.4g}"
