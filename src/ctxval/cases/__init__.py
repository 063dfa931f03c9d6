"""The paper's systems, each readable as a script on the public interface."""

from __future__ import annotations

import importlib
from typing import Any

from ctxval.errors import InputError, UnknownNameError
from ctxval.experiment import Experiment

NAMES: dict[str, str] = {
    "pendulum": "inverted pendulum, learned linear model, iLQR to a goal angle (1-D)",
}
"""The cases that the command line knows, and what each is."""

__all__ = ["NAMES", "by_name"]


def by_name(name: str, seed: int = 0, **options: Any) -> Experiment:
    """Return a case; its seed draws the data and so the model.

    Raises:
        UnknownNameError: there is no such case; the message has the nearest name.
        InputError: the case does not take these options.
    """
    if name not in NAMES:
        raise UnknownNameError.among("case", name, NAMES)
    build = importlib.import_module(f"ctxval.cases.{name}").experiment
    try:
        case: Experiment = build(seed, **options)
    except TypeError as error:
        raise InputError(f"case {name!r}: {error}.") from error
    return case
