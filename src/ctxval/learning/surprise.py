"""Predictions of an execution before it is made, and how much the execution deviates from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import record
from ctxval.core.trajectory import Trajectory
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.dynamics_posterior import DynamicsDraws

_NEGLIGIBLE_STATE = 1e-4
"""A deviation of a state below this share of its range does not count as an error."""
_NEGLIGIBLE_DISTANCE = 2e-3
"""A deviation of the distance below this share of it does not count as an error."""
_DIVERGED = 1e6
"""A draw has diverged if a state exceeds this many ranges of the execution."""
_FEWEST = 10
"""Least number of draws that must not diverge."""


@dataclass(frozen=True)
class Surprise:
    """How an execution compares with its prediction.

    Attributes:
        z2: the larger of the squared standardised errors of the trajectory and of the distance.
        rank: the share of draws whose distance is below the executed one.
        median: the median of the draws' distances.
        upper: their 0.95 quantile.
        ratio: the executed distance, divided by the median.
    """

    z2: float
    rank: float
    median: float
    upper: float
    ratio: float

    def __repr__(self) -> str:
        return record(self)


def surprise(
    planner: LoopPlanner, draws: DynamicsDraws, point: Array, executed: Trajectory, distance: float
) -> Surprise | None:
    """Return how an execution compares with draws of the dynamics from earlier executions.

    Returns None if the task cannot be planned.

    Args:
        planner: designs controllers and runs closed loops.
        draws: draws of the dynamics.
        point: the task, a point of the unit cube ``(d,)``.
        executed: the trajectory of the system.
        distance: the executed distance.
    """
    found = planner.run(draws, planner.plan(point[None]))
    if not found:
        return None
    states, distances = found[0].states[:, 0], found[0].distances[:, 0]
    ranges = np.maximum(np.ptp(executed.states, axis=0), 1e-9)
    with np.errstate(invalid="ignore"):
        kept = np.isfinite(distances) & (np.abs(states / ranges) < _DIVERGED).all(axis=(1, 2))
    if kept.sum() < _FEWEST:
        # Almost every draw diverges: nothing is predicted, so nothing can be contradicted.
        return Surprise(0.0, 0.5, np.inf, np.inf, 0.0)
    states, distances = states[kept], distances[kept]
    errors = (executed.states - np.median(states, axis=0)) / ranges
    variances = (states / ranges).var(axis=0) + _NEGLIGIBLE_STATE**2
    of_states = float((errors**2).sum() / variances.sum())
    median = float(np.median(distances))
    scale2 = distances.var() + (_NEGLIGIBLE_DISTANCE * max(distance, median)) ** 2
    of_distance = (distance - median) ** 2 / max(scale2, 1e-300)
    return Surprise(
        max(of_states, float(of_distance)),
        float((distances < distance).mean()),
        median,
        float(np.quantile(distances, 0.95)),
        distance / max(median, 1e-300),
    )
