"""Trust-region search on a prediction: it executes points where the prediction is large, or uncertain.

It maximises the optimistic value ``d_hat(p) exp(g(p)) (1 + kappa w(p))``: the prediction d_hat, corrected by a Gaussian
process g of its logarithmic discrepancy at known points, and raised in proportion to its doubt w. The prediction is
trusted inside a box around the best point. The box grows if an execution improves on the best value. It shrinks if an
execution does not and the prediction was wrong. If no improvement is predicted in a region, or if several executions
have not improved, a new region starts at the point of the whole cube with the largest optimistic value for a larger
kappa. A larger kappa favours points where neither values nor dynamics are known.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array, Mask, Rows, single_threaded
from ctxval._util.registry import part
from ctxval.errors import InputError
from ctxval.gp.acquisition import Box
from ctxval.gp.ascent import Ascent
from ctxval.gp.kernels import Matern
from ctxval.gp.regression import GaussianProcess, condition
from ctxval.gp.subset import kept_rows
from ctxval.gp.surrogate import fit_surrogate
from ctxval.searches.base import Note, Prediction, SequentialSearch, best_first
from ctxval.searches.bayesian_optimisation import BayesianOptimisation

_LOG_OFFSET = 1e-3
"""The c of ``log(d + c)`` in the discrepancy, in medians of the known values."""
_ERROR_OFFSET = 0.1
"""The c of ``log(d + c)`` in errors of predictions, in medians of the known values: small values count little."""
_LENGTH_SCALE = 0.15
"""Length-scale of the discrepancy's kernel, divided by the square root of the dimension."""
_NOISE = 1e-4
"""Noise variance of the discrepancy, as a share of its variance."""
_CALIBRATED = 3
"""Number of executions from which on the optimism is estimated from their errors."""
_REPRESENTING = 150
"""Largest number of known values from which the discrepancy and the surrogate's errors are computed."""
_FIRST = 16
"""Number of the best points of an ascent that are compared with the history first."""
_ENGINE = "climb"
"""The name of this search in notes. Existing stores contain it, so it differs from the name of the class."""


