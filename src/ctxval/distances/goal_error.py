"""The distance between the final state of S and the goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

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
        components: the states that are compared, by index or name; all states by default.
        weights, scales, angles: as in :class:`StateNorm`.
    """

    to_task: ClassVar[bool] = True
    """Whether it measures the system against the task, so that it need not be 0 if the system is like the model."""

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the weighted difference between the final state of S and the goal, shape ``(..., k)``."""
        return self.difference(system_trajectory.final_state, task.goal)
