"""The paper's systems, each readable as a script on the public interface."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

from ctxval import Experiment
from ctxval.errors import UnknownNameError

NAMES: dict[str, str] = {
    "pendulum": "inverted pendulum, learned linear model, iLQR to a goal angle (1-D)",
    "arm": "2-DoF arm in MuJoCo; network, Gaussian process or linear model; iLQR to a point on the table (2-D)",
    "dubins": "Dubins car, learned linear model, LQR along ten sine waves (11-D)",
    "linear": "random linear systems and models with n = 1 to 10 states, random feedback (2 n-D)",
}
"""The cases that the command line knows, and what each is."""

__all__ = ["NAMES", "by_name"]


def by_name(name: str, /, seed: int = 0, **options: Any) -> Experiment:
    """Return a case; its seed draws the data and so the model.

    Raises:
        UnknownNameError: there is no such case, or it has no such option; the message has the nearest name.
        InputError: the value of an option is not allowed.
    """
    if name not in NAMES:
        raise UnknownNameError.among("case", name, NAMES)
    build = importlib.import_module(f"ctxval.cases.{name}").experiment
    taken = list(inspect.signature(build).parameters)[1:]
    for option in options:
        if option not in taken:
            raise UnknownNameError.among(f"option of the case {name!r}", option, taken)
    case: Experiment = build(seed, **options)
    return case
