"""Climbs on a prediction: executions go where much is predicted, or where the prediction may be wrong upwards.

What is maximised is ``d_hat(p) exp(g(p)) (1 + kappa w(p))``: the predicted value, corrected by a Gaussian process g of
the logarithmic discrepancy at known points, and raised by the doubt w in what leads to it. A climb trusts it inside a
box around its best point; the box grows where the prediction was right, and shrinks where it was wrong. A climb that
promises nothing more, or misses, ends, and the next starts where neither points nor dynamics are covered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Mask, single_threaded
from ctxval._util.registry import part
from ctxval.errors import InputError
from ctxval.gp import regression as gp
from ctxval.gp.ascent import Ascent
from ctxval.gp.kernels import Matern
from ctxval.gp.surrogate import fit_surrogate
from ctxval.searches.base import Note, Prediction, SequentialSearch, best_first
from ctxval.searches.bayesian_optimisation import Scalar

_RIGHT = 0.1
"""A prediction within this share of the value is right."""
_LOOKS = 400
"""Points to look at for each dimension, if the budget allows."""
_NEW_RADIUS, _LEAST_RADIUS = 0.4, 0.02
_PROMISING = 1e-3
"""The least promised improvement worth an execution, as a share of the largest value."""
_PATIENCE = 10.0
"""How much more optimistic than its steps a climb is about where it leads in the end."""
_MOST_OPTIMISM = 100.0
"""The largest kappa that errors may lead to."""
_JUDGED = 6
"""Known values from which on the prediction must be better than the scalar surrogate."""
_GOOD_ENOUGH = 0.1
"""A prediction that is mostly right within this share needs no comparison."""
_COMPARED = 24
"""Known values that the two are compared on at most, the last ones."""
_DISTINCT, _APART = 1e-6, 0.05
"""A point is never repeated, up to this much in a coordinate; pending and failed ones are kept away from by this share
of the cube's diagonal."""


@dataclass(frozen=True, eq=False)
class _Climb:
    """Where a climb stands: what its notes and values say.

    Attributes:
        number: from 0.
        radius: half the width of its box; 1 for the whole cube.
        best, point: its largest value and where; minus infinity and None before it has one.
        misses: executions without improvement, one after the other.
        stale: climbs without improvement of the largest value of all, one after the other.
    """

    number: int = 0
    radius: float = 1.0
    best: float = -np.inf
    point: Array | None = None
    misses: int = 0
    stale: int = 0


