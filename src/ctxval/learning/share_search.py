"""The distance that a share of the tasks stay below, for each draw of the dynamics: a quantile over the tasks.

Random tasks, drawn once for a whole campaign, are run on the posterior mean. Those with the largest distances are then
run on all draws, and so are a few of the others, each of which counts for many. Of N random tasks, fewer than
``(1 - share) N`` may exceed the quantile by chance; so few of them are left above the distance of a draw that it is too
small with a probability of at most 1 %.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval.learning.closed_loops import AnyPosterior, LoopPlanner, PlannedTasks
from ctxval.learning.draws import Draws
from ctxval.learning.worst_case import WorstCase, WorstCaseSearch, WorstCaseSettings


@dataclass(frozen=True)
class ShareSettings:
    """Numbers of tasks from which the distance of a share of them follows."""

    above: int = 30  # expected number of random tasks above the quantile
    alone: int = 6  # the same, if each closed loop is designed and run on its own
    top: float = 4.0  # number of tasks that are run on all draws, as a multiple of those above the quantile
    others: int = 128  # number of other tasks that are run on all draws
    screened_others: int = 32  # the same in a screening
    too_small: float = 0.01  # probability that the distance of a draw is too small by the choice of the tasks


class ShareSearch(WorstCaseSearch):
    """Finds, in place of the largest distance, the one that a share of the tasks stay below, for each draw."""

    def __init__(
        self,
        planner: LoopPlanner,
        seed: int,
        share: float,
        settings: WorstCaseSettings,
        of_share: ShareSettings = ShareSettings(),
    ) -> None:
        above = of_share.above if planner.batched else of_share.alone
        top = int(np.ceil(of_share.top * above))
        count = round(above / (1 - share))
        shared = top + of_share.others
        super().__init__(planner, seed, replace(settings, random=count, shared=shared, rounds=0, reducible=False))
        self.share, self.above, self.of_share = share, above, of_share  #: above: expected number above the quantile
        self._latest: tuple[AnyPosterior, Array] | None = None

    @functools.cached_property
    def tasks(self) -> Array:
        """The random tasks, points ``(N, d)``."""
        rng = np.random.default_rng([self._seed, 2])
        return self.planner.validation.space.unit_draws(self.settings.random, rng)

    @functools.cached_property
    def _task_plans(self) -> list[PlannedTasks]:
        return self.planner.plan(self.tasks)

    @functools.cached_property
    def above_for_bound(self) -> int | None:
        """The number of tasks above a distance that exceeds the quantile almost surely; None for too few tasks."""
        counts = np.arange(self.above + 1)
        rarely = scipy.special.bdtr(counts, len(self.tasks), 1 - self.share) <= self.of_share.too_small
        return int(counts[rarely].max()) if rarely.any() else None

    def of_mean(self, posterior: AnyPosterior) -> Array:
        """Return the distances ``(N,)`` of the random tasks on the posterior mean; infinity if a loop diverges."""
        if self._latest is None or self._latest[0] is not posterior:
            with single_threaded():
                values = self.planner.distances(posterior.mean.searched, self._task_plans, len(self.tasks))[0]
            self._latest = posterior, values
        return self._latest[1]

    def share_above(self, posterior: AnyPosterior, threshold: float) -> float:
        """Return the share of the tasks whose distance on the posterior mean exceeds a threshold."""
        return float((self.of_mean(posterior) > threshold).mean())

    def on_mean(
        self, posterior: AnyPosterior, of_pool: Array, known: Array, rng: np.random.Generator, *, globally: bool = True
    ) -> WorstCase:
        """Return the quantile of the distance on the posterior mean, and below it tasks whose distances are near it."""
        values = self.of_mean(posterior)
        order = np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")
        near = order[np.argsort(np.abs(np.arange(len(order)) - self.above), kind="stable")]
        near = near[: min(self.settings.local_maxima, 2 * self.above + 1)]
        highest, unplanned = float(values[order[self.above]]), float(np.isnan(values).mean())
        points = self.tasks[near]
        return WorstCase(np.array([highest]), points[:1], highest, points, len(values), 0.0, unplanned)

    def screened(
        self, posterior: AnyPosterior, of_mean: WorstCase, known: Array, rng: np.random.Generator
    ) -> WorstCase:
        """Return the quantiles of a few draws."""
        with single_threaded():
            top, others = self._rows(posterior, rng, self.of_share.screened_others)
            relevant = self.relevant(posterior, self.tasks[top], rng)
            draws = posterior.draw(relevant, rng, 1, self.settings.screened_draws)
            return self._with_quantiles(of_mean, draws, top, others, draws.left_out)

    def maxima(
        self, posterior: AnyPosterior, of_mean: WorstCase, known: Array, rng: np.random.Generator, functions: int
    ) -> WorstCase:
        """Return the quantiles of so many functions for each draw of the posterior's hyperparameters."""
        with single_threaded():
            top, others = self._rows(posterior, rng, self.of_share.others)
            draws = posterior.draw(self.relevant(posterior, self.tasks[top], rng), rng, functions)
            return self._with_quantiles(of_mean, draws, top, others, draws.left_out)

    def _rows(self, posterior: AnyPosterior, rng: np.random.Generator, others: int) -> tuple[Rows, Rows]:
        """Return the rows of the tasks with the largest distances on the mean, and of some of the others."""
        order = np.argsort(-np.nan_to_num(self.of_mean(posterior), nan=-np.inf), kind="stable")
        top = self.settings.shared - self.of_share.others
        return order[:top], rng.permutation(order[top:])[:others]

    def _with_quantiles(self, of_mean: WorstCase, draws: Draws, top: Rows, others: Rows, left_out: float) -> WorstCase:
        rows = np.concatenate([top, others])
        values = self.planner.distances(draws, self.planner.plan(self.tasks[rows]), len(rows))
        values = np.nan_to_num(values, nan=-np.inf, posinf=np.inf)
        of_top, of_others = values[:, : len(top)], np.sort(values[:, len(top) :], axis=None)
        # The others of all draws together tell how many tasks exceed a distance; each stands for so many tasks.
        weight = (len(self.tasks) - len(top)) / max(of_others.size, 1)
        maxima, points = np.full(len(draws), np.inf), self.tasks[top[np.zeros(len(draws), dtype=np.intp)]]
        allowed = self.above_for_bound
        for k, mine in enumerate(of_top if allowed is not None else ()):
            order = np.argsort(-mine, kind="stable")
            further = len(of_others) - np.searchsorted(of_others, mine[order], side="right")
            # So many tasks exceed the distance of each of the top ones, the largest first.
            exceeding = np.arange(len(order)) + weight * further
            last = int(np.flatnonzero(exceeding <= allowed).max(initial=0))
            maxima[k], points[k] = mine[order[last]], self.tasks[top[order[last]]]
        return of_mean.with_draws(maxima, points, values.size, left_out)
