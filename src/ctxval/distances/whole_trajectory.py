"""The distance between whole trajectories."""

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
class WholeTrajectory(StateNorm):
    """Norm of the difference between whole trajectories, taken as one long vector.

    With ``norm=inf`` it is the distance of the paper's OLDT and CCDT. With ``norm=2, per_step=True`` it is the formula
    printed for the Dubins car, ``1/H ||xi_S - xi_M||_2``.

    Attributes:
        norm: order of the norm over times and states together: 1, 2 or infinity.
        components: the states that are compared, by index or name; all states by default.
        weights, scales, angles: as in :class:`StateNorm`.
        per_step: whether the norm is divided by the horizon H.
    """

    norm: Norm = np.inf
    per_step: bool = False

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        whole = vector_norm(gap.reshape(*gap.shape[:-2], -1), self.norm)
        return whole / task.horizon if self.per_step else whole
