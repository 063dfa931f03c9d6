"""Models with parameters that are not known exactly: a prior of each, and models with drawn values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.model import Model
from ctxval.errors import InputError


@dataclass(frozen=True)
class UncertainParameter:
    """A parameter of a model and its prior: lognormal if the deviation is a share of the value, otherwise normal.

    A standardised value z has the prior N(0, 1), and z = 0 is the value of the model.
    """

    name: str
    value: float  #: in the model
    deviation: float  #: prior standard deviation, a share of the value if it is ``relative``
    relative: bool
    low: float = -np.inf  #: smallest possible value

    def at(self, z: Array) -> Array:
        """Return the values of standardised ones, of any shape."""
        if self.relative:
            return np.asarray(self.value * np.exp(self.deviation * z))
        return np.asarray(np.maximum(self.value + self.deviation * z, self.low))


@runtime_checkable
class UncertainModel(Model, Protocol):
    """A model that knows which of its parameters are uncertain."""

    @property
    def uncertain(self) -> Sequence[UncertainParameter]:
        """The uncertain parameters."""

    def drawn(self, z: Array) -> Model:
        """Return S models with standardised parameters ``(S, K)``, run together: a draw is the first axis of states."""


def uncertain_in(model: Model) -> UncertainModel | None:
    """Return a model with uncertain parameters unchanged; None for one without any."""
    return model if isinstance(model, UncertainModel) and len(model.uncertain) else None


def prior_of(name: str, value: float, given: float | str) -> UncertainParameter:
    """Return a parameter whose deviation is a number in its own unit or, as in ``"20 %"``, a share of its value.

    With a share, the value keeps its sign. An InputError is raised for a deviation that is not positive, and for a
    share of 0.
    """
    text = str(given).strip()
    relative = text.endswith("%")
    try:
        deviation = float(text.removesuffix("%")) / (100.0 if relative else 1.0)
    except ValueError:
        deviation = np.nan
    if not 0 < deviation < np.inf:
        raise InputError(
            f"the deviation of {name!r} must be a positive number in its own unit, or a share as '20 %', got {given!r}."
        )
    if relative and not value:
        raise InputError(f"{name!r} is 0, so its deviation must be a number in its own unit, got {given!r}.")
    return UncertainParameter(name, float(value), deviation, relative)


def priors_of(values: Mapping[str, float], given: Mapping[str, float | str] | None) -> tuple[UncertainParameter, ...]:
    """Return the uncertain ones of parameters by name; an InputError is raised for a name that is none of them."""
    unknown = [name for name in given or {} if name not in values]
    if unknown:
        raise InputError(f"{unknown[0]!r} is no parameter of the model: its parameters are {', '.join(values)}.")
    return tuple(prior_of(name, values[name], deviation) for name, deviation in (given or {}).items())
