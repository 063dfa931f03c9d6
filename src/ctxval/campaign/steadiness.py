"""A test of tasks before they are executed: whether their distance is that of the tasks next to them.

A design that ends by chance, such as one that rounding errors stop, gives nearly equal tasks different controllers. A
search for the largest distance would find such chances, which nobody meets again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.progress import stage
from ctxval.core.model import Model
from ctxval.core.rollout import rollout
from ctxval.learning.closed_loops import LoopPlanner

_BESIDE = 1e-9
"""Distance of a task from the one next to it, as a share of each range."""
_AGREES = 0.05
"""Largest difference of their distances, as a share of the largest one, or of their loops, as a share of the ranges."""
_PUSH = 0.01
"""The disturbance of M in each step, as a share of the range of each state."""
_MOVES = 1e-6 * 2.0 ** np.arange(12)
"""Standard deviations of the moves away from a task that is not steady, as shares of the ranges."""
_TESTED = 24
"""Largest number of tasks that are tested for one choice."""


@dataclass(frozen=True, eq=False)
class Steadiness:
    """Tells for one choice which tasks may be executed, and counts the others.

    Attributes:
        planner: designs controllers; S is never executed.
        expected: points ``(m, d)`` -> predicted distances ``(m,)``; None if nothing is predicted: then the closed loops
            of a slightly disturbed M are compared.
    """

    planner: LoopPlanner
    expected: Callable[[Array], Array] | None = None

    _tested: dict[bytes, bool] = field(default_factory=dict, init=False)

    @property
    def rejected(self) -> int:
        """The number of tasks that are not steady."""
        return sum(not steady for steady in self._tested.values())

    def __call__(self, point: Array) -> bool:
        """Return whether rounding a task ``(d,)``, or moving it by 1e-9 of its ranges, hardly changes its distance.

        After too many tests it is false, and the task does not count as rejected.
        """
        key = point.tobytes()
        if key not in self._tested:
            if len(self._tested) >= _TESTED:
                return False
            rounded = self.planner.validation.space.rounded(point)
            beside = np.where(rounded > 0.5, rounded - _BESIDE, rounded + _BESIDE)
            with stage("testing a task", unit="designs"):
                self._tested[key] = self._alike(np.stack([point, rounded, beside]))
        return self._tested[key]

    def moved(self, point: Array, rng: np.random.Generator) -> Array:
        """Return a steady task next to a task that is not steady; the task itself if none is found."""
        moves = _MOVES[:, None] * rng.normal(size=(len(_MOVES), len(point)))
        found = next(filter(self, np.clip(point + moves, 0, 1)), None)
        if found is None:
            self._tested[point.tobytes()] = True  # it is executed, and so not rejected
        return point if found is None else found

    def _alike(self, points: Array) -> bool:
        """Return whether tasks ``(m, d)`` have the same distance, or none of them a known one."""
        try:
            shares = self._pushed_loops(points) if self.expected is None else self._expected_shares(points)
        except (Exception, SystemExit):  # the user's own parts; their failure is reported when the task is planned
            return True
        known = np.isfinite(shares).all(axis=1)
        return not known.any() or bool(known.all() and (np.ptp(shares, axis=0) <= _AGREES).all())

    def _expected_shares(self, points: Array) -> Array:
        """Return the predicted distances, as shares of the largest one, ``(m, 1)``."""
        assert self.expected is not None
        values = self.expected(points)
        return np.asarray(values[:, None] / max(values[np.isfinite(values)].max(initial=0.0), 1e-300))

    def _pushed_loops(self, points: Array) -> Array:
        """Return the states of the disturbed M, in ranges of the states of M, ``(m, (H + 1) n)``; NaN if unknown."""
        found = list[tuple[Rows, Array]]()
        for one in self.planner.plan(points):
            ranges = np.ptp(one.promised.states.reshape(-1, one.promised.states.shape[-1]), axis=0)
            ranges = np.maximum(ranges, 1e-3 * ranges.max())
            loops = rollout(_Pushed(self.planner.validation.model, _PUSH * ranges).step, one.controller, one.task)
            found.append((one.rows, (loops.states / ranges).reshape(len(one.rows), -1)))
        shares = np.full((len(points), max((rows.shape[1] for _, rows in found), default=1)), np.nan)
        for rows, states in found:
            shares[rows] = states
        return shares


@dataclass(frozen=True, eq=False)
class _Pushed:
    """A model that is pushed by the same amount ``(n,)`` in each step."""

    model: Model
    push: Array

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return np.asarray(self.model.step(x, u) + self.push)
