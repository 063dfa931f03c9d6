"""The paper's systems. Each module reads like a script that uses the public interface."""

from __future__ import annotations

import inspect
from typing import Any

from ctxval import Experiment
from ctxval._util.registry import Registry, construct
from ctxval.errors import InputError, UnknownNameError

NAMES: dict[str, str] = {
    "pendulum": "inverted pendulum, learned linear model, iLQR to a goal angle (1-D)",
    "pendulum-noisy": "the pendulum with an encoder, noise and a torque that acts late (1-D)",
    "arm": "2-DoF arm in MuJoCo; network, Gaussian process or linear model; iLQR to a point on the table (2-D)",
    "dubins": "Dubins car, learned linear model, LQR along ten sine waves (11-D)",
    "linear": "random linear systems and models with n = 1 to 10 states, random feedback (2 n-D)",
}
"""The cases of this package, each the function ``experiment`` of the module of its name, and what each is."""

__all__ = ["NAMES", "REGISTRY", "by_name", "options_of"]

REGISTRY: Registry[Experiment] = Registry(
    "case", "ctxval.cases", modules={name: f"{__name__}.{name.replace('-', '_')}:experiment" for name in NAMES}
)
"""The cases that are found by name: those of this package, and those that installed packages add."""


def by_name(name: str, /, seed: int = 0, **options: Any) -> Experiment:
    """Return a case; its seed draws the data and so the model.

    Raises:
        InputError: if the case makes no experiment.
    """
    taken = options_of(name)
    for option in options:
        if option not in taken:
            raise UnknownNameError.among(f"option of the case {name!r}", option, taken)
    case = construct(f"the case {name}", REGISTRY.find(name), options, seed)
    if not isinstance(case, Experiment):
        raise InputError(f"the case {name!r} must make an Experiment, got {type(case).__name__}.")
    return case


def options_of(name: str) -> dict[str, Any]:
    """Return the options of a case with their defaults, ``inspect.Parameter.empty`` if there is none.

    Raises:
        InputError: if the case is no function of a seed.
    """
    case = REGISTRY.find(name)
    try:
        parameters = list(inspect.signature(case).parameters.values())[1:]  # the first one is the seed
    except (TypeError, ValueError) as error:
        raise InputError(f"the case {name!r} must be a function of a seed and its options: {error}.") from error
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return {parameter.name: parameter.default for parameter in parameters if parameter.kind not in variadic}
