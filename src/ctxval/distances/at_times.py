"""The distance between the states of M and S at stated times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows, vector_norm
from ctxval._util.checked import Norm
from ctxval._util.registry import part
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import ErrorNorm, require_numbers
from ctxval.errors import InputError


@part()
@dataclass(frozen=True, repr=False)
class AtTimes(ErrorNorm):
    """Largest norm of the difference between the states at stated times, such as those of a grasp or a hand-over.

    Attributes:
        norm: order of the norm over the states at one time: 1, 2 or infinity.
        components: the states that are compared, by index or name; all states by default.
        times: seconds after the start of the task; each is rounded to the nearest step.
        weights, scales, angles: as in :class:`StateNorm`.
    """

    norm: Norm = 2
    times: Sequence[float] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        require_numbers("times", self.times, None, zero=True)

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the weighted differences at the times, one after the other, shape ``(..., times k)``."""
        steps = self._steps(task)
        gap = self.difference(system_trajectory.states[..., steps, :], model_trajectory.states[..., steps, :])
        return np.asarray(gap.reshape(*gap.shape[:-2], -1))

    def compose(self, error: Array) -> Array:
        """Return the largest norm over the times of error vectors ``(..., times k)``, shape ``(...)``."""
        gap = error.reshape(*error.shape[:-1], len(self.times), -1)
        return np.asarray(vector_norm(gap, self.norm).max(axis=-1))

    def _steps(self, task: Task) -> Rows:
        steps = np.round(np.asarray(self.times, dtype=np.float64) / task.dt).astype(np.intp)
        if (steps > task.horizon).any():
            end = task.horizon * task.dt
            raise InputError(f"times must not be after the end of the task at {end:g} s, got {max(self.times):g} s.")
        return steps
