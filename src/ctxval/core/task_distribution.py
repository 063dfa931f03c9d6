"""The distribution of the tasks over a task space, if it is not the uniform one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy

from ctxval._util.arrays import Array, ArrayLike, as_finite, as_floats
from ctxval._util.describe import describe
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import shortened
from ctxval.errors import InputError

Sampler = Callable[[np.random.Generator, int], ArrayLike]
"""``(rng, n)`` -> n independent tasks, rows ``(n, d)`` in the units of the task space."""


@runtime_checkable
class Continuous(Protocol):
    """A distribution of one parameter, such as a frozen distribution of ``scipy.stats``; arrays broadcast."""

    def cdf(self, x: Any) -> Any:
        """Return the probability of values up to x."""

    def sf(self, x: Any) -> Any:
        """Return the probability of values above x."""

    def ppf(self, q: Any) -> Any:
        """Return the inverse of ``cdf``."""

    def isf(self, q: Any) -> Any:
        """Return the inverse of ``sf``."""


@dataclass(frozen=True, eq=False)
class Normal(ShortRepr):
    """The normal distribution of a task parameter, with a mean and a deviation, numbers or one for each component.

    They are in the parameter's units, and hold before the task space truncates the distribution to the parameter's
    bounds. Values ``(...)`` of a number, or ``(..., k)`` of a vector, give probabilities of their shape.

    Raises:
        InputError: if a deviation is not positive, or a number not finite.
    """

    mean: ArrayLike
    deviation: ArrayLike

    def __post_init__(self) -> None:
        as_finite("the mean of a normal distribution", self.mean)
        if not (as_finite("the deviation of a normal distribution", self.deviation) > 0).all():
            raise InputError(f"the deviation of a normal distribution must be positive, got {self.deviation!r}.")

    def cdf(self, x: ArrayLike) -> Array:
        """Return the probability of values up to x."""
        return np.asarray(scipy.special.ndtr((np.asarray(x) - np.asarray(self.mean)) / np.asarray(self.deviation)))

    def sf(self, x: ArrayLike) -> Array:
        """Return the probability of values above x."""
        return np.asarray(scipy.special.ndtr((np.asarray(self.mean) - np.asarray(x)) / np.asarray(self.deviation)))

    def ppf(self, q: ArrayLike) -> Array:
        """Return the value that is exceeded with probability 1 - q."""
        return np.asarray(self.mean + np.asarray(self.deviation) * scipy.special.ndtri(q))

    def isf(self, q: ArrayLike) -> Array:
        """Return the value that is exceeded with probability q."""
        return np.asarray(self.mean - np.asarray(self.deviation) * scipy.special.ndtri(q))

    def describe(self) -> dict[str, Any]:
        """Return what identifies the distribution in a store."""
        return {name: as_floats(name, getattr(self, name)).tolist() for name in ("mean", "deviation")}


@dataclass(frozen=True, eq=False)
class ByParameter:
    """Independent task parameters: of some columns, truncated to their bounds; all others are uniform."""

    low: Array
    high: Array
    columns: Mapping[str, slice]
    distributions: Mapping[str, Continuous]

    def __post_init__(self) -> None:
        for name, marginal in self.distributions.items():
            continuous = not _of_scipy(marginal) or hasattr(getattr(marginal, "dist", None), "pdf")
            if not (isinstance(marginal, Continuous) and continuous):
                wanted = "a Normal or a frozen continuous distribution of scipy.stats, as scipy.stats.expon(scale=2.0)"
                raise InputError(f"the distribution of {name} must be {wanted}, got {marginal!r}.")
            low, high = self.low[self.columns[name]], self.high[self.columns[name]]
            try:
                mass = np.maximum(marginal.cdf(high) - marginal.cdf(low), marginal.sf(low) - marginal.sf(high))
                mass = np.broadcast_to(mass, low.shape)
            except ValueError:
                wanted = f"one component or {len(low)}"
                raise InputError(f"the distribution of {name} must have {wanted}, got {marginal!r}.") from None
            if not (mass > 1e-12).all():
                raise InputError(f"the distribution of {name} has no probability within its bounds.")

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Return n independent tasks, rows ``(n, d)`` in the units of the task space."""
        shares = rng.random((n, len(self.low)))
        points = self.low + shares * (self.high - self.low)
        for name, marginal in self.distributions.items():
            at = self.columns[name]
            low, high, share = self.low[at], self.high[at], shares[:, at]
            below, above = marginal.cdf(low), marginal.sf(high)
            from_below = marginal.ppf(below + share * (marginal.cdf(high) - below))
            from_above = marginal.isf(above + (1 - share) * (marginal.sf(low) - above))
            # Above the median, because ``cdf`` is rounded to 1 there.
            quantiles = as_floats("a task", np.where(below > 0.5, from_above, from_below))
            points[:, at] = np.clip(quantiles, low, high)
        return points

    def describe(self) -> dict[str, Any]:
        """Return the distribution of each parameter that has one, by name: what identifies it in a store."""

        def described(marginal: Any) -> dict[str, Any]:
            if isinstance(marginal, Normal):
                return {"type": "normal", **marginal.describe()}
            if not _of_scipy(marginal):
                return dict(describe(marginal))
            settings = describe({"arguments": list(marginal.args), "options": dict(marginal.kwds)})
            return {"type": f"scipy.stats.{marginal.dist.name}", **settings}

        return {name: described(marginal) for name, marginal in self.distributions.items()}


@dataclass(frozen=True, eq=False)
class BySampler:
    """Tasks that a function draws."""

    low: Array
    high: Array
    sampler: Sampler

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Return n independent tasks, rows ``(n, d)`` in the units of the task space."""
        points = as_finite("what the sampler of tasks returns", self.sampler(rng, n))
        if points.shape != (n, len(self.low)):
            raise InputError(f"the sampler of tasks must return the shape ({n}, {len(self.low)}), got {points.shape}.")
        if ((points < self.low) | (points > self.high)).any():
            raise InputError("the sampler of tasks returned a task outside the bounds of the task space.")
        return points

    def describe(self) -> dict[str, Any]:
        """Return the description of the code of the sampler."""
        return {"sampler": describe(self.sampler)}


TaskDistribution = ByParameter | BySampler


def distribution_text(described: object) -> str:
    """Return a distribution of tasks as a text for a person, from its description in a store."""
    if not isinstance(described, Mapping):
        return shortened(str(described), 400)
    if "sampler" in described:
        sampler = described["sampler"]
        name = sampler.get("function", sampler.get("type")) if isinstance(sampler, Mapping) else sampler
        return shortened(f"tasks from the sampler {name}", 400)
    texts = []
    for name, marginal in described.items():
        text = str(marginal)
        if isinstance(marginal, Mapping):
            numbers = (f"{key} {value}" for key, value in marginal.items() if key != "type" and value not in ([], {}))
            text = f"{marginal.get('type')} ({', '.join(numbers)})"
        texts.append(f"{name} {text}")
    return shortened(", ".join([*texts, "all else uniform"]), 400)


def _of_scipy(distribution: object) -> bool:
    return hasattr(distribution, "dist") and hasattr(distribution, "kwds")
