"""The largest distance over time between the states of M and S."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, vector_norm
from ctxval._util.checked import Norm
from ctxval._util.registry import part
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import StateNorm


@part()
@dataclass(frozen=True, repr=False)
class MaximumDeviation(StateNorm):
    """Maximum over the times 0..H of the norm of the difference between the states, such as the largest gap in metres.

    Attributes:
        norm: order of the norm over the states at one time: 1, 2 or infinity.
        components: the states that are compared, by index or name; all states by default.
        weights, scales, angles: as in :class:`StateNorm`.
    """

    norm: Norm = 2

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        return np.asarray(vector_norm(gap, self.norm).max(axis=-1))
