"""The distance between the states of M and S, relative to how far each state moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, vector_norm
from ctxval._util.checked import Norm
from ctxval._util.registry import part
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances.base import StateNorm, require_numbers, selected


@part()
@dataclass(frozen=True, repr=False)
class RelativeDeviation(StateNorm):
    """Maximum over time of the norm of relative errors: the gap of each state, divided by its range on the model.

    The range is that of the state in the trajectory of M for the same task. The distance has no unit: 0.1 means that S
    is away from M by a tenth of the model's own motion.

    Attributes:
        norm: order of the norm over the states at one time: 1, 2 or infinity.
        components: the states that are compared, by index or name; all states by default.
        least: smallest range that a gap is divided by, for each compared state in its unit. A smaller range of M counts
            as this one, because a state at rest would otherwise have an unbounded relative error.
        weights, scales, angles: as in :class:`StateNorm`.
    """

    norm: Norm = np.inf
    least: Sequence[float] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        require_numbers("least", self.least, self.components, zero=False)

    def mixed_units(self, units: Sequence[str]) -> tuple[str, ...]:
        """Return no units, because a relative error has none."""
        return ()

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        gap = self.difference(system_trajectory.states, model_trajectory.states)
        moved = selected(np.ptp(model_trajectory.states, axis=-2), self.components)
        ranges = np.maximum(moved, np.asarray(self.least, dtype=np.float64))
        return np.asarray(vector_norm(gap / ranges[..., None, :], self.norm).max(axis=-1))
