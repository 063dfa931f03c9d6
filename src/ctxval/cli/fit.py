"""``ctxval fit``: learn models from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval._util.texts import shortened
from ctxval.cli.base import CANNOT_GO_ON, FALSIFIED, command, err, out, print_columns
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
from ctxval.cli.model_options import (
    Parameters,
    StepFunction,
    Vectorized,
    print_parameters,
    require_model_file,
    step_function,
)
from ctxval.cli.options import AsJson, named_values
from ctxval.cli.outputs import Force
from ctxval.config.named_model import named_model
from ctxval.errors import InputError
from ctxval.fitting import FitReport, fit
from ctxval.fitting.fit import HOLD_OUT, KINDS, STEPS
from ctxval.fitting.model_file import SUFFIXES, write_model_file

Kinds = Annotated[
    str | None,
    typer.Option(
        "--kind",
        help=f"Kinds of models with commas between them: {', '.join(KINDS)} (default: the first three, or parameters "
        "if --step is given).",
    ),
]
HoldOut = Annotated[
    float, typer.Option(help="Share of the recordings that is held out, from which no model is learned.")
]
Given = Annotated[
    str | None,
    typer.Option(
        "--given",
        metavar="MODEL",
        help="Model that exists already, whose errors stand beside those of the others: an MJCF file or the folder of "
        "a result of mujoco.sysid, or any model that `ctxval replay --model` takes.",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="File for the most accurate model that it can hold: .npz, with the recorded steps that the model was "
        "learned from, or .onnx, with these steps in a file .data.npz beside it. For the parameters of --step: .toml, "
        "the table model of an experiment file.",
    ),
]


@app.command("fit")
@command
def fit_models(
    logs: Logs,
    kind: Kinds = None,
    step: StepFunction = None,
    parameter: Parameters = None,
    vectorized: Vectorized = False,
    mapping: MappingFile = None,
    state: States = None,
    input_: Inputs = None,
    time: TimeField = None,
    dt: Dt = None,
    delay: Delay = None,
    given: Given = None,
    hold_out: HoldOut = HOLD_OUT,
    steps: Steps = None,
    out_file: Out = None,
    force: Force = False,
    seed: RandomSeed = 0,
    as_json: AsJson = False,
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
    require_model_file(out_file, [*logs, mapping, given], force=force)
    found = LogOptions(mapping, state, input_, time, dt, delay).read(logs)
    report = fit(
        found,
        [name.strip() for name in kinds],
        step=step_function(step),
        bounds=bounds,
        vectorized=vectorized,
        given=None if given is None else named_model(given, {}, found.dt),
        hold_out=hold_out,
        steps=STEPS if steps is None else numbers(steps),
        seed=seed,
    )
    if not as_json:
        print_breaks(found)
        _print(report)
    written, chosen = list[str](), None
    if report.fitted and out_file is not None:
        suffix, kinds_learned = out_file.suffix, ", ".join(model.kind for model in report.fitted)
        holds = (m for m in report.fitted if m.kind != "given" and isinstance(m.model, SUFFIXES[suffix]))
        chosen = next(holds, None)
        if chosen is None:
            raise InputError(
                f"no model that was learned ({kinds_learned}) can be written to a file that ends in {suffix}."
            )
        written = write_model_file(out_file, chosen.model, step)
        if not as_json:
            out.say(f"the {chosen.kind} model is in {' and '.join(written)}")
    result = {**report.to_json(), "files": written}
    if not report.fitted:
        return result, CANNOT_GO_ON
    best = (
        next((each for each in report.fitted if each.kind != "given"), report.fitted[0]) if chosen is None else chosen
    )
    if best.useless is None:
        return result
    if not as_json:
        err.say(("not good: ", "bold red"), f"{best.useless}.", wrap=True)
    return result, FALSIFIED


def _print(report: FitReport) -> None:
    held, own = report.held_out, report.learned_from
    out.say(
        f"learned from {own.steps} steps of {len(own.runs)} recordings; errors on {held.steps} steps of "
        f"{len(held.runs)} others"
    )
    rows = [
        (
            model.kind,
            error.state,
            str(error.steps),
            f"{error.rms:.3g} {error.unit}".rstrip(),
            f"{100 * error.relative:.3g} %",
        )
        for model in report.fitted
        for error in sorted(model.errors, key=lambda error: list(held.states).index(error.state))
    ]
    columns = ("steps", "rms error", "of the change")
    print_columns(("model", "state"), columns, rows, "error on held-out recordings")
    for model in report.fitted:
        print_parameters(model.parameters)
        for note in model.notes:
            out.say((f"{model.kind}: ", "bold"), note, wrap=True)
    for failure in report.failed:
        err.say((f"{failure.kind}: ", "yellow"), shortened(failure.reason))
