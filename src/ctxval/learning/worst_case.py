"""The largest distance over all tasks, for each draw of the dynamics.

First the distance on the posterior mean is searched, from a pool of tasks whose controllers are designed once for a
whole campaign. Its local maxima, the tasks with known distances and some random tasks are then run on draws. For a
screening that is all, with few draws. Otherwise each draw is searched on its own around the best of these: coordinates
are moved to bounds, one at a time and all that help together, and points are moved at random by ever smaller steps.
Between these rounds each draw tries the best tasks of the others.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Mask, single_threaded
from ctxval._util.boxes import latin_hypercube, moves_to_bounds, separated_rows
from ctxval.core.space import TaskSpace
from ctxval.gp.ascent import ascend
from ctxval.gp.global_search import search_globally
from ctxval.learning.closed_loops import AnyPosterior, LoopPlanner, PlannedTasks, loop_pairs
from ctxval.learning.draws import Draws
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.settling import SettlingModel

_DIVERGED = 1e30  # the distance of a loop that diverges, in searches: larger than all others, and finite


@dataclass(frozen=True)
class WorstCaseSettings:
    """Numbers of closed loops in a search for the largest distance."""

    pool: int = 1024  # number of tasks whose controllers are designed once
    evaluations: int = 6000  # number of tasks in the global search on the mean, with those of the pool
    local_maxima: int = 24  # largest number of tasks from the global search that are run on all draws
    shared: int = 64  # number of random tasks of the pool that are run on all draws
    moves: int = 10  # number of random moves in each round of the search on each draw
    rounds: int = 4  # number of these rounds, at most 4
    # number of state-input pairs, on the loops of local maxima and of random tasks, from which pivots are chosen
    relevant: int = 700
    peaks: int = 5  # number of local maxima next to which tasks are tried
    nearby: int = 32  # number of tasks next to each of them
    near: float = 1e-3  # largest change of each coordinate to a task that is nearly the same
    nearer: int = 64  # how many times nearer tasks are that tell kinks of a distance from jumps, a power of 2
    apart: float = (
        0.15  # least distance of two tasks that are not next to each other, as a share of the cube's diagonal
    )
    shown: int = 16  # largest number of the best tasks of all draws that each draw tries
    screened_draws: int = 8  # number of draws of the hyperparameters in a screening
    screened_tasks: int = 1500  # number of tasks in its search on the mean
    further: int = 256  # number of random tasks in a screening if draws differ in the dry friction at rest
    random: int = 0  # number of random tasks from which the distance of a share of them follows; 0 for the largest one
    reducible: bool = True  # whether a search of fewer tasks tells something of all of them

    def intensified(self, dimension: int) -> int:
        """Return the number of tasks of each of two intensified searches."""
        return self.evaluations * (4 if dimension <= 2 else 1)

    @classmethod
    def for_dimension(cls, dimension: int, batched: bool = True) -> WorstCaseSettings:
        """Return settings for so many task parameters; there are far fewer tasks if they are designed one by one."""
        if not batched:
            return cls(pool=64, evaluations=256, local_maxima=6, shared=12, moves=2, rounds=0, peaks=1, nearby=8)
        evaluations = (512, 2048, 4096, 6000, 6000, 6000, 12000)[min(dimension, 7) - 1]  # for 1, 2, ... parameters
        return cls(pool=min(1024, evaluations // 4), evaluations=evaluations)

    @classmethod
    def for_space(cls, space: TaskSpace, batched: bool = True) -> WorstCaseSettings:
        """Return settings for a task space; of a suite, each task is run, and nothing lies between them."""
        settings = cls.for_dimension(space.dimension, batched)
        if space.members is None:
            return settings
        count = len(space.members)
        return replace(settings, pool=count, evaluations=count, rounds=0, peaks=0, further=0, reducible=False)


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The largest distances over all tasks that a search found, one for each draw of the dynamics."""

    maxima: Array  # the largest distance of each draw, (S,); infinity if its closed loop diverges
    points: Array  # where it lies, points of the unit cube (S, d)
    highest: float  # the largest distance on the posterior mean
    local_maxima: Array  # tasks with large distances on the posterior mean, points (e, d), the largest first
    evaluations: int  # number of closed loops that were compared; a few of them may be the same
    left_out: float  # largest share of the posterior variance that a draw leaves out between its pivots
    unplanned: float  # share of the pool's tasks for which no controller can be designed, or on which M diverges
    # largest share by which a distance on the mean is larger than those of tasks that are nearly the same
    peak_ratio: float = 0.0

    def with_draws(self, maxima: Array, points: Array, loops: int, left_out: float) -> WorstCase:
        """Return what a search has found on the mean and then, in so many more loops, on draws."""
        maxima, evaluations = np.where(maxima >= _DIVERGED, np.inf, maxima), self.evaluations + loops
        return replace(self, maxima=maxima, points=points, evaluations=evaluations, left_out=left_out)


