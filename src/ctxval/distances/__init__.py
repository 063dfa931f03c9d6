"""Distances between the trajectories of M and S under the same controller."""

from __future__ import annotations

from typing import Any

from ctxval._util.registry import Registry
from ctxval.core.distance import ComposedDistance, Distance
from ctxval.distances.final_state import FinalState
from ctxval.distances.goal_error import GoalError
from ctxval.distances.mean_deviation import MeanDeviation
from ctxval.distances.whole_trajectory import WholeTrajectory

__all__ = [
    "REGISTRY",
    "ComposedDistance",
    "Distance",
    "FinalState",
    "GoalError",
    "MeanDeviation",
    "WholeTrajectory",
    "by_name",
]

REGISTRY = Registry("distance", __name__, method="__call__")
"""The distances that are found by name: those of this package, and those that installed packages add."""


def by_name(name: str, /, **arguments: Any) -> Distance:
    """Return a new distance from its name and its arguments.

    Args:
        name: of :data:`REGISTRY`, such as ``"FinalState"``.
        arguments: those of its class.

    Raises:
        UnknownNameError: there is no such distance, or it takes no such argument; the message has the nearest name.
        InputError: the distance refuses these arguments.
    """
    made: Distance = REGISTRY.make(name, **arguments)
    return made
