"""Context-specific distances between the trajectories of M and S under the same controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from ctxval.arrays import Array, as_norm_order, vector_norm
from ctxval.task import Task
from ctxval.trajectory import Trajectory


@runtime_checkable
class Distance(Protocol):
    """A distance d between the closed-loop trajectories of the model and of the system."""

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return d >= 0, shape ``(...)`` over the batch."""


@runtime_checkable
class ComposedDistance(Protocol):
    """A distance that is a plain function of a short vector; a search learns more from the vector than from d."""

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the vector, shape ``(..., k)`` over the batch."""

    def compose(self, error: Array) -> Array:
        """Return the distance of vectors ``(..., k)``, shape ``(...)``."""


@dataclass(frozen=True)
class FinalState:
    """Norm of the difference between the final states (the paper's eq. 5, with ``norm=1``).

    Attributes:
        norm: 1, 2 or infinity.
        components: which states count; all of them by default.
    """

    norm: float = 1
    components: Sequence[int] | None = None

    def __post_init__(self) -> None:
        as_norm_order(self.norm)

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the vector whose norm the distance is, shape ``(..., k)``."""
        return _chosen(system_trajectory.final_state - model_trajectory.final_state, self.components)

    def compose(self, error: Array) -> Array:
        """Return the norm of vectors ``(..., k)``, shape ``(...)``."""
        return vector_norm(error, self.norm)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        return self.compose(self.error(model_trajectory, system_trajectory, task))


@dataclass(frozen=True)
class WholeTrajectory:
    """Norm of the difference between whole trajectories, as one long vector.

    ``norm=inf`` is the distance of the paper's OLDT and CCDT; ``norm=2, per_step=True`` the one printed for the
    Dubins car, ``1/H ||xi_S - xi_M||_2``.

    Attributes:
        norm: 1, 2 or infinity, over times and states together.
        components: which states count; all of them by default.
        per_step: divide by the horizon H.
    """

    norm: float = np.inf
    components: Sequence[int] | None = None
    per_step: bool = False

    def __post_init__(self) -> None:
        as_norm_order(self.norm)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        gap = _chosen(system_trajectory.states - model_trajectory.states, self.components)
        whole = vector_norm(gap.reshape(*gap.shape[:-2], -1), self.norm)
        return whole / task.horizon if self.per_step else whole


@dataclass(frozen=True)
class MeanDeviation:
    """Mean over the times 1..H of the norm of the difference between the states, e.g. an average in metres.

    Attributes:
        norm: 1, 2 or infinity, over the states at one time.
        components: which states count; all of them by default.
    """

    norm: float = 2
    components: Sequence[int] | None = None

    def __post_init__(self) -> None:
        as_norm_order(self.norm)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        gap = _chosen(system_trajectory.states - model_trajectory.states, self.components)
        return np.asarray(vector_norm(gap[..., 1:, :], self.norm).mean(axis=-1))


@dataclass(frozen=True)
class GoalError:
    """Norm of the difference between the system's final state and the goal: both aspects of Remark 1 in one.

    Attributes:
        norm: 1, 2 or infinity.
        components: which states count; all of them by default.
    """

    norm: float = 1
    components: Sequence[int] | None = None

    def __post_init__(self) -> None:
        as_norm_order(self.norm)

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the vector whose norm the distance is, shape ``(..., k)``."""
        return _chosen(system_trajectory.final_state - task.goal, self.components)

    def compose(self, error: Array) -> Array:
        """Return the norm of vectors ``(..., k)``, shape ``(...)``."""
        return vector_norm(error, self.norm)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        return self.compose(self.error(model_trajectory, system_trajectory, task))


def _chosen(states: Array, components: Sequence[int] | None) -> Array:
    return states if components is None else states[..., list(components)]
