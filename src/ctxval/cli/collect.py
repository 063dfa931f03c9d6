"""``ctxval collect``: execute random tasks with a signal added to the inputs, and record them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from ctxval.cli.base import CANNOT_GO_ON, command, err, out
from ctxval.cli.commands import app
from ctxval.cli.options import AsJson, PartOptions, Target, named_values, parsed
from ctxval.config.settings import read_settings
from ctxval.core.labels import labels_of
from ctxval.errors import ExecutionError, InputError
from ctxval.fitting.excitation import Excitation, SignalKind

Folder = Annotated[Path, typer.Option("--out", help="Folder of the recordings, one CSV file for each execution.")]
Runs = Annotated[int, typer.Option(min=1, help="Number of executions, including those that are in the folder already.")]
Kind = Annotated[str, typer.Option("--kind", help=f"Kind of the signal: {', '.join(get_args(SignalKind))}.")]
Amplitude = Annotated[
    str, typer.Option(help="Largest magnitude of the signal: one number, or a list such as [1.0, 0.5].")
]
InputLimits = Annotated[
    str | None,
    typer.Option(
        "--limits",
        help="Limits of the inputs: one number for all of them, or a list of pairs such as [[0, 8], [-2, 2]] (default: "
        "those of the controllers).",
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the tasks and signals.")]


@app.command()
@command
def collect(
    target: Target,
    amplitude: Amplitude,
    folder: Folder = Path("logs"),
    runs: Runs = 10,
    kind: Kind = "multisine",
    limits: InputLimits = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    option: PartOptions = None,
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
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made: {error.strerror}.") from error
    recorded, failed, known = list[str](), list[dict[str, Any]](), 0
    for number in range(runs):
        path = folder / f"run{number:04d}.csv"
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
    if not as_json:
        out.say(f"{len(recorded)} executions recorded in {folder}, {known} were there before, {len(failed)} failed.")
    report = {"recorded": recorded, "known": known, "failed": failed, "folder": str(folder)}
    return (report, CANNOT_GO_ON) if failed and not recorded and not known else report