@part("climbs")
class Climbs(SequentialSearch):
    """Trust-region climbs with restarts on a prediction of the values; the scalar search where there is none any good.

    Args:
        optimism: kappa; by how much a value may exceed its prediction, as a share of it, where the doubt is 1. After
            three executions it is what they showed, but never less.
        misses: executions without improvement after which a climb ends.

    Raises:
        InputError: the optimism is negative, or no miss is allowed.
    """

    initial = 1

    def __init__(self, optimism: float = 2.0, misses: int = 3) -> None:
        if not 0 <= optimism < float("inf"):
            raise InputError(f"optimism must not be negative or infinite, got {optimism!r}.")
        if misses < 1:
            raise InputError(f"a climb must be allowed at least one miss, got {misses}.")
        self.optimism = optimism
        self.misses = misses

    def reset(self, dimension: int, seed: int) -> None:
        """Forget everything and start on the unit cube of this dimension."""
        super().reset(dimension, seed)
        self._prediction: Prediction | None = None
        self._fallback = Scalar(initial=1)
        self._fallback.reset(dimension, seed)

    def use_prediction(self, prediction: Prediction | None) -> None:
        """Take what is expected before the next question; None where nothing is."""
        self._prediction = prediction

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the point that promises most."""
        prediction, why = self._prediction, "there is no prediction"
        while prediction is not None:
            with single_threaded():
                doubtful = self._why_not(prediction)
                point = self._climb(prediction, rng) if doubtful is None else None
            if point is not None:
                return point
            why = doubtful or "nothing is predicted anywhere"
            prediction = None if prediction.otherwise is None else prediction.otherwise()
        return self._scalar(rng, why)

    def _scalar(self, rng: np.random.Generator, why: str) -> Array:
        point, thought = self._fallback.choose(self.points, self.values, rng)
        self._thought = {**thought, "why": why}
        return point

    # How good the prediction is

    def _why_not(self, prediction: Prediction) -> str | None:
        """Return why the prediction is not used; None where it is."""
        known = np.isfinite(self.values)
        values = self.values[known]
        if len(values) < _JUDGED:
            return None
        rows = np.arange(len(values))[-_COMPARED:]
        error = _log_error(prediction.left_out(rows), values[rows])
        if error <= _GOOD_ENOUGH:
            return None
        scalar = _log_error(_left_out(self.points[known], values)[rows], values[rows])
        if error <= scalar:
            return None
        return f"leaving one out, the prediction errs by {error:.2g} where the surrogate errs by {scalar:.2g}"

    # Climbing

    def _climb(self, prediction: Prediction, rng: np.random.Generator) -> Array | None:
        """Return the next point of the last climb, or of a new one; None where nothing is predicted."""
        climb = self._state()
        optimism = self._calibrated()
        promise = _Promise(prediction, self._discrepancy(prediction), optimism)
        largest = float(np.nanmax(self.values, initial=0.0))
        if climb.misses < self.misses and climb.radius >= _LEAST_RADIUS:
            point = self._best(promise, climb, prediction.budget, rng)
            # A climb from elsewhere may pass through what is lower, unless that surely leads to nothing larger.
            patient = replace(promise, optimism=_PATIENCE * optimism)
            if point is not None and promise.more_than(climb.best, point) and patient.more_than(largest, point):
                return self._noted(prediction, point, climb)
        # Ever more weight on what is not known, for as long as nothing larger is found.
        bold = replace(promise, optimism=optimism * 4.0 ** (1 + climb.stale))
        point = self._best(bold, _Climb(), prediction.budget, rng)
        return None if point is None else self._noted(prediction, point, _Climb(climb.number + 1, _NEW_RADIUS))

    def _discrepancy(self, prediction: Prediction) -> gp.GaussianProcess | None:
        """Return the GP of log d - log d_hat over the points, on a scale that suits heavy tails; None without any."""
        known = np.isfinite(self.values)
        if not known.any():
            return None
        points, values = self.points[known], self.values[known]
        expected = prediction.expected(points)[0]
        floor = max(1e-3 * float(np.median(values)), 1e-12)
        ratio = np.log(values + floor) - np.log(np.maximum(expected, 0.0) + floor)
        usable = np.isfinite(ratio)
        if not usable.any():
            return None
        size = max(float((ratio[usable] ** 2).mean()), 1e-8)
        theta = np.log([size, 0.15 * np.sqrt(self.dimension)])
        return gp.condition(Matern(2.5), theta, points[usable], ratio[usable], noise=1e-4 * size)

    def _calibrated(self) -> float:
        """Return kappa: by how much values differed from what was expected of them, for each unit of doubt."""
        errors = [
            abs(np.log(value / note["expected"])) / note["doubt"]
            for value, note in zip(self.values.tolist(), self.notes, strict=True)
            if note is not None and note.get("doubt", 0) > 0 and value > 0 and note["expected"] > 0
        ]
        if len(errors) < 3:
            return self.optimism
        return float(np.clip(np.median(errors), self.optimism, _MOST_OPTIMISM))

    def _best(self, promise: _Promise, climb: _Climb, budget: int, rng: np.random.Generator) -> Array | None:
        """Return the most promising point in the climb's box that is not known; None where nothing is predicted."""
        centre = np.full(self.dimension, 0.5) if climb.point is None else climb.point
        low, high = np.clip(centre - climb.radius, 0, 1), np.clip(centre + climb.radius, 0, 1)
        budget = min(budget, _LOOKS * self.dimension)
        points, promised = Ascent(promise, low, high, budget).run(best_first(self.points, self.values)[:8], rng)
        new = self._is_new(points) & np.isfinite(promised)
        return points[np.argmax(new)] if new.any() else None

    def _is_new(self, points: Array) -> Mask:
        known = np.isfinite(self.values)
        new = np.ones(len(points), dtype=bool)
        for point, is_known in zip(self.points, known, strict=True):
            gap = np.abs(points - point).max(axis=1)
            far = np.linalg.norm(points - point, axis=1) > _APART * np.sqrt(self.dimension)
            new &= gap > _DISTINCT if is_known else far
        return new

    def _noted(self, prediction: Prediction, point: Array, climb: _Climb) -> Array:
        expected, doubt = prediction.expected(point[None])
        self._thought = {
            "engine": "climb",
            "climb": climb.number,
            "radius": climb.radius,
            "expected": float(expected[0]),
            "doubt": float(doubt[0]),
        }
        return point

    def _state(self) -> _Climb:
        """Return where the last climb stands."""
        climb, largest = _Climb(), -np.inf
        for point, value, note in zip(self.points, self.values.tolist(), self.notes, strict=True):
            if note is not None and note.get("engine") == "climb":
                if note["climb"] > climb.number:
                    climb = _Climb(note["climb"], note["radius"], stale=climb.stale + 1)
                climb = _after(climb, point, value, note)
            elif value > climb.best:
                climb = replace(climb, best=value, point=point)
            if value > largest * (1 + _PROMISING) or largest == -np.inf:
                climb = replace(climb, stale=0)
            largest = max(largest, value) if np.isfinite(value) else largest
        return climb


