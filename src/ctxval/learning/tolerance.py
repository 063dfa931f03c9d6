"""What a bound survives: the largest distance if something that no record shows pushes the system.

The bound from learned dynamics rests on a prior. This asks how wrong the prior may be: each learned state of the
posterior mean is pushed in each step, by multiples of the largest residual that was recorded, everywhere or only where
no record is near. A contact that nobody met, or a load that nobody carried, is such a push.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.texts import parted
from ctxval.core.learned_numbers import PushedDistances
from ctxval.learning.closed_loops import LoopPlanner, distances_of
from ctxval.learning.draws import DisturbedDynamics, DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior

LEVELS = np.array([0.0, *2.0 ** np.arange(-4, 4)])  # sizes of pushes, as multiples of the largest recorded residual


def push_response(
    planner: LoopPlanner, posterior: DynamicsPosterior, tasks: Array, labels: Sequence[str]
) -> PushedDistances:
    """Return the largest distances over tasks ``(q, d)`` if the posterior mean is pushed in each learned state.

    These are the states in which M errs; ``labels`` are those of all states. Distances of rollouts that diverge are
    infinity.
    """
    data, planned = posterior.data, planner.plan(tasks)
    states, n = np.flatnonzero(data.learned), len(data.sizes)
    residuals = (np.abs(data.outputs).max(axis=0) * data.sizes)[states]
    pushes = np.zeros((len(states), 2, len(LEVELS) - 1, n))
    pushes[np.arange(len(states)), 0, :, states] = residuals[:, None] * LEVELS[1:]
    pushes[:, 1] = -pushes[:, 0]
    with single_threaded():
        loops = planner.run(posterior.mean, planned)
        unpushed = np.nan_to_num(distances_of(posterior.mean, loops, planned, len(tasks)), nan=0.0, posinf=np.inf)
        visited = data.geometry.features(np.concatenate([each.states.reshape(-1, n) for each in loops]))
        low, high = np.quantile(visited[np.isfinite(visited).all(axis=1)], [1e-3, 1 - 1e-3], axis=0)
        widths = np.maximum(high - low, 1e-9)
        recorded = scipy.spatial.cKDTree((data.pairs * data.scale + data.shift)[:, :n] / widths)
        largest = []
        for near in (None, recorded):
            dynamics = pushed(posterior.mean, pushes.reshape(-1, n), widths, near)
            distances = np.nan_to_num(planner.distances(dynamics, planned, len(tasks)), nan=0.0, posinf=np.inf)
            signed = distances.max(axis=1).reshape(pushes.shape[:3]).max(axis=1)
            without = np.full((len(states), 1), unpushed.max())
            largest.append(np.maximum.accumulate(np.concatenate([without, signed], axis=1), axis=1))
    rates = []
    for name, unit in (parted(labels[i]) for i in states.tolist()):
        per_second = f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"
        rates.append(f"{name} [{per_second}]" if unit else name)
    of_rates = dict(zip(rates, (residuals / planned[0].task.dt).tolist(), strict=True))
    return PushedDistances(of_rates, LEVELS, *largest)


def pushed(
    mean: DynamicsDraws, pushes: Array, widths: Array | float = 1.0, recorded: scipy.spatial.cKDTree | None = None,
    near: float = 0.05,
) -> DisturbedDynamics:  # fmt: skip
    """Return a model that is pushed by ``(S, n)``, everywhere or away from records, in units of the widths ``(n,)``.

    A record shows the states that are ``near`` it in each coordinate.
    """

    def added(ways: Rows, x: Array) -> Array:
        if recorded is None:
            return np.asarray(pushes[ways, None])
        scaled = np.clip(np.nan_to_num(mean.data.geometry.features(x) / widths), -1e6, 1e6)
        distance, _ = recorded.query(scaled, p=np.inf, distance_upper_bound=near)
        return np.asarray(pushes[ways, None] * np.isinf(distance)[..., None])

    return DisturbedDynamics(mean, np.arange(len(pushes)), added)
