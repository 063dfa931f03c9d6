"""How far single executions are from what others predict: positive statistics of each run, one of each kind.

Each statistic is about 1 or less if the learned dynamics and their doubt are right, and if what is missing moves
distances by less than a negligible share of the threshold. The residuals of a state give two: their mean square, and
that of their part that is linear in state and input, which shows what noise hides of a heavier load or a weaker motor.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.core.learned_numbers import Statistic
from ctxval.core.trajectory import Trajectory
from ctxval.learning.dynamics_study import DynamicsStudy
from ctxval.learning.histories import Record
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.tolerance import pushed


@dataclass(frozen=True, eq=False)
class RunStatistics:
    """The statistics of runs beside what was learned."""

    learned: LearnedDynamics  # from the certified executions
    threshold: float  # tau
    # what a unit of a constant residual of each state moves the distance of each executed task by, (n, q)
    influences: Array

    @classmethod
    def of(cls, learned: LearnedDynamics, threshold: float) -> RunStatistics:
        """Return the statistics of runs beside what executions teach."""
        return cls(learned, threshold, influences(learned))

    @property
    def negligible(self) -> float:
        """The distance that is no change if residuals move none by more."""
        return self.learned.study.settings.agreement.share * self.threshold

    @property
    def floors(self) -> Array:
        """The residuals of each state that move no distance by more than a negligible share, shape ``(n,)``."""
        steps = self.learned.posterior.data.steps
        largest = np.maximum(self.influences.max(axis=1), 1e-300)
        # Limits of negligible residuals are shares of a state's typical step.
        return np.asarray(np.clip(self.negligible / largest, 1e-6 * steps, 0.3 * steps))

    @property
    def has_noise(self) -> bool:
        """Whether residuals are noise, whose law is known, rather than what a function has left unknown."""
        return self.learned.noisy is not None and self.learned.noisy.is_noisy

    def certified(self, k: int, distance: float) -> dict[str, Statistic] | None:
        """Return the statistics of one of the executions, predicted from the others; None if nothing predicts it."""
        others = self.learned.study.without(self.learned, k)
        if others is None:
            return None
        point, trajectory = self.learned.executions[k]
        return self.later(trajectory, point, distance, others)

    def later(
        self,
        trajectory: Trajectory,
        point: Array | None,
        distance: float | None,
        learned: LearnedDynamics | None = None,
    ) -> dict[str, Statistic]:
        """Return the statistics of a later run; without its task ``(d,)`` and distance, only those of the residuals."""
        learned = self.learned if learned is None else learned
        study, floors = learned.study, self.floors**2
        if point is None:
            acting = study.extended.effects.acting(trajectory.inputs)
            record = Record(trajectory.states, acting, trajectory.states[0])
        else:
            (record,) = study.extended.records([(point, trajectory)])
        with single_threaded(), np.errstate(all="ignore"):
            residuals, doubt, noise, regressors = _residuals(learned, record)
        H = len(residuals)
        columns = np.concatenate([np.ones((H, 1)), regressors], axis=1)
        U, S, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
        basis = U[:, 1e-3 * S[0] < S]
        rank = basis.shape[1]
        linear = ((basis.T @ residuals) ** 2).sum(axis=0) / H
        whole = ((residuals**2).mean(axis=0) + floors) / (doubt + noise + floors)
        trend = (linear + floors) / (doubt + noise * rank / H + floors)
        gradients = columns.T @ (residuals / (noise + floors))  # (k, n)
        information = columns.T @ columns
        statistics = {}
        for i, name in enumerate(names(study, len(whole))):
            statistics[f"{name} residuals"] = Statistic(float(whole[i]), freedom=float(H))
            slope, known = (gradients[:, i], information / (noise + floors)[i]) if self.has_noise else (None, None)
            statistics[f"systematic {name} residuals"] = Statistic(float(trend[i]), slope, known, float(rank))
        if point is not None and distance is not None:
            predicted = None
            with contextlib.suppress(Exception):  # the user's parts, at states that no execution has reached
                predicted = learned.predict(point)
            if predicted is not None and np.isfinite(predicted.median):
                least = self.negligible**2
                error = (distance - predicted.median) ** 2
                statistics[DISTANCE] = Statistic(float((error + least) / (predicted.deviation**2 + least)), freedom=1.0)
        return statistics


# The statistic of the executed distance: its squared error, standardised by the draws of the dynamics.
DISTANCE = "errors of the predicted distance"


def names(study: DynamicsStudy, states: int) -> Sequence[str]:
    """Return the names of the states; the last ones are task parameters if these are states, and never change."""
    return list(study.validation.names(states, 0)[0])[: states - study.extended.parameters]


def influences(learned: LearnedDynamics) -> Array:
    """Return what a unit of a constant residual of each state moves the distance of executed tasks by, ``(n, q)``."""
    posterior, planner = learned.posterior, learned.study.planner
    data, n = posterior.data, len(posterior.data.sizes)
    # Sizes of the pushes that show what a residual does to distances, as shares of the residuals.
    sizes = np.maximum(0.1 * data.sizes, 1e-3 * data.steps)
    pushes = np.concatenate([np.zeros((1, n)), np.diag(sizes), -np.diag(sizes)])
    with single_threaded():
        planned = planner.plan(learned.executed)
        distances = planner.distances(pushed(posterior.mean, pushes), planned, len(learned.executed))
    moved = np.abs(distances[1:] - distances[0]).reshape(2, n, -1).max(axis=0)
    return np.asarray(np.where(np.isfinite(moved), moved, 0.0) / sizes[:, None])


def _residuals(learned: LearnedDynamics, record: Record) -> tuple[Array, Array, Array, Array]:
    """Return residuals ``(H, n)``, mean squares of doubt and noise, ``(n,)``, and regressors ``(H, k)`` of a record."""
    noisy, posterior = learned.noisy, learned.posterior
    if noisy is None:
        data, most = posterior.data, posterior.most_probable
        residuals = record.states[1:] - posterior.mean.step(record.states[:-1], record.inputs)
        Z = data.standardised(record.states[:-1], record.inputs)
        doubt = np.zeros(len(data.sizes))
        variance = most.whitened(Z)[1].mean() * most.squares / len(most.centres)
        doubt[data.learned] = variance * data.sizes[data.learned] ** 2
        return residuals, doubt, posterior.deviations**2, Z
    fit = noisy.fit
    Z, _, residuals = fit.history.along([record], fit.residual)
    z = (Z - fit.scaled.shift) / fit.scaled.scale
    pairs = z[:, : record.states.shape[1] + record.inputs.shape[1]]
    drawn = fit.draw(4, 5, np.random.default_rng(0))
    values = np.concatenate([features(z) @ weights for features, weights, _ in drawn])  # (k, H, n)
    relative = 1.0 if fit.local is None else float((fit.local(pairs) ** 2).mean())
    return residuals, values.var(axis=0).mean(axis=0), fit.noise**2 * relative, pairs
