"""What the commands share that learn models and write them to files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval._util.files import make_folder_of
from ctxval.cli.base import out
from ctxval.config.references import reference, require_function
from ctxval.errors import InputError
from ctxval.fitting import FittedParameter
from ctxval.fitting.model_file import require_suffix

Vectorized = Annotated[bool, typer.Option("--vectorized", help="State that --step takes whole batches of x and u.")]


def step_function(step: str | None) -> Any:
    """Return the function that --step names; None if there is none.

    Raises:
        InputError: if there is no such function.
    """
    return None if step is None else require_function(f"--step {step}", reference(step), "(x, u, theta) -> x_next")


def require_writable(path: Path | None) -> None:
    """Check that the file of a model can be written, before anything is learned or executed.

    Raises:
        InputError: if no model can be written to a file with this name, or there can be no such file.
    """
    if path is None:
        return
    require_suffix(path)
    make_folder_of(path)
    if path.is_dir():
        raise InputError(f"{path} cannot be written: it is a folder.")


def print_parameters(parameters: Sequence[FittedParameter]) -> None:
    """Print parameters with their intervals."""
    for one in parameters:
        note = f"; {one.note}" if one.note else ""
        between = f"between {one.low:.6g} and {one.high:.6g} with confidence 0.95{note}"
        out.say((one.name, "bold"), f" = {one.value:.6g}, {between}")
