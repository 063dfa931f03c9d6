"""Trust-region search on a prediction: it executes points where the prediction is large, or uncertain.

It maximises the optimistic value ``d_hat(p) (1 + kappa w(p))``: the prediction d_hat, raised in proportion to its doubt
w. The prediction is trusted inside a box around the best point. The box grows if an execution improves on the best
value. It shrinks if an execution does not and the prediction was wrong. If no improvement is predicted in a region, or
if several executions have not improved, a new region starts at the point of the whole cube with the largest optimistic
value for a larger kappa. A larger kappa favours points where the dynamics are not known.

A prediction may be wrong in a way that its doubt does not show. So the search hedges: if the last two predictions were
far off and the next one is in doubt, or if several executions have found nothing larger, every second point is that of
Bayesian optimisation on the values alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask, single_threaded
from ctxval._util.checked import NonNegativeFloat, PositiveInt, Seconds
from ctxval._util.progress import expect
from ctxval._util.registry import part
from ctxval.gp.acquisition import NEAR
from ctxval.gp.ascent import ascend, usual_effort
from ctxval.gp.surrogate import fit_surrogate, kept_rows
from ctxval.searches.base import Costs, Note, Prediction, SequentialSearch, best_first
from ctxval.searches.bayesian_optimisation import BayesianOptimisation

_ENGINE = "climb"  # the name of this search in notes of existing stores, so it differs from that of the class


@dataclass(frozen=True)
class TrustRegionSettings:
    """How many points are predicted for a choice, and when a prediction or an execution is worth it."""

    points: int = 400  # largest number of points that are predicted for one suggestion, for each dimension
    # shares of it that are predicted for a choice, from thorough to fast
    shares: tuple[float, ...] = (1.0, 0.4, 0.15)
    smaller: tuple[float, ...] = (0.05, 0.02, 0.005)  # those that a stated number of seconds may need
    improvement: float = 1e-3  # least predicted improvement worth an execution, as a share of the largest value
    compared_from: int = 6  # number of known values from which on the prediction must be better than the surrogate
    compared_on: int = 24  # largest number of known values, the latest ones, on which the two are compared
    near: float = 0.02  # change of each coordinate to a known point up to which a point is its copy
    refined: float = 1e-4  # least predicted improvement worth a copy, as a share of the largest value


class _Candidate(NamedTuple):
    """A point ``(d,)`` of the unit cube, the value that is predicted there, and its doubt."""

    point: Array
    expected: float
    doubt: float


@dataclass(frozen=True, eq=False)
class _Region:
    number: int = 0
    radius: float = 1.0  # half its width; 1 for the whole cube
    best: float = -np.inf  # its largest value, at the point
    point: Array | None = None
    misses: int = 0  # number of successive executions without improvement
    stale: int = 0  # number of successive regions that have not improved the largest value of all


@dataclass(frozen=True, eq=False)
class _History:
    """What a choice follows from: points, values and notes, and pending or failed points that it keeps away from."""

    points: Array
    values: Array
    notes: tuple[Note | None, ...]
    others: Array


@part("trust-region")
class TrustRegion(SequentialSearch):
    """Trust-region search with restarts on a prediction of the values; Bayesian optimisation if no prediction is good.

    Args:
        optimism: kappa, the relative excess of a value over its prediction that is assumed if the doubt is 1.
        misses: number of executions without improvement after which a region is left.
    """

    initial = 1

    settings = TrustRegionSettings()
    # What is set otherwise to study the parts of the search (benchmarks/study_ablations.py).
    compare_with_surrogate = True  # whether a prediction is used only if leave-one-out errors show that it is good
    restrict = True  # whether there are trust regions; if not, the whole cube is searched each time
    boldness = 4.0  # factor by which the optimism grows with each new region that has found nothing larger
    hedge = True  # whether a prediction that may mislead alternates with the surrogate

    def __init__(self, optimism: NonNegativeFloat = 2.0, misses: PositiveInt = 3) -> None:
        self.optimism = optimism
        self.misses = misses

    def reset(self, dimension: int, seed: int) -> None:
        super().reset(dimension, seed)
        self._prediction: Prediction | None = None
        self._fallback = BayesianOptimisation(initial=1)
        self._fallback.reset(dimension, seed)

    def use_prediction(self, prediction: Prediction | None) -> None:
        self._prediction = prediction

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the next point ``(d,)``: by the first good prediction or, without one, by Bayesian optimisation."""
        prediction, why, candidate = self._prediction, "there is no prediction", None
        surrogate_error = functools.cache(self._surrogate_error)  # all predictions are compared with the same one
        while prediction is not None:
            with single_threaded():
                doubtful = self._why_not(prediction, surrogate_error)
                candidate, region = self._promising(prediction, rng) if doubtful is None else (None, _Region())
            if candidate is not None:
                of_region = {"engine": _ENGINE, "climb": region.number, "radius": region.radius}
                self._last_note = {**of_region, "expected": candidate.expected, "doubt": candidate.doubt}
                why_hedge = self._why_hedge()
                if why_hedge is None:
                    return candidate.point
                why = why_hedge
                break
            why = doubtful or "nothing is predicted anywhere"
            prediction = None if prediction.otherwise is None else prediction.otherwise()
        # A hedge looks elsewhere; without a prediction, Bayesian optimisation refines maxima, too.
        near = NEAR if candidate is None else self.settings.near
        point, note = self._fallback.choose(self.points, self.values, rng, near)
        self._last_note = {**note, "why": why}
        return point

    # How good the prediction is

    def _why_not(self, prediction: Prediction, surrogate_error: Callable[[], float]) -> str | None:
        known = np.flatnonzero(np.isfinite(self.values))
        if not self.compare_with_surrogate or len(known) < self.settings.compared_from:
            return None
        latest = known[-self.settings.compared_on :]
        error = _log_error(prediction.left_out(self.points[latest]), self.values[latest])
        if error <= 0.1 or error <= surrogate_error():  # a small error needs no comparison
            return None
        errs = f"errs by {error:.2g} where the surrogate errs by {surrogate_error():.2g}"
        return f"leaving one out, the prediction {errs}"

    def _surrogate_error(self) -> float:
        known = np.isfinite(self.values)
        points, values = self.points[known], self.values[known]
        kept = kept_rows(points, values, 150, long=150)  # they end with the latest values, which are compared
        surrogate = fit_surrogate(points[kept], values[kept])
        left_out = surrogate.shift + surrogate.scale * surrogate.process.left_out()[0]
        latest = slice(-min(len(values), self.settings.compared_on), None)
        return _log_error(left_out[latest], values[latest])

    def _why_hedge(self) -> str | None:
        """Return why the surrogate chooses in place of the prediction, every second time; None if it does not."""
        values, notes = self.values, [note or {} for note in self.notes]
        rows = [row for row in np.flatnonzero(np.isfinite(values)) if notes[row].get("engine") == _ENGINE]
        if not rows or not self.hedge or notes[-1].get("engine") != _ENGINE:
            return None
        last = [(values[row], notes[row]["expected"]) for row in rows[-2:]]
        error = min(abs(value - expected) / max(value, expected, 1e-300) for value, expected in last)
        if len(last) == 2 and (self._last_note or {})["doubt"] > 1 and error > 0.5:
            return f"the last two predictions erred by {100 * error:.0f} % or more and the next one is in doubt"
        values = values[np.isfinite(values)]
        gains = values[1:] > (1 + self.settings.improvement) * np.maximum.accumulate(values)[:-1]
        fruitless = len(gains) - int(np.flatnonzero(gains).max(initial=-1)) - 1
        return f"the last {fruitless} executions found nothing larger" if fruitless >= 6 else None

    # Where to execute next

    def _promising(self, prediction: Prediction, rng: np.random.Generator) -> tuple[_Candidate | None, _Region]:
        """Return the next point of the last region or of a new one, None if no point can be predicted, and the region.

        The point that follows from the known values alone comes first. If it is being evaluated already, the next one
        is chosen as if all pending points had the expected values.
        """
        points, values, notes, pending = self.points, self.values, self.notes, prediction.pending
        whole = _History(points, values, notes, points[~np.isfinite(values)])
        if pending is None:
            return self._next(prediction, whole, rng)
        waiting = np.isnan(values) & (points[:, None] == pending.points).all(axis=2).any(axis=1)
        ended = [note for note, waits in zip(notes, waiting, strict=True) if not waits]
        known = _History(points[~waiting], values[~waiting], tuple(ended), points[np.isnan(values) & ~waiting])
        candidate, region = self._next(prediction, known, rng)
        if candidate is None or self._is_new(candidate.point[None], whole)[0]:
            return candidate, region
        expected = values.copy()
        expected[waiting] = prediction.expected(points[waiting])[0]
        as_if = pending.prediction()
        after = replace(prediction, expected=as_if.expected, rough=as_if.rough)
        return self._next(after, replace(whole, values=expected), rng)

    def _next(
        self, prediction: Prediction, history: _History, rng: np.random.Generator
    ) -> tuple[_Candidate | None, _Region]:
        """Return the next candidate after a history, None if no point can be predicted, and its region."""
        if not self.restrict:
            return self._best(prediction, self.optimism, _Region(), history, rng), _Region()
        region = self._state(history)
        if region.misses < self.misses and region.radius >= 0.02:
            best = self._best(prediction, self.optimism, region, history, rng)
            if best is not None:
                # It may exceed the region's best value and, with ten times the optimism, the largest value of all.
                least, largest = 1 + self.settings.improvement, float(np.nanmax(history.values, initial=0.0))
                kappas = self.optimism, 10.0 * self.optimism
                optimistic, patient = (best.expected * (1 + kappa * best.doubt) for kappa in kappas)
                if optimistic > region.best * least and patient > largest * least:
                    return best, region
        # The optimism grows with every region that finds nothing larger, so the search explores more.
        bold = self.optimism * self.boldness ** (1 + region.stale)
        return self._best(prediction, bold, _Region(), history, rng), _Region(region.number + 1, radius=0.4)

    def _best(
        self, prediction: Prediction, optimism: float, region: _Region, history: _History, rng: np.random.Generator
    ) -> _Candidate | None:
        """Return the new point of largest optimistic value in a region; None if no point there can be predicted."""

        def optimistic(predicted: Callable[[Array], tuple[Array, Array]], points: Array) -> Array:
            expected, doubt = predicted(points)  # d_hat, raised by kappa times its doubt w
            return np.asarray(expected * (1 + optimism * doubt))

        value, few = functools.partial(optimistic, prediction.expected), prediction.candidates
        centre = np.full(self.dimension, 0.5) if region.point is None else region.point
        box = np.clip(centre - region.radius, 0, 1), np.clip(centre + region.radius, 0, 1)
        if few is not None:
            points = few[((few >= box[0]) & (few <= box[1])).all(axis=1)]
            predicted = value(points) if len(points) else np.empty(0)
            order = np.argsort(-np.nan_to_num(predicted, nan=-np.inf), kind="stable")
            points, predicted = points[order], predicted[order]
        else:
            budget = min(prediction.budget, self.settings.points * self.dimension)
            rough = None if prediction.rough is None else functools.partial(optimistic, prediction.rough)
            starts = best_first(history.points, history.values)[:8]
            points, predicted = ascend(value, box, budget, starts, rng, rough)
        points = points[self._is_new(points, history) & np.isfinite(predicted)]
        if len(points) and few is None:
            apart = _gaps(points, history) > self.settings.near
            if not apart[0]:  # it is worth an execution only if it is predicted to exceed the largest known value
                here, there = prediction.expected(np.stack([points[0], starts[0]]))[0]
                points = points if here > (1 + self.settings.refined) * there else points[apart]
        if not len(points):
            return None
        point = next(filter(prediction.steady or (lambda point: True), points), points[0])
        expected, doubt = prediction.expected(point[None])
        return _Candidate(point, float(expected[0]), float(doubt[0]))

    def _is_new(self, points: Array, history: _History) -> Mask:
        others = scipy.spatial.distance.cdist(points, history.others).min(axis=1, initial=np.inf)
        return np.asarray((_gaps(points, history) > NEAR) & (others > 0.05 * np.sqrt(self.dimension)))

    def _state(self, history: _History) -> _Region:
        region, largest = _Region(), -np.inf
        for point, value, note in zip(history.points, history.values.tolist(), history.notes, strict=True):
            if note is not None and note.get("engine") == _ENGINE:
                if note["climb"] > region.number:
                    region = _Region(note["climb"], note["radius"], stale=region.stale + 1)
                if not np.isfinite(value):
                    region = replace(region, misses=region.misses + 1)
                elif value > region.best * (1 + self.settings.improvement) or region.point is None:
                    grown = region.radius if region.point is None else min(1.0, 2 * region.radius)
                    region = replace(region, best=value, point=point, misses=0, radius=grown)
                else:
                    if value > region.best:
                        region = replace(region, best=value, point=point)
                    right = abs(value - note["expected"]) <= 0.1 * max(value, note["expected"])
                    radius = region.radius if right else region.radius / 2
                    region = replace(region, misses=region.misses + 1, radius=radius)
            elif value > region.best:
                region = replace(region, best=value, point=point)
            if value > largest * (1 + self.settings.improvement) or largest == -np.inf:
                region = replace(region, stale=0)
            largest = max(largest, value) if np.isfinite(value) else largest
        return region


