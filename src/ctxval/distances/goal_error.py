"""The distance between the final state of S and the goal."""

from __future__ import annotations

from dataclasses import dataclass

from ctxval._util.arrays import Array
from ctxval._util.registry import part
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import ErrorNorm


@part()
@dataclass(frozen=True, repr=False)
class GoalError(ErrorNorm):
    """Norm of the difference between the system's final state and the goal: both aspects of Remark 1 in one distance.

    With ``norm=1`` it is the formula of the paper's Remark 1, ``||xi_S(H; x_init, pi_p) - p||_1``.

    Attributes:
        norm: order of the norm: 1, 2 or infinity.
        components: indices of the states that are compared; all states by default.
        weights, scales, angles: as in :class:`StateNorm`.

    Raises:
        InputError: if the order of the norm is not 1, 2 or infinity, or another argument cannot be used.
    """

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the weighted difference between the final state of S and the goal, shape ``(..., k)``."""
        return self.difference(system_trajectory.final_state, task.goal)
