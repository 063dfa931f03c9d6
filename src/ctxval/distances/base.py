"""What the ready-made distances share: a norm, and the states that count."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from ctxval._util.arrays import Array, as_norm_order, vector_norm
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory


def selected(states: Array, components: Sequence[int] | None) -> Array:
    """Return the states ``(..., k)`` that count; all of them if ``components`` is None."""
    return states if components is None else states[..., list(components)]


@dataclass(frozen=True)
class ErrorNorm(ABC):
    """Norm of a vector that the trajectories of one task give.

    Attributes:
        norm: 1, 2 or infinity.
        components: indices of the states that count; all of them by default.

    Raises:
        InputError: the norm is another one.
    """

    norm: float = 1
    components: Sequence[int] | None = None

    def __post_init__(self) -> None:
        as_norm_order(self.norm)

    @abstractmethod
    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the vector whose norm the distance is, shape ``(..., k)``."""

    def compose(self, error: Array) -> Array:
        """Return the norm of vectors ``(..., k)``, shape ``(...)``."""
        return vector_norm(error, self.norm)

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the distance, shape ``(...)``."""
        return self.compose(self.error(model_trajectory, system_trajectory, task))
