"""The distance between the final states of M and S."""

from __future__ import annotations

from dataclasses import dataclass

from ctxval._util.arrays import Array
from ctxval._util.registry import part
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import ErrorNorm


@part()
@dataclass(frozen=True, repr=False)
class FinalState(ErrorNorm):
    """Norm of the difference between the final states (the paper's eq. 4, with ``norm=1``).

    Attributes:
        norm: order of the norm: 1, 2 or infinity.
        components: the states that are compared, by index or name; all states by default.
        weights, scales, angles: as in :class:`StateNorm`.
    """

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the weighted difference between the final states, shape ``(..., k)``."""
        return self.difference(system_trajectory.final_state, model_trajectory.final_state)
