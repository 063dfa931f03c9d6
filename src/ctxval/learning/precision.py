"""Errors of M that are rounding, or that are far too small for the threshold: they are bounded, and not learned.

M may be the system itself: a port, a rewrite in another language, a simulator in single precision or with another
solver. Its residual is then no function of state and input, and a Gaussian process of it says nothing. So the law of
the system is M with an error bound, and this module computes what such errors do to distances in closed loop.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval.core.model import Model
from ctxval.core.trajectory import Transitions
from ctxval.learning.closed_loops import Loops
from ctxval.learning.dynamics_posterior import DynamicsPosterior, LearnedCovariances, PosteriorSettings
from ctxval.learning.hyperparameters import FAMILIES, HyperparameterPosterior
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.prediction import Executed
from ctxval.learning.residual_data import epsilons, floors, residual_data
from ctxval.learning.tolerance import pushed
from ctxval.learning.worst_case import WorstCase


@dataclass(frozen=True, eq=False)
class AgreeingDynamics(LearnedDynamics):
    """M itself, with an error bound: it explains all executions up to negligible errors."""

    allowed: float = 0.0  # the largest distance that is negligible beside the threshold; 0 if only rounding is

    def is_rounding(self, executed: Executed) -> bool:
        """Return whether errors in executions, as they were recorded, are rounding."""
        recorded = np.concatenate([trajectory.states[1:] for _, trajectory in executed])
        data, epsilon = self.posterior.data, float(epsilons(recorded).min())
        return bool((data.sizes <= floors(data.transitions.x_next, data.steps, epsilon)).all())

    @property
    def left_out_error(self) -> float:
        """The share of the error of M that executions leave to predict: none that matters."""
        return 0.0

    @functools.cached_property
    def _under_errors(self) -> tuple[Array, Array]:
        """Tasks ``(q, d)``, the executed ones first, and their largest distances if M errs in each step."""
        planner, data, settings = self.study.planner, self.posterior.data, self.study.settings.agreement
        x, u, following = data.transitions.x, data.transitions.u, data.transitions.x_next
        with np.errstate(all="ignore"):
            predicted = self.posterior.covariances.model.step(x, u)
            recorded = np.abs(data.geometry.missed(following, predicted, x)).max(axis=0)
        least = np.maximum(epsilons(following) * np.abs(following).max(axis=0), 1e-300)
        # The next power of 2 stays the same after most executions, so that closed loops need not be run again.
        errors = 2 ** np.ceil(np.log2(np.maximum(recorded, least)))
        count = settings.tasks if planner.batched else settings.tasks_alone
        points = np.concatenate([self.executed, self.search.pool[:count]])
        known = self.study.under_errors.setdefault(errors.tobytes(), {})
        new = np.array([point for point in points if point.tobytes() not in known])
        if len(new):
            signs = np.random.default_rng(0).choice([-1.0, 1.0], (settings.ways, len(errors)))
            with single_threaded(), np.errstate(all="ignore"):
                moved = planner.distances(pushed(self.posterior.mean, signs * errors), planner.plan(new), len(new))
            largest = np.nan_to_num(moved, nan=0.0, posinf=np.inf).max(axis=0)
            known |= {point.tobytes(): float(distance) for point, distance in zip(new, largest, strict=True)}
        return points, np.array([known[point.tobytes()] for point in points])

    @functools.cached_property
    def _pool_loops(self) -> list[Loops]:
        """The closed loops of M on the pool's tasks, which are planned already."""
        nominal = [(plan.nominal.states, plan.nominal.inputs) for plan in self.search.plans]
        loops = [[part.reshape(1, -1, *part.shape[-2:]) for part in parts] for parts in nominal]
        return [Loops(np.zeros(states.shape[:2]), states, inputs) for states, inputs in loops]

    @functools.cached_property
    def negligible(self) -> float:
        """The largest distance of any task under such errors.

        Errors that follow the motion add up to more than constant ones do, which the executed distances show.
        """
        (_, distances), settings = self._under_errors, self.study.settings.agreement
        executed = np.array([self.study.planner.distance_of(*each) for each in self.executions])
        expected = distances[: len(executed)]
        ratios = np.divide(executed, expected, out=np.zeros(len(executed)), where=expected > 0)
        return float(distances.max()) * float(
            np.clip(settings.margin * ratios.max(initial=0.0), 1.0, settings.amplified)
        )

    def worst_case_of(self, draws: int) -> WorstCase:
        """Return the largest distance under negligible errors, for each of so many draws."""
        points, distances = self._under_errors
        order = np.argsort(-distances, kind="stable")[: self.search.settings.local_maxima]
        maxima = np.full(self.posterior.functions_for(draws), self.negligible)
        plans = self.search.plans
        unplanned = 1 - sum(int(np.sum(plan.nominal.finite)) for plan in plans) / len(self.search.pool)
        at = np.repeat(points[order[:1]], len(maxima), axis=0)
        loops = self.study.settings.agreement.ways * len(points)
        return WorstCase(maxima, at, self.negligible, points[order], loops, 0.0, unplanned)

    @functools.cached_property
    def worst_of_mean(self) -> WorstCase:
        """The largest distance under negligible errors."""
        return self.worst_case_of(1)

    @property
    def screened(self) -> WorstCase:
        """The largest distance under negligible errors."""
        return self.worst_of_mean


def agreeing_posterior(
    model: Model, transitions: Transitions, sources: Rows, seed: tuple[int, ...]
) -> DynamicsPosterior | None:
    """Return a posterior of no residual, whose mean and draws are M; None if too few transitions are usable."""
    data = residual_data(model, transitions, sources, unlearned=True)
    if data is None:
        return None
    with single_threaded():
        prior = HyperparameterPosterior.given(data.pairs[:1], data.outputs[:1, :0], data.inputs, FAMILIES[:1])
    settings = PosteriorSettings(hyperparameters=1, centres=1, pivots=0)
    return DynamicsPosterior(LearnedCovariances(model, False, data.scale, prior, settings, seed), data)
