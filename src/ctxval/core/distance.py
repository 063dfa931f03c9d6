"""Distances between the trajectories of M and S, and selections of states by index or name."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol, Self, runtime_checkable

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import ShapeError, UnknownNameError


@runtime_checkable
class Distance(Protocol):
    """A distance d between the closed-loop trajectories of the model and of the system."""

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return d >= 0, shape ``(...)`` over the batch.

        If no further deviation of S from M makes it smaller, as of a maximum over time, the attribute ``monotone =
        True`` says so: the steps before a failure then tell what the distance is at least.
        """


@runtime_checkable
class ComposedDistance(Protocol):
    """A distance that is a function of a short error vector; a search learns more from the vector than from d."""

    def error(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        """Return the error vector, shape ``(..., k)`` over the batch."""

    def compose(self, error: Array) -> Array:
        """Return the distances of error vectors ``(..., k)``, shape ``(...)``."""


class NamedStates(ShortRepr):
    """A dataclass with options ``components``, ``angles``, ``quaternions``, ``state``: indices or names of states."""

    def with_states(self, names: Sequence[str]) -> Self:
        """Return the same with the indices of states in place of their names, if there are names."""

        def index(value: Any) -> Any:
            if isinstance(value, str) and value not in names:
                raise UnknownNameError.among("state", value, names)
            return names.index(value) if isinstance(value, str) else value

        indices: dict[str, Any] = {}
        for option in ("components", "angles", "quaternions", "state") if names else ():
            value: Any = getattr(self, option, None)
            if isinstance(value, str):
                indices[option] = index(value)
            elif isinstance(value, list | tuple) and any(isinstance(item, str) for item in value):
                indices[option] = tuple(map(index, value))
        return dataclasses.replace(self, **indices) if indices else self  # type: ignore[type-var]


def selected(states: Array, components: Sequence[int | str] | None) -> Array:
    """Return the selected states ``(..., k)``; all states if ``components`` is None."""
    if components is None:
        return states
    return states[..., require_indices("components", components, states.shape[-1])]


def require_indices(name: str, indices: Sequence[int | str], count: int) -> list[int]:
    """Return indices of ``count`` states; negative ones count from the end."""
    right = [index for index in indices if not isinstance(index, str) and -count <= index < count]
    if len(right) < len(indices):
        wrong = next(index for index in indices if index not in right)
        unnamed = " The experiment must name its states." if isinstance(wrong, str) else ""
        raise ShapeError(f"{name} must be indices of {count} states, from 0 to {count - 1}, got {wrong!r}.{unnamed}")
    return right
