"""What the commands share that learn models and write them to files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.cli.base import out
from ctxval.cli.outputs import require_outputs
from ctxval.config.references import reference, require_function
from ctxval.fitting import FittedParameter
from ctxval.fitting.model_file import BESIDE, require_suffix

StepFunction = Annotated[
    str | None,
    typer.Option(
        "--step", metavar="MODULE:ATTR", help="Your function (x, u, theta) -> x_next, whose parameters are estimated."
    ),
]
Parameters = Annotated[
    list[str] | None,
    typer.Option(
        "--parameter",
        metavar="NAME=[LOW, HIGH]",
        help="Bounds of a parameter of --step, such as mass=[0.5, 2.0]. Repeat --parameter in the order of theta.",
    ),
]
Vectorized = Annotated[bool, typer.Option("--vectorized", help="State that --step takes whole batches of x and u.")]


def step_function(step: str | None) -> Any:
    """Return the function that --step names; None if there is none."""
    return None if step is None else require_function(f"--step {step}", reference(step), "(x, u, theta) -> x_next")


def require_model_file(path: Path | None, inputs: Iterable[object], *, force: bool) -> None:
    """Check that the file of a model and those beside it can be written, before anything is learned or executed."""
    if path is None:
        return
    require_suffix(path)
    beside = {f"FILE{suffix}": path.with_suffix(suffix) for suffix in BESIDE}
    require_outputs({"--out": path, **beside}, inputs, force=force)


def print_parameters(parameters: Sequence[FittedParameter]) -> None:
    """Print parameters with their intervals."""
    for found in parameters:
        note = f"; {found.note}" if found.note else ""
        between = f"between {found.low:.6g} and {found.high:.6g} with confidence 0.95{note}"
        out.say((found.name, "bold"), f" = {found.value:.6g}, {between}")
