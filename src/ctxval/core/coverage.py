"""How far closed loops of tasks lead from what is recorded, by the labels of states and inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr


@dataclass(frozen=True, eq=False)
class StateInputGap(ShortRepr):
    """A gap between the states and inputs that closed loops visit and those that are recorded."""

    size: float  #: its size, as a share of the visited range
    #: its coordinates, such as ``angle [rad]``, or ``x[1]`` and ``u[0]`` if they have no names
    coordinates: tuple[str, ...]
    place: dict[str, float]  #: the visited state and input, by coordinate, in the units of the system


@dataclass(frozen=True, eq=False)
class StateInputCoverage(ShortRepr):
    """The largest gaps between the states and inputs that closed loops visit and those that are recorded."""

    marginal: StateInputGap  #: the largest gap in a single coordinate
    #: the largest excess over the largest record of a single coordinate, or below its smallest one
    beyond: StateInputGap
    #: the largest gap in two coordinates together; None if there are too many coordinates to compare pairs
    pair: StateInputGap | None
    resolution: dict[str, float]  #: the largest gap of each coordinate, in its unit
    task: Array  #: the task whose closed loop leads farthest from the records, a point of the unit cube ``(d,)``
    tasks: int  #: the number of tasks that were compared


@dataclass(frozen=True)
class UnvisitedRegion:
    """The largest region of two states that closed loops of tasks enter, and that no execution has entered."""

    size: float  #: its radius, as a share of the visited ranges
    place: dict[str, float]  #: its centre, by the labels of the states, in their units
    within: dict[str, float]  #: its radius in each of the two states; they are equal if both are places
    #: the task whose predicted run leaves the smallest pockets, and one whose run leads into this one, points of the
    #: unit cube; empty if the two states are no coordinates of a position that tasks choose
    tasks: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True, eq=False)
class UnsampledCorner(ShortRepr):
    """The corner of two components of a position in space that is farthest from all executed tasks."""

    place: dict[str, float]  #: the two components by their labels
    gap: float  #: the distance of the nearest executed task, of the farther component, as a share of its range
    task: Array  #: a task there, a point of the unit cube ``(d,)``


@dataclass(frozen=True, eq=False)
class UnsampledParameter(ShortRepr):
    """A task parameter that hardly changes the closed loops of M."""

    name: str  #: its name
    gap: float  #: the largest distance of one of its values to the nearest executed one, as a share of its range
    task: Array  #: a task in that gap, a point of the unit cube ``(d,)``
    idle: bool = False  #: whether a parameter of this kind changes no predicted distance either; not of a suite


@dataclass(frozen=True)
class UntestedRest:
    """The longest stretch of places in which no execution tested friction at rest.

    An execution tests a place if a joint leaves rest there under a force that is little above usual friction at rest.
    """

    MOST: ClassVar[float] = 0.105  #: the largest size that is allowed: nine tested places leave 10 %

    size: float  #: its length, as a share of the range in which joints leave rest
    place: dict[str, float]  #: a place in it, by the label of the joint's coordinate, in its unit
    length: float  #: its length, in this unit
    force: float  #: the largest force that tests a place, in the unit of the input
    times: float  #: multiple of the usual friction at rest that the stretch may hold with
    highest: float  #: the largest predicted distance if every place holds with so much; infinity if it is not known
    #: tasks whose predicted runs leave rest in the stretch under a force that tests it, points of the unit cube
    tasks: tuple[tuple[float, ...], ...] = ()
