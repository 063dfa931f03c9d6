"""The distance between whole trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, as_norm_order, vector_norm
from ctxval._util.registry import part
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import selected


@part()
@dataclass(frozen=True)
class WholeTrajectory:
    """Norm of the difference between whole trajectories, taken as one long vector.

    With ``norm=inf`` it is the distance of the paper's OLDT and CCDT. With ``norm=2, per_step=True`` it is the formula
    printed for the Dubins car, ``1/H ||xi_S - xi_M||_2``.

    Attributes:
        norm: order of the norm over times and states together: 1, 2 or infinity.
        components: indices of the states that are compared; all states by default.
        per_step: whether the norm is divided by the horizon H.

    Raises:
        InputError: if the order of the norm is not 1, 2 or infinity.
    """

    norm: float = np.inf
    components: Sequence[int] | None = None
    per_step: bool = False

    def __post_init__(self) -> None:
        as_norm_order(self.norm)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        gap = selected(system_trajectory.states - model_trajectory.states, self.components)
        whole = vector_norm(gap.reshape(*gap.shape[:-2], -1), self.norm)
        return whole / task.horizon if self.per_step else whole