def _after(climb: _Climb, point: Array, value: float, note: Note) -> _Climb:
    """Return the climb after one of its executions."""
    if not np.isfinite(value):
        return replace(climb, misses=climb.misses + 1)
    right = abs(value - note["expected"]) <= _RIGHT * max(value, note["expected"])
    if value > climb.best * (1 + _PROMISING) or climb.point is None:
        first = climb.point is None
        grown = climb.radius if first else min(1.0, 2 * climb.radius)
        return replace(climb, best=value, point=point, misses=0, radius=grown)
    if value > climb.best:
        climb = replace(climb, best=value, point=point)
    return replace(climb, misses=climb.misses + 1, radius=climb.radius if right else climb.radius / 2)


@dataclass(frozen=True, eq=False)
class _Promise:
    """The optimistic value at points.

    Attributes:
        prediction: d_hat and w.
        discrepancy: g; None where nothing is known.
        optimism: kappa.
    """

    prediction: Prediction
    discrepancy: gp.GaussianProcess | None
    optimism: float

    def __call__(self, points: Array) -> Array:
        expected, doubt = self.prediction.expected(points)
        if self.discrepancy is not None:
            mean, variance = self.discrepancy.predict(points)
            # Where the value is known there is no doubt, whatever may be unknown of what leads to it.
            expected = expected * np.exp(mean)
            doubt = doubt * np.sqrt(variance / self.discrepancy.kernel.diagonal(self.discrepancy.theta, points))
        return np.asarray(expected * (1 + self.optimism * doubt))

    def more_than(self, value: float, point: Array) -> bool:
        """Return whether an execution at ``(d,)`` promises enough more than a value."""
        return bool(self(point[None])[0] > value * (1 + _PROMISING))


def _log_error(expected: Array, values: Array) -> float:
    """Return the mean error of the logarithm; small values count little."""
    if not np.isfinite(expected).all():
        return np.inf
    floor = max(0.1 * float(np.median(values)), 1e-12)
    return float(np.abs(np.log(np.maximum(expected, 0.0) + floor) - np.log(values + floor)).mean())


def _left_out(points: Array, values: Array) -> Array:
    """Return what the scalar surrogate expects at each point from all others."""
    surrogate = fit_surrogate(points, values)
    return np.asarray(surrogate.shift + surrogate.scale * surrogate.process.left_out()[0])
