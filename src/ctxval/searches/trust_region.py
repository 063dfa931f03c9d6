"""Trust-region search on a prediction: it executes where large values are predicted, or may be hidden by its errors.

It maximises the optimistic value ``d_hat(p) exp(g(p)) (1 + kappa w(p))``: the prediction d_hat, corrected by a Gaussian
process g of its logarithmic discrepancy at known points, and raised in proportion to its doubt w. The prediction is
trusted inside a box around the best point. The box grows if the prediction was right, and shrinks if it was wrong. If a
region promises nothing larger, or has missed several times, the next one starts where neither points nor dynamics are
known.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, single_threaded
from ctxval._util.registry import part
from ctxval.errors import InputError
from ctxval.gp.acquisition import Box
from ctxval.gp.ascent import Ascent
from ctxval.gp.kernels import Matern
from ctxval.gp.regression import GaussianProcess, condition
from ctxval.gp.surrogate import fit_surrogate
from ctxval.searches.base import Note, Prediction, SequentialSearch, best_first
from ctxval.searches.bayesian_optimisation import BayesianOptimisation

_LOG_OFFSET = 1e-3
"""The c of ``log(d + c)`` in the discrepancy, in medians of the known values."""
_ERROR_OFFSET = 0.1
"""The same in errors of predictions: small values count little."""
_LENGTH_SCALE = 0.15
"""Of the discrepancy's kernel, times the square root of the dimension."""
_NOISE = 1e-4
"""Noise variance of the discrepancy, as a share of its variance."""
_CALIBRATED = 3
"""Executions from which on the optimism is what they showed."""
_ENGINE = "climb"
"""The name of this search in notes. Stores have it, so it stays although the class has another name."""


@dataclass(frozen=True)
class TrustRegionSettings:
    """Settings of :class:`TrustRegion` that its studies vary (``benchmarks/study_ablations.py``).

    Attributes:
        correct_discrepancy: whether predictions are corrected by what they got wrong at known points.
        compare_with_surrogate: whether a prediction is used only if leave-one-out errors show that it is good.
        restrict: whether there are trust regions; if not, the whole cube is searched each time.
        accurate: a prediction within this share of the value counts as right.
        points: the most points looked at for one suggestion, for each dimension.
        first_radius: half the width of a new region.
        least_radius: a region that is smaller is left.
        improvement: the least promised improvement worth an execution, as a share of the largest value.
        patience: how much more optimistic the search is of where a region leads in the end than of its next point.
        boldness: by how much the optimism grows with each restart that has found nothing larger.
        most_optimism: the largest optimism that errors of predictions may lead to.
        compared_from: known values from which on the prediction must be better than the surrogate.
        compared_on: the most known values, the last ones, on which the two are compared.
        good_enough: a prediction whose mean error is at most this share needs no comparison.
        distinct: how far a suggestion is from each known point, in one coordinate at least.
        apart: how far it is from pending and failed points, as a share of the cube's diagonal.
    """

    correct_discrepancy: bool = True
    compare_with_surrogate: bool = True
    restrict: bool = True
    accurate: float = 0.1
    points: int = 400
    first_radius: float = 0.4
    least_radius: float = 0.02
    improvement: float = 1e-3
    patience: float = 10.0
    boldness: float = 4.0
    most_optimism: float = 100.0
    compared_from: int = 6
    compared_on: int = 24
    good_enough: float = 0.1
    distinct: float = 1e-6
    apart: float = 0.05


@dataclass(frozen=True, eq=False)
class _Region:
    """The state of a trust region, as its notes and values tell it.

    Attributes:
        number: from 0.
        radius: half its width; 1 for the whole cube.
        best, point: its largest value and where that is; minus infinity and None before there is one.
        misses: executions without improvement, one after the other.
        stale: regions without improvement of the largest value of all, one after the other.
    """

    number: int = 0
    radius: float = 1.0
    best: float = -np.inf
    point: Array | None = None
    misses: int = 0
    stale: int = 0

    def box(self, dimension: int) -> Box:
        """Return its bounds within the unit cube."""
        centre = np.full(dimension, 0.5) if self.point is None else self.point
        return np.clip(centre - self.radius, 0, 1), np.clip(centre + self.radius, 0, 1)