class WorstCaseSearch:
    """Searches the tasks for the largest distance, for each draw of the dynamics."""

    def __init__(self, planner: LoopPlanner, seed: int, settings: WorstCaseSettings | None = None) -> None:
        self.planner = planner
        self.settings = WorstCaseSettings() if settings is None else settings
        self.dimension, self._seed = planner.validation.space.dimension, seed

    def expected_loops(self, draws: int) -> int:
        """Return about how many closed loops a search with so many draws runs, on M and on the draws."""
        settings = self.settings
        all_draws = settings.local_maxima + settings.shared + settings.shown
        moves = settings.rounds * (2 * self.dimension + settings.moves + 1)
        return 2 * settings.evaluations + all_draws + draws * (all_draws + 2 * moves)

    @property
    def screening_loops(self) -> int:
        """About how many closed loops a screening runs."""
        settings = self.settings
        shared = settings.local_maxima + settings.shared // 4
        screened = min(settings.screened_tasks, settings.evaluations)
        return 2 * settings.pool + screened + (1 + settings.screened_draws) * shared

    @functools.cached_property
    def pool(self) -> Array:
        """Tasks spread over the cube, every second one with coordinates at bounds, shape ``(N, d)``."""
        rng = np.random.default_rng([self._seed, 0])
        count = self.settings.pool
        points = latin_hypercube(count, self.dimension, rng)
        ends = rng.random(points.shape) < rng.random((len(points), 1))
        ends[::2] = False
        return np.asarray(np.where(ends, np.round(points), points))

    @functools.cached_property
    def plans(self) -> list[PlannedTasks]:
        """The plans of the pool."""
        return self.planner.plan(self.pool)

    @functools.cached_property
    def _in_rows(self) -> tuple[Array, list[PlannedTasks]]:
        """Three nearly equal tasks in a row from each task of the pool, points ``(N, 3, d)``, and their plans."""
        near = self.settings.near
        moves = np.random.default_rng([self._seed, 1]).uniform(-near, near, self.pool.shape)
        outside = (self.pool + 2 * moves < 0) | (self.pool + 2 * moves > 1)
        tasks = self.pool[:, None] + np.arange(3)[:, None] * np.where(outside, -moves, moves)[:, None]
        return tasks, self.planner.plan(tasks.reshape(-1, self.dimension))

    def largest_jump(self, posterior: AnyPosterior) -> float:
        """Return by how much the mean's distance of a task differs at most from the middle of those on both sides.

        The tasks are those of the pool. If the distance is a smooth function of the task, this is hardly anything. A
        distance whose attribute ``kinked`` is true is continuous in the trajectories and has kinks, which are no jumps:
        they become small between tasks that are nearer.
        """
        with single_threaded():
            tasks, planned = self._in_rows
            of_rows = self.planner.distances(posterior.mean, planned, tasks.shape[0] * 3)[0].reshape(-1, 3)
            if is_kinked(self.planner.validation.distance):
                of_rows = self._nearer(posterior, tasks, of_rows)
        jumps = np.abs(of_rows[:, 1] - 0.5 * (of_rows[:, 0] + of_rows[:, 2]))
        return float(jumps[np.isfinite(jumps)].max(initial=0.0))

    def _nearer(self, posterior: AnyPosterior, tasks: Array, distances: Array) -> Array:
        """Return distances ``(k, 3)`` of tasks in a row that are much nearer, where they bend most."""
        bends = np.abs(distances[:, 1] - 0.5 * (distances[:, 0] + distances[:, 2]))
        rows = np.argsort(-np.nan_to_num(bends, nan=0.0, posinf=0.0), kind="stable")[:64]
        tasks, distances = tasks[rows], distances[rows]
        for _ in range(int(np.log2(self.settings.nearer))):  # a jump is in the half of a row with the larger change
            later = np.abs(distances[:, 2] - distances[:, 1]) > np.abs(distances[:, 1] - distances[:, 0])
            ends = np.where(later[:, None], [1, 2], [0, 1])
            tasks, distances = np.take_along_axis(tasks, ends[..., None], 1), np.take_along_axis(distances, ends, 1)
            middle = tasks.mean(axis=1)
            value = self.planner.distances(posterior.mean, self.planner.plan(middle), len(middle))[0]
            tasks = np.stack([tasks[:, 0], middle, tasks[:, 1]], axis=1)
            distances = np.stack([distances[:, 0], value, distances[:, 1]], axis=1)
        return distances

    def intensified_search(self, posterior: AnyPosterior, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the largest distances on the mean ``(2,)``, and where, in two searches of more tasks.

        They have four times as many in one or two dimensions. In more, the usual search has as many already.
        """
        distance, none = self._on_one(posterior.mean), np.empty((0, self.dimension))
        evaluations = self.settings.intensified(self.dimension)
        with single_threaded():
            maxima = [search_globally(distance, self.dimension, none, rng, evaluations=evaluations) for _ in range(2)]
        return np.array([maximum.values[0] for maximum in maxima]), np.array([each.points[0] for each in maxima])

    def on_mean(
        self, posterior: AnyPosterior, of_pool: Array, known: Array, rng: np.random.Generator, *, globally: bool = True
    ) -> WorstCase:
        """Return the largest distance on the posterior mean, as if it were the only draw.

        The distances there of the pool's tasks ``(N,)`` are given, and ``known`` tasks ``(k, d)`` to look at in any
        case. Globally, large distances on a small share of the tasks are looked for, too.
        """
        settings, distance = self.settings, self._on_one(posterior.mean.searched)
        best = self.pool[np.argsort(-_finite(of_pool), kind="stable")[: settings.local_maxima * 4]]
        starts = np.concatenate([known, best])
        with single_threaded():
            if not globally and not is_kinked(self.planner.validation.distance):
                budget = min(settings.screened_tasks, settings.evaluations)
                same = posterior.rough_mean is posterior.mean.searched
                rough = None if same else self._on_one(posterior.rough_mean)
                box = np.zeros(self.dimension), np.ones(self.dimension)
                points, values = ascend(distance, box, budget, starts[: len(known) + settings.shown], rng, rough)
                apart = separated_rows(points, settings.apart * np.sqrt(self.dimension), settings.local_maxima)
                return self._of_mean(posterior, float(values[0]), points[apart], len(points))
            evaluations = max(len(starts) + 50, settings.evaluations - len(self.pool))
            maximum = search_globally(distance, self.dimension, starts, rng, evaluations=evaluations)
        local_maxima = np.concatenate([maximum.points[:1], maximum.local_maxima[: settings.local_maxima]])
        return self._of_mean(posterior, float(maximum.values[0]), local_maxima, len(maximum.values))

    def _of_mean(self, posterior: AnyPosterior, highest: float, local_maxima: Array, evaluations: int) -> WorstCase:
        if posterior.mean.searched is not posterior.mean:
            with single_threaded():
                values = self._distances(posterior.mean, local_maxima)[0]
            order = np.argsort(-values, kind="stable")
            highest, local_maxima, evaluations = (
                float(values[order[0]]),
                local_maxima[order],
                evaluations + len(local_maxima),
            )
        unplanned = 1 - sum(int(np.sum(plan.nominal.predicts)) for plan in self.plans) / len(self.pool)
        loops = len(self.pool) + evaluations
        return WorstCase(np.array([highest]), local_maxima[:1], highest, local_maxima, loops, 0.0, unplanned)

    def screened(
        self, posterior: AnyPosterior, of_mean: WorstCase, known: Array, rng: np.random.Generator
    ) -> WorstCase:
        """Return the largest distances of a few draws over local maxima, known and random tasks: a lower bound."""
        with single_threaded():
            tasks = self._shared_tasks(of_mean, known, self.settings.shared // 4, rng)
            draws = posterior.draw(self.relevant(posterior, tasks, rng), rng, 1, self.settings.screened_draws)
            if _sticks(posterior) and self.settings.further:  # their largest distances lie far from those of the mean
                further = self.pool[rng.permutation(len(self.pool))[: self.settings.further]]
                points, maxima, loops = self._search_draws(draws, np.concatenate([tasks, further]), rng)
                return of_mean.with_draws(maxima, points, loops, draws.left_out)
            values = self._distances(draws, tasks)
        return of_mean.with_draws(values.max(axis=1), tasks[values.argmax(axis=1)], values.size, draws.left_out)

    def maxima(
        self, posterior: AnyPosterior, of_mean: WorstCase, known: Array, rng: np.random.Generator, functions: int
    ) -> WorstCase:
        """Return the largest distances of so many functions for each draw of the posterior's hyperparameters."""
        with single_threaded():
            tasks = self._shared_tasks(of_mean, known, self.settings.shared, rng)
            draws = posterior.draw(self.relevant(posterior, tasks, rng), rng, functions)
            points, maxima, loops = self._search_draws(draws, tasks, rng)
            settled = draws.settled(rng)
            if settled is not None:
                # The search has chosen tasks with few sequences of noise, which its own maxima exaggerate.
                maxima = _finite(self.planner.own_distances(settled, points[:, None]))[:, 0]
            # The largest share that the distance of an elite loses at the median of the tasks next to it. If
            # controllers jump from task to task, the largest distance is a needle that a search finds by chance. Kinks
            # are no needles: they are flat between tasks that are nearer. Nor is a task at which a joint is just held,
            # like those on one side of it.
            peaks = of_mean.local_maxima[: self.settings.peaks]
            settings = self.settings
            near = settings.near / settings.nearer if is_kinked(self.planner.validation.distance) else settings.near
            moves = rng.uniform(-near, near, (len(peaks), settings.nearby, self.dimension))
            beside = np.concatenate([peaks[:, None], np.clip(peaks[:, None] + moves, 0, 1)], axis=1)
            flat = self._distances(posterior.mean, beside.reshape(-1, self.dimension))[0]
            distances = np.maximum(flat.reshape(beside.shape[:2]), 0.0)
            peak = distances[:, 0]
            next_to_it = np.quantile(distances[:, 1:], 0.9 if _sticks(posterior) else 0.5, axis=1)
            lost = np.divide(peak - next_to_it, peak, out=np.zeros(len(peak)), where=peak > 0)
        peak_ratio = float(max(lost.max(initial=0.0), 0.0))
        return replace(of_mean.with_draws(maxima, points, loops, draws.left_out), peak_ratio=peak_ratio)

    def _shared_tasks(self, of_mean: WorstCase, known: Array, count: int, rng: np.random.Generator) -> Array:
        """Return the tasks that draws share: local maxima, known tasks and random ones."""
        random = self.pool[rng.permutation(len(self.pool))[:count]]
        return np.concatenate([of_mean.local_maxima, known, random])

    def _distances(self, draws: Draws, points: Array) -> Array:
        return _finite(self.planner.distances(draws, self.planner.plan(points), len(points)))

    def _on_one(self, mean: Draws) -> Callable[[Array], Array]:
        return lambda points: np.asarray(self._distances(mean, points)[0])

    def relevant(self, posterior: AnyPosterior, tasks: Array, rng: np.random.Generator) -> Array:
        """Return standardised pairs on the mean's closed loops, from which pivots are chosen; noisy draws have none."""
        pairs = loop_pairs(self.planner, posterior, tasks)
        return pairs[rng.permutation(len(pairs))[: self.settings.relevant]]

    def _search_draws(self, draws: Draws, tasks: Array, rng: np.random.Generator) -> tuple[Array, Array, int]:
        """Return the best points ``(S, d)`` of draws and their distances, and the number of all loops."""
        values, loops = self._on_shared(draws, tasks)
        order = np.argsort(-values, axis=1, kind="stable")
        best, points = np.take_along_axis(values, order[:, :1], 1)[:, 0], tasks[order[:, 0]]
        # The best task of each draw that is not next to its best one; the second best if all are.
        ordered = tasks[order]
        apart = np.linalg.norm(ordered - ordered[:, :1], axis=2) > self.settings.apart * np.sqrt(self.dimension)
        rows = np.where(apart.any(axis=1), apart.argmax(axis=1), min(1, len(tasks) - 1))
        second, searched = ordered[np.arange(len(ordered)), rows], np.arange(len(draws))
        for round_, share in enumerate((0.1, 0.05, 0.02, 0.007)[: self.settings.rounds]):
            before = best.copy()
            if round_ == 2:
                # Each draw tries the best tasks of all others.
                best_first = points[np.argsort(-best, kind="stable")]
                shown = best_first[separated_rows(best_first, 0.02 * np.sqrt(self.dimension), self.settings.shown)]
                distances = self._distances(draws, shown)
                points, best = _better(points, best, np.broadcast_to(shown, (len(best), *shown.shape)), distances)
                loops += distances.size
            some, at, highest = draws[searched], points[searched], best[searched]
            # The moves of each point: to bounds, 2 d of them, and at random around it and around another one.
            others = second[searched]
            to_bounds = moves_to_bounds(at, np.zeros(self.dimension), np.ones(self.dimension))
            shape = (len(at), self.settings.moves, self.dimension)
            around = np.where(rng.random((*shape[:2], 1)) < 0.7, at[:, None], others[:, None])
            few = (rng.random(shape) < 0.5) | (rng.random((*shape[:2], 1)) < 0.5)
            random = np.clip(around + share * few * rng.normal(size=shape), 0, 1)
            moved = np.concatenate([to_bounds, random], axis=1)
            distances = _finite(self.planner.own_distances(some, moved))
            # Each point after all moves to bounds that help; of two that help, the better one.
            down, up = np.split(distances[:, : 2 * self.dimension], 2, axis=1)
            helps = np.maximum(down, up) > highest[:, None]
            together = np.where(helps, np.where(down > up, 0.0, 1.0), at)[:, None]
            known = np.concatenate([at[:, None], moved], axis=1)
            if (together == known).all(axis=2).any(axis=1).all():
                last = np.full((len(at), 1), -np.inf)  # none of them is a new task
            else:
                last = _finite(self.planner.own_distances(some, together))
            tried, distances = np.concatenate([moved, together], axis=1), np.concatenate([distances, last], axis=1)
            points[searched], best[searched] = _better(at, highest, tried, distances)
            loops += distances.size
            # A draw that will not reach the median does not set a bound.
            searched = np.flatnonzero(best + 3 * (best - before).max() >= np.median(best))
        return points, best, loops

    def _on_shared(self, draws: Draws, tasks: Array) -> tuple[Array, int]:
        """Return the distances ``(S, q)`` of draws on tasks that they share, and the number of loops.

        After some draws, tasks that are far below the worst one of a draw, compared with how much draws differ there,
        are not run on the others; their distances are minus infinity.
        """
        values = np.full((len(draws), len(tasks)), -np.inf)
        # Number of draws that show which tasks may be worst on the others.
        first = np.unique(np.linspace(0, len(draws) - 1, 8).astype(int))
        values[first] = self._distances(draws[first], tasks)
        others = np.setdiff1d(np.arange(len(draws)), first)
        if not len(others):
            return values, values.size
        highest = values[first].max(axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):  # no draw has a distance at a task that cannot be planned
            below = highest - values[first]
            may_be_worst = below.mean(axis=0) - 5 * below.std(axis=0) <= 0.01 * np.median(np.abs(highest))
        may_be_worst[np.argsort(-values[first], axis=1, kind="stable")[:, :4]] = True
        chosen = np.flatnonzero(may_be_worst)
        values[np.ix_(others, chosen)] = self._distances(draws[others], tasks[chosen])
        return values, len(first) * len(tasks) + len(others) * len(chosen)


class SuiteSearch(WorstCaseSearch):
    """Runs all tasks of a suite, in the place of a search; the distances of executed tasks are known."""

    @functools.cached_property
    def pool(self) -> Array:
        """The tasks of the suite, points ``(N, d)``."""
        members = self.planner.validation.space.members
        assert members is not None
        return members

    def largest_jump(self, posterior: AnyPosterior) -> float:
        """Return 0: no task lies between those of a suite."""
        return 0.0

    def on_mean(
        self, posterior: AnyPosterior, of_pool: Array, known: Array, rng: np.random.Generator, *, globally: bool = True
    ) -> WorstCase:
        """Return the largest distance on the posterior mean of the tasks that are not ``known``, of all if all are."""
        left, values = self._left(known), _finite(of_pool)
        order = [row for row in np.argsort(-values, kind="stable") if left[row]] or [int(values.argmax())]
        local_maxima = self.pool[order[: self.settings.local_maxima]]
        return self._of_mean(posterior, float(values[order[0]]), local_maxima, len(values))

    def _shared_tasks(self, of_mean: WorstCase, known: Array, count: int, rng: np.random.Generator) -> Array:
        left = self.pool[self._left(known)]
        return left if len(left) else of_mean.local_maxima

    def _left(self, known: Array) -> Mask:
        return np.asarray(~(self.pool[:, None] == known).all(axis=2).any(axis=1))


def _sticks(posterior: AnyPosterior) -> bool:
    """Return whether draws differ in the dry friction at rest."""
    return isinstance(posterior, DynamicsPosterior) and isinstance(posterior.model, SettlingModel)


def is_kinked(distance: object) -> bool:
    """Return whether a distance, or the user's distance in it, has kinks."""
    while distance is not None:
        if getattr(distance, "kinked", False):
            return True
        distance = getattr(distance, "distance", None)
    return False


def _finite(distances: Array) -> Array:
    """Return distances for a search: very large if a loop diverges, minus infinity if a task cannot be planned."""
    return np.where(np.isnan(distances), -np.inf, np.minimum(distances, _DIVERGED))


def _better(points: Array, best: Array, tried: Array, distances: Array) -> tuple[Array, Array]:
    """Return, for each draw, the best of its point ``(S, d)`` and those that were tried, ``(S, q, d)``."""
    row, at = np.arange(len(points)), distances.argmax(axis=1)
    better = distances[row, at] > best
    return np.where(better[:, None], tried[row, at], points), np.where(better, distances[row, at], best)
