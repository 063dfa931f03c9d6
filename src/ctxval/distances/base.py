"""The base class and a helper of the ready-made distances: a norm, and a selection of states."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from ctxval._util.arrays import Array, as_norm_order, vector_norm
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory


def selected(states: Array, components: Sequence[int] | None) -> Array:
    """Return the selected states ``(..., k)``; all states if ``components`` is None."""
    return states if components is None else states[..., list(components)]


@dataclass(frozen=True)
class ErrorNorm(ABC):
    """Norm of an error vector of the trajectories of one task.

    Attributes:
        norm: order of the norm: 1, 2 or infinity.
        components: indices of the states that are compared; all states by default.

    Raises:
        InputError: if the order of the norm is not 1, 2 or infinity.
    """

    norm: float = 1
    components: Sequence[int] | None = None

    def __post_init__(self) -> None:
        as_norm_order(self.norm)

    @abstractmethod
    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the error vector, shape ``(..., k)``; the distance is its norm."""

    def compose(self, error: Array) -> Array:
        """Return the norms of error vectors ``(..., k)``, shape ``(...)``."""
        return vector_norm(error, self.norm)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        return self.compose(self.error(model_trajectory, system_trajectory, task))
