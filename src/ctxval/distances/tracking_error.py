"""The distance between the trajectory of S and the reference of its task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from ctxval._util.arrays import Array, vector_norm
from ctxval._util.checked import Norm
from ctxval._util.registry import part
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import StateNorm

Over = Literal["maximum", "mean"]


@part()
@dataclass(frozen=True, repr=False)
class TrackingError(StateNorm):
    """Norm of the difference between S and the reference that it follows, the maximum or the mean over the times 1..H.

    It is the combined measure of Remark 1 for tasks with a reference: :class:`GoalError` is that for tasks with a goal.

    Attributes:
        norm: order of the norm over the states at one time: 1, 2 or infinity.
        components: the states that are compared, by index or name; all states by default.
        over: ``maximum`` or ``mean``: how the norms at the times are combined.
        weights, scales, angles: as in :class:`StateNorm`.
    """

    to_task: ClassVar[bool] = True

    norm: Norm = 2
    over: Over = "maximum"

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        gap = self.difference(system_trajectory.states, task.reference)[..., 1:, :]
        norms = vector_norm(gap, self.norm)
        return np.asarray(norms.max(axis=-1) if self.over == "maximum" else norms.mean(axis=-1))
