"""The contracts of distances between the trajectories of M and S."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ctxval._util.arrays import Array
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory


@runtime_checkable
class Distance(Protocol):
    """A distance d between the closed-loop trajectories of the model and of the system."""

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return d >= 0, shape ``(...)`` over the batch."""


@runtime_checkable
class ComposedDistance(Protocol):
    """A distance that is a function of a short error vector; a search learns more from the vector than from d."""

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the error vector, shape ``(..., k)`` over the batch."""

    def compose(self, error: Array) -> Array:
        """Return the distances of error vectors ``(..., k)``, shape ``(...)``."""
