"""Distances between the trajectories of M and S under the same controller."""

from __future__ import annotations

from ctxval._util.registry import Registry
from ctxval.core.distance import ComposedDistance, Distance
from ctxval.distances.deviations import (
    AtCrossing,
    AtTimes,
    CrossingTime,
    FinalState,
    GoalError,
    MaximumDeviation,
    MeanDeviation,
    RelativeDeviation,
    StateNorm,
    TrackingError,
    WholeTrajectory,
)
from ctxval.distances.motion import BodyVelocity, CommandError, ContactTime, FallTime, Orientation
from ctxval.distances.unsafe_margin import UnsafeMargin

__all__ = [
    "REGISTRY",
    "AtCrossing",
    "AtTimes",
    "BodyVelocity",
    "CommandError",
    "ComposedDistance",
    "ContactTime",
    "CrossingTime",
    "Distance",
    "FallTime",
    "FinalState",
    "GoalError",
    "MaximumDeviation",
    "MeanDeviation",
    "Orientation",
    "RelativeDeviation",
    "StateNorm",
    "TrackingError",
    "UnsafeMargin",
    "WholeTrajectory",
    "by_name",
]

REGISTRY: Registry[Distance] = Registry("distance", __name__, method="__call__")
"""The distances that are found by name: those of this package, and those that installed packages add."""

by_name = REGISTRY.make
