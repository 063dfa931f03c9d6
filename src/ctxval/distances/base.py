"""What the ready-made distances share: a norm, a selection of states, and what makes different states comparable."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite
from ctxval._util.checked import Norm
from ctxval.core.components import NamedStates, require_indices, selected
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError


@dataclass(frozen=True)
class StateNorm(NamedStates):
    """A norm of differences between states.

    Each difference is multiplied by its weight, divided by its scale, and then enters the norm. With a scale in the
    unit of its state, such as 0.1 m and 0.05 rad, differences of one scale count the same.

    Attributes:
        norm: order of the norm: 1, 2 or infinity.
        components: the states that are compared, by index or by the name in the experiment; all states by default.
        weights: one number >= 0 for each compared state; 1 by default.
        scales: the unit of comparison of each compared state, a positive number; 1 by default.
        angles: the states that are angles in radians, by index or name: the difference is taken on the circle, so it
            is at most pi.
    """

    norm: Norm = 1
    components: Sequence[int | str] | None = None
    _: KW_ONLY
    weights: Sequence[float] | None = None
    scales: Sequence[float] | None = None
    angles: Sequence[int | str] = ()

    def __post_init__(self) -> None:
        if self.components is not None and not len(self.components):
            raise InputError("components must name at least one state; leave it out to compare all states.")
        require_numbers("weights", self.weights, self.components, zero=True)
        require_numbers("scales", self.scales, self.components, zero=False)

    @property
    def factors(self) -> Array | None:
        """The factor of the difference of each compared state, shape ``(k,)``; None if all are 1."""
        weights, scales = (np.asarray(1.0 if given is None else given) for given in (self.weights, self.scales))
        factors = np.asarray(weights / scales, dtype=np.float64)
        return None if (factors == 1).all() else factors

    def difference(self, states: Array, others: Array) -> Array:
        """Return the weighted differences ``states - others`` of the compared states; the leading axes broadcast."""
        gap = selected(self.unwrapped(states - others), self.components)
        counts = [len(given) for given in (self.weights, self.scales) if given is not None]
        if set(counts) - {gap.shape[-1]}:
            raise ShapeError(f"there must be a weight or a scale for each of {gap.shape[-1]} states, got {counts[0]}.")
        factors = self.factors
        return gap if factors is None else gap * factors

    def unwrapped(self, gap: Array) -> Array:
        """Return differences of states ``(..., n)``; those of angles are moved to at most pi in magnitude."""
        if not len(self.angles):
            return gap
        moved = np.array(gap)
        angles = require_indices("angles", self.angles, gap.shape[-1])
        moved[..., angles] = turned(gap[..., angles])
        return moved

    def mixed_units(self, units: Sequence[str]) -> tuple[str, ...]:
        """Return the units of states that the norm adds although they differ; none if it has weights or scales."""
        if self.weights is not None or self.scales is not None:
            return ()
        compared = range(len(units)) if self.components is None else self.components
        places = [i for i in compared if not isinstance(i, str) and -len(units) <= i < len(units)]
        distinct = dict.fromkeys(units[i] for i in places if units[i])
        return tuple(distinct) if len(distinct) > 1 else ()

    def describe(self) -> dict[str, Any]:
        names = [field.name for field in dataclasses.fields(self)]
        described = {name: getattr(self, name) for name in names if name not in ("weights", "scales", "angles")}
        factors = self.factors
        if factors is not None:
            described["factors"] = factors
        return described | ({"angles": self.angles} if self.angles else {})


@dataclass(frozen=True)
class ErrorNorm(StateNorm, ABC):
    """Norm of an error vector of the trajectories of one task; see :class:`StateNorm` for the attributes."""

    @abstractmethod
    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the error vector, shape ``(..., k)``; the distance is its norm."""

    def compose(self, error: Array) -> Array:
        """Return the norms of error vectors ``(..., k)``, shape ``(...)``."""
        return np.asarray(np.linalg.norm(error, self.norm, axis=-1))

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return self.compose(self.error(model_trajectory, system_trajectory, task))


def turned(angles: Array) -> Array:
    """Return angles in radians, moved by whole turns to at most pi in magnitude; smaller ones are unchanged."""
    return np.asarray(angles - 2 * np.pi * np.round(angles / (2 * np.pi)))


def require_numbers(name: str, given: ArrayLike | None, components: Sequence[int | str] | None, *, zero: bool) -> None:
    """Check that an option is None, or a list of positive numbers (some 0 with ``zero``), one for each component."""
    if given is None:
        return
    array = as_finite(name, given)
    if array.ndim != 1 or not array.size or (components is not None and len(array) != len(components)):
        wanted = "state" if components is None else f"of {len(components)} states"
        raise ShapeError(f"{name} must be a list with one number for each {wanted}, got {given!r}.")
    valid = (array >= 0).all() and array.any() if zero else (array > 0).all()
    if not valid:
        wanted = "numbers >= 0, not all of them 0" if zero else "positive numbers"
        raise InputError(f"{name} must be {wanted}, got {given!r}.")
