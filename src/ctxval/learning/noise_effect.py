"""How much noise changes the distance of a task, and so whether it matters.

The better M is, the smaller its residual, and the larger the share of noise in it. So noise is not judged by this
share, but by what it does to distances in closed loop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, single_threaded
from ctxval.learning.closed_loops import LoopPlanner, PlannedTasks
from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.noisy_draws import NoisyPosterior

_TASKS, _RUNS = 6, 10
_ROUNDING = 1e-5  # standard deviation of noise, as a share of a state's, below which it is rounding


def effect_of_noise(planner: LoopPlanner, posterior: DynamicsPosterior | NoisyPosterior, tasks: Array) -> float:
    """Return the largest standard deviation of the distance of tasks ``(q, d)`` over noise, as a share of the largest.

    Of the tasks, those with the largest distances count. Only finite distances do.
    """
    if not _matters(_deviations(posterior), posterior) and not _matters(_scatter(posterior), posterior):
        return 0.0
    with single_threaded(), np.errstate(all="ignore"):
        planned, count, largest = _largest(planner, posterior, tasks)
        runs = np.full((_RUNS, count), np.nan)
        noisy = posterior.mean if isinstance(posterior, NoisyPosterior) else _shaken(posterior)
        for plan, loops in zip(planned, planner.run(noisy, planned), strict=True):
            runs[: len(loops.distances), plan.rows] = loops.distances[:_RUNS]
    return _share(runs, largest)


def effect_of_starts(planner: LoopPlanner, posterior: DynamicsPosterior, tasks: Array, scatter: Array) -> float:
    """Return the same over initial states that deviate from those of the tasks by standard deviations ``(n,)``."""
    if not _matters(scatter, posterior):
        return 0.0
    rng = np.random.default_rng(0)
    with single_threaded(), np.errstate(all="ignore"):
        planned, count, largest = _largest(planner, posterior, tasks)
        runs = []
        for _ in range(_RUNS):
            starts = (one.task.initial_state for one in planned)
            moved = [start + scatter * rng.standard_normal(start.shape) for start in starts]
            tried = [replace(one, task=one.task.starting_at(x)) for one, x in zip(planned, moved, strict=True)]
            runs.append(planner.distances(posterior.silent, tried, count)[0])
    return _share(np.stack(runs), largest)


def _largest(
    planner: LoopPlanner, posterior: DynamicsPosterior | NoisyPosterior, tasks: Array
) -> tuple[list[PlannedTasks], int, float]:
    """Return the plans of the tasks with the largest distances without noise, their number, and the largest one."""
    planned = planner.plan(tasks)
    distances = np.nan_to_num(planner.distances(posterior.silent, planned, len(tasks))[0], nan=-1.0, posinf=-1.0)
    chosen = tasks[np.argsort(-distances, kind="stable")[:_TASKS]]
    return planner.plan(chosen), len(chosen), float(distances.max())


def _share(runs: Array, largest: float) -> float:
    """Return the largest standard deviation over runs ``(R, q)`` of finite distances as a share of the largest one."""
    runs = runs[:, np.isfinite(runs).any(axis=0)]
    if not runs.size or not largest > 0:
        return 0.0
    finite = np.where(np.isfinite(runs), runs, np.nan)
    return float(np.nanmax(np.nanstd(finite, axis=0)) / largest)


def _matters(deviations: Array, posterior: DynamicsPosterior | NoisyPosterior) -> bool:
    """Return whether standard deviations ``(n,)`` of states are more than rounding."""
    return bool((deviations > _ROUNDING * posterior.data.scale[: len(posterior.data.sizes)]).any())


def _scatter(posterior: DynamicsPosterior | NoisyPosterior) -> Array:
    """Return the learned standard deviations of initial states, shape ``(n,)``; they are 0 if there is no noise."""
    return posterior.scatter if isinstance(posterior, NoisyPosterior) else np.zeros(len(posterior.data.sizes))


def _deviations(posterior: DynamicsPosterior | NoisyPosterior) -> Array:
    """Return the learned standard deviations of the noise of each state in a step, shape ``(n,)``."""
    if isinstance(posterior, NoisyPosterior):
        return posterior.fit.noise
    data = posterior.data
    deviations = np.zeros(len(data.sizes))
    deviations[data.learned] = posterior.most_probable.noise * data.sizes[data.learned]
    return deviations


def _shaken(posterior: DynamicsPosterior) -> ShakenDynamics:
    """Return the posterior mean with white noise as large as was learned."""
    mean, data, deviations = posterior.mean, posterior.data, _deviations(posterior)
    return ShakenDynamics(
        model=posterior.model,
        data=data,
        expansions=mean.expansions,
        limit=mean.limit,
        deviations=deviations,
        runs=_RUNS,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ShakenDynamics(DynamicsDraws):
    """One model with white noise in each step, several times: models that are run together, as draws are.

    Attributes:
        deviations: standard deviations of the noise of each state, shape ``(n,)``.
        runs: how many times.
    """

    deviations: Array
    runs: int
    first: int = 0

    def __len__(self) -> int:
        return self.runs

    def __getitem__(self, rows: ArrayLike) -> ShakenDynamics:
        chosen = np.atleast_1d(rows)
        return replace(self, runs=len(chosen), first=int(chosen[0]))

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``."""
        # The noise is a function of the states, so that a loop is the same each time.
        seed = np.frombuffer(np.ascontiguousarray(x).tobytes()[-64:], dtype=np.uint32)
        rng = np.random.default_rng([self.first, *seed.tolist()])
        return np.asarray(self.alone(x, u) + self.deviations * rng.standard_normal(x.shape))
