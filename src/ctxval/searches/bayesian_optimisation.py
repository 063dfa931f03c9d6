"""Bayesian optimisation from values alone: two acquisition functions, and branches that lead out of local maxima.

The surrogate is that of :func:`ctxval.gp.surrogate.learn`. Its expected improvement or, every third time, its upper
confidence bound is maximised over the cube.

After several executions without improvement the search branches: it restricts itself to one half of the cube. Of the
halves that do not contain the best point it takes the one with the fewest executions. A branch starts where the upper
confidence bound is largest. From then on it improves on the largest value found in the branch, not on the largest of
all, because the path away from a wide maximum leads through lower values.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.checked import NonNegativeFloat, PositiveInt
from ctxval._util.registry import part
from ctxval.gp.acquisition import NEAR, Acquisition, LogExpectedImprovement, UpperConfidenceBound, maximise
from ctxval.gp.surrogate import SurrogateHyperparameters, kept_rows, learn
from ctxval.searches.base import Note, SequentialSearch, best_first

_ENGINE = "scalar"  # the name of this search in notes of existing stores, so it differs from that of the class


@dataclass(frozen=True)
class BayesianSettings:
    """When an improvement is worth an execution, and how often what the surrogate does not expect is tried."""

    worth: float = 0.005  # least improvement, as a share of the best value's excess over the median
    everywhere: int = 4  # period of executions from the whole cube, also in a branch; few dimensions are filled
    bound: int = 3  # period of executions that maximise the upper confidence bound


@dataclass(frozen=True, eq=False)
class _Branch:
    """A restriction of the search to the upper or lower half of the cube along one coordinate."""

    coordinate: int
    upper: bool
    best: float = -np.inf  # the largest value in this half since the branch began
    misses: int = 0  # number of successive executions in the branch without improvement


@part("bayesian-optimisation")
class BayesianOptimisation(SequentialSearch):
    """Bayesian optimisation from values alone: expected improvement and upper confidence bounds, with branches.

    From 1,000 points on, the surrogate is conditioned on 1,000 of them: the largest values, the latest, and well-spread
    ones.

    Args:
        initial: number of random points at the start; in one and two dimensions they are far from each other.
        beta: confidence parameter of the upper confidence bounds.
    """

    settings = BayesianSettings()

    def __init__(self, initial: PositiveInt = 3, beta: NonNegativeFloat = 4.0) -> None:
        self.initial, self.beta = initial, beta

    def reset(self, dimension: int, seed: int) -> None:
        super().reset(dimension, seed)
        self._memo: tuple[bytes, SurrogateHyperparameters] | None = None

    def propose(self, rng: np.random.Generator) -> Array:
        point, self._last_note = self.choose(self.points, self.values, rng)
        return point

    def choose(self, points: Array, values: Array, rng: np.random.Generator, near: float = NEAR) -> tuple[Array, Note]:
        """Return the next point ``(d,)`` after a history, which any search may have made, and a note on the choice.

        A coordinate of it differs from each known point by more than ``near``, if it does for any candidate.
        """
        few = self.dimension <= 2
        if len(values) < self.initial or np.isfinite(values).sum() < 2:
            point = _filling(points, rng) if few and len(points) else rng.random(self.dimension)
            return point, {"engine": _ENGINE, "how": "initial"}
        if few and len(values) % self.settings.everywhere == 0:
            return _filling(points, rng), {"engine": _ENGINE, "how": "filling"}
        with single_threaded():
            return self._most_worth(points, values, rng, near)

    def _most_worth(self, points: Array, values: Array, rng: np.random.Generator, near: float) -> tuple[Array, Note]:
        known = np.isfinite(values)
        learned = self._learned(points[known], values[known])
        rows = kept_rows(points, values, 1000)
        process = learned.condition(points[rows], values[rows])
        branch = (
            None
            if len(values) % self.settings.everywhere == 0
            else _branch(points[known], values[known], self.settings.worth)
        )
        if branch is not None and not np.isfinite(branch.best):
            # Be bold, far from the maximum that was left: near it, the branch would only lead back to it.
            acquisition: Acquisition = UpperConfidenceBound(process, 100.0)
        elif len(values) % self.settings.bound == self.settings.bound - 1:
            acquisition = UpperConfidenceBound(process, self.beta)
        else:
            largest = float(np.nanmax(values))
            excess = float(largest - np.nanmedian(values))
            least = (largest if branch is None else branch.best) + self.settings.worth * excess
            best = float(learned.standardised(np.array([least]))[0])
            if branch is None:
                # Predicted values of pending points count, so that points of one batch do not all improve on one value.
                best = max(best, float(process.y[int(known[rows].sum()) :].max(initial=-np.inf)))
            acquisition = LogExpectedImprovement(process, best)
        box = np.zeros(self.dimension), np.ones(self.dimension)
        if branch is not None:
            box[0 if branch.upper else 1][branch.coordinate] = 0.5
        known_first, away = best_first(points, values), points[~known]
        point = maximise(acquisition, self.dimension, known_first, rng, box=box, corners=True, away=away, near=near)
        return point, {
            "engine": _ENGINE,
            "how": "bound" if isinstance(acquisition, UpperConfidenceBound) else "improvement",
            "branch": None if branch is None else [branch.coordinate, branch.upper],
            "logarithm": bool(np.isfinite(learned.warp.offset)),
        }

    def _learned(self, points: Array, values: Array) -> SurrogateHyperparameters:
        """Return hyperparameters learned at each new value up to 40, at every second value up to 80, and so on."""
        step = 1
        while len(values) >= 40 * step:
            step *= 2
        count = len(values) - len(values) % step
        key = points[:count].tobytes() + values[:count].tobytes()
        if self._memo is None or self._memo[0] != key:
            self._memo = (key, learn(points[:count], values[:count]))
        return self._memo[1]


def _filling(points: Array, rng: np.random.Generator) -> Array:
    candidates = rng.random((512, points.shape[1]))
    gaps = np.linalg.norm(candidates[:, None, :] - points[None, :, :], axis=2).min(axis=1)
    return np.asarray(candidates[np.argmax(gaps)])


def _branch(points: Array, values: Array, worth: float) -> _Branch | None:
    """Return the branch that the search is in after these known values, in their order; None for the whole cube."""
    branch, misses, best, place = None, 0, -np.inf, points[0]
    ordered: list[float] = []
    for count, (point, value) in enumerate(zip(points, values.tolist(), strict=True), start=1):
        insort(ordered, value)
        median = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
        margin = worth * max(best, value) - worth * median
        improves = value > best + margin
        if value > best:
            best, place = value, point
        if improves:
            branch, misses = None, 0
        elif branch is None:
            misses += 1
        elif bool(point[branch.coordinate] >= 0.5) is branch.upper:
            fruitless = 0 if value > branch.best + margin else branch.misses + 1
            branch = replace(branch, best=max(branch.best, value), misses=fruitless)
        if (misses >= 8) if branch is None else (branch.misses >= 6):
            # The next branch is the half with the fewest points, of those halves that do not contain the best point.
            upper = place < 0.5
            coordinate = int(((points[:count] >= 0.5) == upper).sum(axis=0).argmin())
            branch, misses = _Branch(coordinate, bool(upper[coordinate])), 0
    return branch