@part("trust-region", aliases=("climbs",))
class TrustRegion(SequentialSearch):
    """Trust-region search with restarts on a prediction of the values; Bayesian optimisation if no prediction is good.

    Args:
        optimism: kappa; by how much a value may exceed its prediction, as a share of it, if the doubt is 1. After
            three executions it is what they showed, but never less.
        misses: executions without improvement after which a region is left.
        settings: what else the search does by default, for studies.

    Raises:
        InputError: the optimism is negative, or no miss is allowed.
    """

    initial = 1

    def __init__(self, optimism: float = 2.0, misses: int = 3, *, settings: TrustRegionSettings | None = None) -> None:
        if not 0 <= optimism < float("inf"):
            raise InputError(f"optimism must not be negative or infinite, got {optimism!r}.")
        if misses < 1:
            raise InputError(f"a region must be allowed at least one miss, got {misses}.")
        self.optimism = optimism
        self.misses = misses
        self._settings = TrustRegionSettings() if settings is None else settings

    def describe(self) -> dict[str, Any]:
        """Return what identifies this search in a store: its options, and the settings if they are not the usual."""
        options = {name: value for name, value in vars(self).items() if not name.startswith("_")}
        usual = self._settings == TrustRegionSettings()
        return options if usual else {**options, "settings": asdict(self._settings)}

    def reset(self, dimension: int, seed: int) -> None:
        """Forget everything and start on the unit cube of this dimension."""
        super().reset(dimension, seed)
        self._prediction: Prediction | None = None
        self._fallback = BayesianOptimisation(initial=1)
        self._fallback.reset(dimension, seed)

    def use_prediction(self, prediction: Prediction | None) -> None:
        """Take the prediction for the next question; None if there is none."""
        self._prediction = prediction

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the point that promises most."""
        prediction, why = self._prediction, "there is no prediction"
        while prediction is not None:
            with single_threaded():
                doubtful = self._why_not(prediction)
                point = self._promising(prediction, rng) if doubtful is None else None
            if point is not None:
                return point
            why = doubtful or "nothing is predicted anywhere"
            prediction = None if prediction.otherwise is None else prediction.otherwise()
        return self._without_prediction(rng, why)

    def _without_prediction(self, rng: np.random.Generator, why: str) -> Array:
        point, thought = self._fallback.choose(self.points, self.values, rng)
        self._thought = {**thought, "why": why}
        return point

    # How good the prediction is

    def _why_not(self, prediction: Prediction) -> str | None:
        """Return why the prediction is not used; None if it is."""
        known = np.isfinite(self.values)
        values = self.values[known]
        if not self._settings.compare_with_surrogate or len(values) < self._settings.compared_from:
            return None
        rows = np.arange(len(values))[-self._settings.compared_on :]
        error = _log_error(prediction.left_out(rows), values[rows])
        if error <= self._settings.good_enough:
            return None
        surrogate = _log_error(_left_out(self.points[known], values)[rows], values[rows])
        if error <= surrogate:
            return None
        return f"leaving one out, the prediction errs by {error:.2g} where the surrogate errs by {surrogate:.2g}"

    # Where to execute next

    def _promising(self, prediction: Prediction, rng: np.random.Generator) -> Array | None:
        """Return the next point of the last region, or of a new one; None if nothing is predicted anywhere."""
        settings, optimism = self._settings, self._calibrated()
        value = _OptimisticValue(prediction, self._discrepancy(prediction), optimism)
        if not settings.restrict:
            return self._noted(prediction, self._best(value, _Region(), rng), _Region())
        region = self._state()
        if region.misses < self.misses and region.radius >= settings.least_radius:
            point = self._best(value, region, rng)
            if point is not None and self._is_worth(value, point, region.best):
                return self._noted(prediction, point, region)
        # Ever more weight on what is not known, for as long as nothing larger is found.
        bold = replace(value, optimism=optimism * settings.boldness ** (1 + region.stale))
        new = _Region(region.number + 1, settings.first_radius)
        return self._noted(prediction, self._best(bold, _Region(), rng), new)

    def _is_worth(self, value: _OptimisticValue, point: Array, best: float) -> bool:
        """Return whether an execution at ``(d,)`` promises more than a region's best value, and may lead to the top.

        A region elsewhere may lead through lower values, unless that surely leads to nothing larger.
        """
        patient = replace(value, optimism=self._settings.patience * value.optimism)
        largest = float(np.nanmax(self.values, initial=0.0))
        return self._exceeds(value, point, best) and self._exceeds(patient, point, largest)

    def _exceeds(self, value: _OptimisticValue, point: Array, other: float) -> bool:
        """Return whether an execution at ``(d,)`` promises enough more than another value."""
        return bool(value(point[None])[0] > other * (1 + self._settings.improvement))

    def _discrepancy(self, prediction: Prediction) -> GaussianProcess | None:
        """Return the GP of ``log(d + c) - log(d_hat + c)`` over the points; None if it is known nowhere."""
        known = np.isfinite(self.values)
        if not self._settings.correct_discrepancy or not known.any():
            return None
        points, values = self.points[known], self.values[known]
        expected = prediction.expected(points)[0]
        floor = max(_LOG_OFFSET * float(np.median(values)), 1e-12)
        ratio = np.log(values + floor) - np.log(np.maximum(expected, 0.0) + floor)
        usable = np.isfinite(ratio)
        if not usable.any():
            return None
        size = max(float((ratio[usable] ** 2).mean()), 1e-8)
        theta = np.log([size, _LENGTH_SCALE * np.sqrt(self.dimension)])
        return condition(Matern(2.5), theta, points[usable], ratio[usable], noise=_NOISE * size)

    def _calibrated(self) -> float:
        """Return kappa: by how much values differed from their predictions, for each unit of doubt."""
        errors = [
            abs(np.log(value / note["expected"])) / note["doubt"]
            for value, note in zip(self.values.tolist(), self.notes, strict=True)
            if note is not None and note.get("doubt", 0) > 0 and value > 0 and note["expected"] > 0
        ]
        if len(errors) < _CALIBRATED:
            return self.optimism
        return float(np.clip(np.median(errors), self.optimism, self._settings.most_optimism))

    def _best(self, value: _OptimisticValue, region: _Region, rng: np.random.Generator) -> Array | None:
        """Return the most promising new point in a region; None if nothing is predicted there."""
        budget = min(value.prediction.budget, self._settings.points * self.dimension)
        ascent = Ascent(value, *region.box(self.dimension), budget)
        points, promised = ascent.run(best_first(self.points, self.values)[:8], rng)
        new = self._is_new(points) & np.isfinite(promised)
        return np.asarray(points[np.argmax(new)]) if new.any() else None

    def _noted(self, prediction: Prediction, point: Array | None, region: _Region) -> Array | None:
        """Return the next point of a region, if any, and note what is expected there."""
        if point is None:
            return None
        expected, doubt = prediction.expected(point[None])
        self._thought = {
            "engine": _ENGINE,
            "climb": region.number,
            "radius": region.radius,
            "expected": float(expected[0]),
            "doubt": float(doubt[0]),
        }
        return point

    def _is_new(self, points: Array) -> Mask:
        known = np.isfinite(self.values)
        new = np.ones(len(points), dtype=bool)
        for point, is_known in zip(self.points, known, strict=True):
            gap = np.abs(points - point).max(axis=1)
            far = np.linalg.norm(points - point, axis=1) > self._settings.apart * np.sqrt(self.dimension)
            new &= gap > self._settings.distinct if is_known else far
        return new

    def _state(self) -> _Region:
        """Return the state of the last region."""
        region, largest = _Region(), -np.inf
        for point, value, note in zip(self.points, self.values.tolist(), self.notes, strict=True):
            if note is not None and note.get("engine") == _ENGINE:
                if note["climb"] > region.number:
                    region = _Region(note["climb"], note["radius"], stale=region.stale + 1)
                region = self._after(region, point, value, note)
            elif value > region.best:
                region = replace(region, best=value, point=point)
            if value > largest * (1 + self._settings.improvement) or largest == -np.inf:
                region = replace(region, stale=0)
            largest = max(largest, value) if np.isfinite(value) else largest
        return region

    def _after(self, region: _Region, point: Array, value: float, note: Note) -> _Region:
        """Return a region after one of its executions."""
        if not np.isfinite(value):
            return replace(region, misses=region.misses + 1)
        right = abs(value - note["expected"]) <= self._settings.accurate * max(value, note["expected"])
        if value > region.best * (1 + self._settings.improvement) or region.point is None:
            first = region.point is None
            grown = region.radius if first else min(1.0, 2 * region.radius)
            return replace(region, best=value, point=point, misses=0, radius=grown)
        if value > region.best:
            region = replace(region, best=value, point=point)
        return replace(region, misses=region.misses + 1, radius=region.radius if right else region.radius / 2)


@dataclass(frozen=True, eq=False)
class _OptimisticValue:
    """The value at points that is expected, corrected and raised by its doubt.

    Attributes:
        prediction: d_hat and w.
        discrepancy: g; None if it is not used.
        optimism: kappa.
    """

    prediction: Prediction
    discrepancy: GaussianProcess | None
    optimism: float

    def __call__(self, points: Array) -> Array:
        expected, doubt = self.prediction.expected(points)
        if self.discrepancy is not None:
            mean, variance = self.discrepancy.predict(points)
            # Where the value is known there is no doubt, whatever may be unknown of what leads to it.
            expected = expected * np.exp(mean)
            doubt = doubt * np.sqrt(variance / self.discrepancy.kernel.diagonal(self.discrepancy.theta, points))
        return np.asarray(expected * (1 + self.optimism * doubt))


def _log_error(expected: Array, values: Array) -> float:
    """Return the mean error of the logarithm; small values count little."""
    if not np.isfinite(expected).all():
        return np.inf
    floor = max(_ERROR_OFFSET * float(np.median(values)), 1e-12)
    return float(np.abs(np.log(np.maximum(expected, 0.0) + floor) - np.log(values + floor)).mean())


def _left_out(points: Array, values: Array) -> Array:
    """Return what the surrogate of the values predicts at each point from all others."""
    surrogate = fit_surrogate(points, values)
    return np.asarray(surrogate.shift + surrogate.scale * surrogate.process.left_out()[0])