def _gaps(points: Array, history: _History) -> Array:
    """Return the largest difference of a coordinate from the nearest point with a known value, ``(m,)``."""
    known = history.points[np.isfinite(history.values)]
    return np.asarray(scipy.spatial.distance.cdist(points, known, "chebyshev").min(axis=1, initial=np.inf))


def _log_error(expected: Array, values: Array) -> float:
    """Return the mean error of the logarithm; small values count little."""
    if not np.isfinite(expected).all():
        return np.inf
    floor = max(0.1 * float(np.median(values)), 1e-12)
    return float(np.abs(np.log(np.maximum(expected, 0.0) + floor) - np.log(values + floor)).mean())


Thinking = Literal["balanced", "fast", "thorough"]

SECONDS = "thinking_seconds"  #: key in a note: the stated seconds of a choice, from which the number of points follows
DESIGNS = "designs"  #: key in a note: the number of points that are predicted for each choice of the campaign


@part("auto")
class Auto(TrustRegion):
    """Trust-region search on the distance that executed trajectories predict; Bayesian optimisation without them.

    Args:
        thinking: how long a suggestion may take, as tasks that are predicted; each needs the design of a controller.
            ``"thorough"``: at most 2,000 if controllers are designed in batches and 150 if they are designed one after
            the other, and at most 400 for each task parameter. ``"fast"``: 15 % of that. ``"balanced"``: 15 %, 40 % or
            all of that, whichever is the largest number that takes no longer than one execution or 1 s. This is
            measured once, after the first execution, and stored in a note; so another campaign with the same seed may
            make other choices. A number: the seconds of CPU that one suggestion may take, in place of that; those of
            the campaign (``--thinking``) come before.
        optimism, misses: see :class:`TrustRegion`.
    """

    def __init__(
        self, thinking: Thinking | Seconds = "balanced", optimism: NonNegativeFloat = 2.0, misses: PositiveInt = 3
    ) -> None:
        super().__init__(optimism, misses)
        self.thinking = thinking
        self._fixed_now: dict[str, Any] | None = None

    def use_prediction(self, prediction: Prediction | None) -> None:
        self._fixed_now = None
        if prediction is not None:
            prediction = replace(prediction, budget=self.designs(prediction))
            known = int(np.isfinite(self.values).sum())  # of which some are predicted, too, for a comparison
            compared = min(known, self.settings.compared_on) if known >= self.settings.compared_from else 0
            usual = usual_effort(self.dimension, prediction.budget)
            expect(usual.exact + usual.rough + compared)
        super().use_prediction(prediction)

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the next point ``(d,)``; if the number of designs is fixed at this choice, its note has the number."""
        point = super().propose(rng)
        if self._fixed_now is not None:
            self._last_note = {**(self._last_note or {}), **self._fixed_now}
        return point

    def designs(self, prediction: Prediction) -> int:
        """Return the number of points that are predicted for the next choice."""
        most = min(prediction.budget, self.settings.points * self.dimension)
        stated = prediction.thinking
        if stated is None and not isinstance(self.thinking, str):
            stated = float(self.thinking)
        match self.thinking if stated is None else None:
            case "thorough":
                return most
            case "fast":
                return max(1, round(self.settings.shares[-1] * most))
        # The number is fixed once an execution was timed; the note of that choice has it.
        noted = (note.get(DESIGNS) for note in self.notes if note is not None and note.get(SECONDS) == stated)
        fixed = next((number for number in noted if isinstance(number, int) and number >= 1), None)
        if fixed is not None or prediction.costs is None:
            return min(most, fixed or most)
        # As many designs as take no longer than one evaluation, or one second. An evaluation that was not timed is
        # supposed to take 10 s.
        costs = prediction.costs()
        seconds = max(1.0, 10.0 if costs.evaluation is None else costs.evaluation) if stated is None else stated
        shares = self.settings.shares if stated is None else (*self.settings.shares, *self.settings.smaller)
        numbers = [max(min(8, most), round(share * most)) for share in shares]
        designs = next((number for number in numbers if self.thinking_seconds(costs, number) <= seconds), numbers[-1])
        if costs.evaluation is not None or stated is not None:
            self._fixed_now = {DESIGNS: designs} if stated is None else {DESIGNS: designs, SECONDS: stated}
        return designs

    def thinking_seconds(self, costs: Costs, designs: int) -> float:
        """Return the estimated seconds of CPU time of the predictions of a choice with so many designs."""
        effort = usual_effort(self.dimension, designs)
        rough = costs.prediction if costs.rough is None else costs.rough
        return effort.batches * costs.batch + effort.exact * costs.prediction + effort.rough * rough
