"""How far closed loops of tasks lead from what is recorded, by the labels of states and inputs."""

from __future__ import annotations

from dataclasses import dataclass

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr


@dataclass(frozen=True, eq=False)
class StateInputGap(ShortRepr):
    """A gap between the states and inputs that closed loops visit and those that are recorded.

    Attributes:
        size: its size, as a share of the visited range.
        coordinates: its coordinates, such as ``angle [rad]``, or ``x[1]`` and ``u[0]`` if they have no names.
        place: the visited state and input, by coordinate, in the units of the system.
    """

    size: float
    coordinates: tuple[str, ...]
    place: dict[str, float]


@dataclass(frozen=True, eq=False)
class StateInputCoverage(ShortRepr):
    """The largest gaps between the states and inputs that closed loops visit and those that are recorded.

    Attributes:
        marginal: the largest gap in a single coordinate.
        beyond: the largest excess over the largest record of a single coordinate, or below its smallest one.
        pair: the largest gap in two coordinates together; None if there are too many coordinates to compare pairs.
        resolution: the largest gap of each coordinate, in its unit.
        task: the task whose closed loop leads farthest from the records, a point of the unit cube ``(d,)``.
        tasks: the number of tasks that were compared.
    """

    marginal: StateInputGap
    beyond: StateInputGap
    pair: StateInputGap | None
    resolution: dict[str, float]
    task: Array
    tasks: int


@dataclass(frozen=True)
class StatePocket:
    """The largest region of two states that closed loops of tasks enter, and that no execution has entered.

    Attributes:
        size: its radius, as a share of the visited ranges.
        place: its centre, by the labels of the states, in their units.
        within: its radius in each of the two states; they are equal if both are places.
    """

    size: float
    place: dict[str, float]
    within: dict[str, float]


@dataclass(frozen=True, eq=False)
class UntriedCorner(ShortRepr):
    """The corner of two components of a position in space that is farthest from all executed tasks.

    Attributes:
        place: the two components by their labels.
        gap: the distance of the nearest executed task, of the farther component, as a share of its range.
        task: a task there, a point of the unit cube ``(d,)``.
    """

    place: dict[str, float]
    gap: float
    task: Array
