"""The vectors of which the distances of executions are composed, such as errors of the final state."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from weakref import WeakKeyDictionary

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.progress import advance
from ctxval.core.distance import ComposedDistance
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.learning.closed_loops import LoopPlanner

Executed = Sequence[tuple[Array, Trajectory]]
"""Points of the unit cube ``(d,)`` with the system's trajectories there."""


def executions_of(executed: Array, points: Iterable[Array]) -> list[list[int]]:
    """Return the rows of executed points ``(n, d)`` at each of some points ``(d,)``."""
    return [np.flatnonzero((executed.reshape(-1, len(point)) == point).all(axis=1)).tolist() for point in points]


class ErrorVectors:
    """Computes the vectors of executions; each needs the design of a controller, so they are kept.

    A vector is kept as long as its trajectory is.

    Args:
        planner: designs controllers.
    """

    def __init__(self, planner: LoopPlanner) -> None:
        self.validation = planner.validation
        self._planner = planner
        self._known: WeakKeyDictionary[Trajectory, Array] = WeakKeyDictionary()

    def of(self, executed: Executed) -> Array | None:
        """Return the vectors of executions ``(n, k)``.

        Returns None if the distance is not composed of a vector, or if there are fewer than two executions, or if a
        vector cannot be computed.
        """
        distance = self.validation.distance
        if not isinstance(distance, ComposedDistance) or len(executed) < 2:
            return None
        try:
            errors = np.array([self._of(distance, *pair) for pair in executed])
        except Exception:  # the user's own parts: a distance may reject even tasks that were executed
            return None
        return errors if errors.ndim == 2 and np.isfinite(errors).all() else None

    def _of(self, distance: ComposedDistance, point: Array, trajectory: Trajectory) -> Array:
        known = self._known.get(trajectory)
        if known is None:
            task, promised = self._planned(point)
            # Some distances change the arrays that they are given.
            known = self._known[trajectory] = distance.error(promised.copy(), trajectory.copy(), task)
        return known

    def _planned(self, point: Array) -> tuple[Task, Trajectory]:
        """Return a task and the trajectory of M, without batch axes."""
        if self._planner.batched:
            plan = self.validation.plan(self.validation.space.from_unit(point))
            advance()
            return plan.task, plan.model_trajectory
        (planned,) = self._planner.plan(point[None])
        return planned.task, planned.promised