@dataclass(frozen=True)
class TrustRegionSettings:
    """Settings of :class:`TrustRegion` that its studies vary (``benchmarks/study_ablations.py``).

    Attributes:
        correct_discrepancy: whether predictions are corrected by their errors at known points.
        compare_with_surrogate: whether a prediction is used only if leave-one-out errors show that it is good.
        restrict: whether there are trust regions; if not, the whole cube is searched each time.
        accurate: largest relative error of a prediction that counts as right.
        points: largest number of points that are predicted for one suggestion, for each dimension.
        first_radius: half the width of a new region.
        least_radius: half the width below which a region is left.
        improvement: least predicted improvement worth an execution, as a share of the largest value.
        patience: factor of the optimism in the test whether a region may still lead to a value larger than all others.
        boldness: factor by which the optimism grows with each new region that has found nothing larger.
        most_optimism: upper limit of the optimism that is estimated from errors of predictions.
        compared_from: number of known values from which on the prediction must be better than the surrogate.
        compared_on: largest number of known values, the latest ones, on which the two are compared.
        good_enough: mean error of the logarithm up to which a prediction needs no comparison.
        distinct: least distance of a suggestion from each known point, in at least one coordinate.
        apart: least distance of a suggestion from pending and failed points, as a share of the cube's diagonal.
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
    """The state of a trust region, computed from notes and values.

    Attributes:
        number: the number of the region, from 0.
        radius: half its width; 1 for the whole cube.
        best, point: its largest value and the point with this value; minus infinity and None before there is one.
        misses: number of successive executions without improvement.
        stale: number of successive regions that have not improved the largest value of all.
    """

    number: int = 0
    radius: float = 1.0
    best: float = -np.inf
    point: Array | None = None
    misses: int = 0
    stale: int = 0

    def box(self, dimension: int) -> Box:
        """Return the bounds of the region within the unit cube."""
        centre = np.full(dimension, 0.5) if self.point is None else self.point
        return np.clip(centre - self.radius, 0, 1), np.clip(centre + self.radius, 0, 1)


@part("trust-region", aliases=("climbs",))
class TrustRegion(SequentialSearch):
    """Trust-region search with restarts on a prediction of the values; Bayesian optimisation if no prediction is good.

    Args:
        optimism: kappa, the relative excess of a value over its prediction that is assumed if the doubt is 1. After
            three executions it is estimated from their errors, with this value as the lower limit.
        misses: number of executions without improvement after which a region is left.
        settings: further settings, for studies; the defaults if None.

    Raises:
        InputError: if the optimism is negative or infinite, or no miss is allowed.
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
        """Return the options that identify this search in a store, and the settings if they are not the defaults."""
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
        """Take the prediction for the point that is asked for next; None if there is none."""
        self._prediction = prediction

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the next point: by the first good prediction or, if there is none, by Bayesian optimisation."""
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
        point, note = self._fallback.choose(self.points, self.values, rng)
        self._last_note = {**note, "why": why}
        return point

    @property
    def predicted_besides(self) -> int:
        """The number of known points that are predicted for a choice, besides those of the budget."""
        known, settings = int(np.isfinite(self.values).sum()), self._settings
        compared = min(known, settings.compared_on) if known >= settings.compared_from else 0
        return compared + min(known, _REPRESENTING)

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
        kept = _represented(self.points[known], values)  # it ends with the latest values, which are compared
        by_surrogate = _left_out(self.points[known][kept], values[kept])[-len(rows) :]
        surrogate = _log_error(by_surrogate, values[rows])
        if error <= surrogate:
            return None
        return f"leaving one out, the prediction errs by {error:.2g} where the surrogate errs by {surrogate:.2g}"

    # Where to execute next

    def _promising(self, prediction: Prediction, rng: np.random.Generator) -> Array | None:
        """Return the next point of the last region or of a new one; None if no point can be predicted."""
        settings, optimism = self._settings, self._calibrated()
        value = _OptimisticValue(prediction, self._discrepancy(prediction), optimism)
        if not settings.restrict:
            return self._noted(prediction, self._best(value, _Region(), rng), _Region())
        region = self._state()
        if region.misses < self.misses and region.radius >= settings.least_radius:
            point = self._best(value, region, rng)
            if point is not None and self._is_worth(value, point, region.best):
                return self._noted(prediction, point, region)
        # The optimism grows with every region that finds nothing larger, so the search explores more.
        bold = replace(value, optimism=optimism * settings.boldness ** (1 + region.stale))
        new = _Region(region.number + 1, settings.first_radius)
        return self._noted(prediction, self._best(bold, _Region(), rng), new)

    def _is_worth(self, value: _OptimisticValue, point: Array, best: float) -> bool:
        """Return whether the value at ``(d,)`` may exceed a region's best value and, with more optimism, all values.

        A region may be climbed through values below the largest one, unless even this optimism predicts nothing larger.
        """
        patient = replace(value, optimism=self._settings.patience * value.optimism)
        largest = float(np.nanmax(self.values, initial=0.0))
        return self._exceeds(value, point, best) and self._exceeds(patient, point, largest)

    def _exceeds(self, value: _OptimisticValue, point: Array, other: float) -> bool:
        """Return whether the optimistic value at ``(d,)`` is larger than another value by the least improvement."""
        return bool(value(point[None])[0] > other * (1 + self._settings.improvement))

    def _discrepancy(self, prediction: Prediction) -> GaussianProcess | None:
        """Return the GP of ``log(d + c) - log(d_hat + c)`` over the points; None if no point has both values."""
        known = np.isfinite(self.values)
        if not self._settings.correct_discrepancy or not known.any():
            return None
        points, values = self.points[known], self.values[known]
        kept = _represented(points, values)
        points, values = points[kept], values[kept]
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
        """Return kappa, estimated as the median difference of log values from log predictions per unit of doubt."""
        errors = [
            abs(np.log(value / note["expected"])) / note["doubt"]
            for value, note in zip(self.values.tolist(), self.notes, strict=True)
            if note is not None and note.get("doubt", 0) > 0 and value > 0 and note["expected"] > 0
        ]
        if len(errors) < _CALIBRATED:
            return self.optimism
        return float(np.clip(np.median(errors), self.optimism, self._settings.most_optimism))

    def _best(self, value: _OptimisticValue, region: _Region, rng: np.random.Generator) -> Array | None:
        """Return the new point of largest optimistic value in a region; None if no point there can be predicted."""
        budget = min(value.prediction.budget, self._settings.points * self.dimension)
        ascent = Ascent(value, *region.box(self.dimension), budget, rough=value.rough)
        points, promised = ascent.run(best_first(self.points, self.values)[:8], rng)
        usable = points[np.isfinite(promised)]
        # The first few suffice almost always, and a long history makes each comparison costly.
        for some in np.split(usable, [_FIRST]):
            new = self._is_new(some)
            if new.any():
                return np.asarray(some[np.argmax(new)])
        return None

    def _noted(self, prediction: Prediction, point: Array | None, region: _Region) -> Array | None:
        """Return the next point of a region unchanged, and record the prediction for it in the note."""
        if point is None:
            return None
        expected, doubt = prediction.expected(point[None])
        self._last_note = {
            "engine": _ENGINE,
            "climb": region.number,
            "radius": region.radius,
            "expected": float(expected[0]),
            "doubt": float(doubt[0]),
        }
        return point

    def _is_new(self, points: Array) -> Mask:
        """Return which of some points ``(m, d)`` are far enough from all known, pending and failed ones."""
        known, reach = np.isfinite(self.values), self._settings.apart * np.sqrt(self.dimension)
        gaps = cdist(points, self.points[known], "chebyshev").min(axis=1, initial=np.inf)
        others = cdist(points, self.points[~known]).min(axis=1, initial=np.inf)
        return np.asarray((gaps > self._settings.distinct) & (others > reach))

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
    """The optimistic value of points: the prediction, corrected and raised in proportion to its doubt.

    Attributes:
        prediction: the prediction d_hat and its doubt w.
        discrepancy: the correction g; None if it is not used.
        optimism: the factor kappa of the doubt.
    """

    prediction: Prediction
    discrepancy: GaussianProcess | None
    optimism: float

    @property
    def rough(self) -> _OptimisticValue | None:
        """The same with the rough prediction; None if there is none."""
        rough = self.prediction.rough
        return None if rough is None else replace(self, prediction=replace(self.prediction, expected=rough))

    def __call__(self, points: Array) -> Array:
        expected, doubt = self.prediction.expected(points)
        if self.discrepancy is not None:
            mean, variance = self.discrepancy.predict(points)
            # At a point with a known value there is no doubt, even if the dynamics on its trajectory are uncertain.
            expected = expected * np.exp(mean)
            doubt = doubt * np.sqrt(variance / self.discrepancy.kernel.diagonal(self.discrepancy.theta, points))
        return np.asarray(expected * (1 + self.optimism * doubt))


def _log_error(expected: Array, values: Array) -> float:
    """Return the mean error of the logarithm; small values count little."""
    if not np.isfinite(expected).all():
        return np.inf
    floor = max(_ERROR_OFFSET * float(np.median(values)), 1e-12)
    return float(np.abs(np.log(np.maximum(expected, 0.0) + floor) - np.log(values + floor)).mean())


def _represented(points: Array, values: Array) -> Rows:
    """Return the rows of a long history that represent all of it, in their order; they end with the latest ones."""
    return kept_rows(points, values, _REPRESENTING, long=_REPRESENTING)


def _left_out(points: Array, values: Array) -> Array:
    """Return leave-one-out predictions ``(n,)`` by the surrogate of the values."""
    surrogate = fit_surrogate(points, values)
    return np.asarray(surrogate.shift + surrogate.scale * surrogate.process.left_out()[0])
