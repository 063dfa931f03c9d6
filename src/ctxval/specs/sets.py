"""Sets of positions with signed distances: boxes, balls, polytopes, their unions and complements, fixed or moving.

A signed distance is positive outside of the set, negative inside, and changes by at most as much as the position does
in the Euclidean norm. A set grows by r to the positions whose signed distance is at most r.
"""

from __future__ import annotations

import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, as_floats
from ctxval._util.checked import PositiveFloat, checked
from ctxval._util.registry import Registry
from ctxval._util.representation import ShortRepr
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError, UnknownNameError

Place = ArrayLike | str  #: numbers ``(k,)``, or the name of an entry of the task's environment


class Set(ShortRepr, ABC):
    """A set of positions, the compared states ``(k,)``, which may move over the times of a task."""

    @abstractmethod
    def signed_distance(self, positions: Array, task: Task) -> Array:
        """Return the signed distances ``(..., T)`` of positions ``(..., T, k)`` at the first T times of a task."""

    @abstractmethod
    def grown(self, by: float) -> Set:
        """Return a set that contains all positions up to a distance ``by``; a negative one shrinks the set.

        An InputError is raised if nothing is left of the set.
        """


@dataclass(frozen=True, eq=False)
class _Placed(Set):
    """A set with a place of its own, which may move."""

    #: the place of the set, numbers ``(k,)``, a row for each time ``(H + 1, k)``, or the name of an entry of the task's
    #: environment
    center: Place = 0.0
    #: how the place changes with time, per second, given like the center; None if it does not
    velocity: Place | None = None

    def __post_init__(self) -> None:
        for name in ("center", "velocity"):
            given: Any = getattr(self, name)
            if given is not None and not isinstance(given, str):
                object.__setattr__(self, name, as_finite(f"{name} of the {type(self).__name__}", given))

    def signed_distance(self, positions: Array, task: Task) -> Array:
        at = positions - self._place(self.center, task, positions)
        if self.velocity is not None:
            moved = self._place(self.velocity, task, positions)
            at = at - moved * task.times[: positions.shape[-2], None]
        return self._from_center(at)

    @abstractmethod
    def _from_center(self, at: Array) -> Array:
        """Return the signed distances ``(...)`` of positions ``(..., k)`` relative to the center."""

    def _place(self, given: Place, task: Task, positions: Array) -> Array:
        """Return what is subtracted from positions ``(..., T, k)``."""
        what, (times, k) = type(self).__name__, positions.shape[-2:]
        if isinstance(given, str):
            if given not in task.environment:
                raise UnknownNameError.among("entry of the task's environment", given, task.environment)
            place = task.environment[given][..., None, :]
        else:
            place = np.asarray(given, dtype=np.float64)
            if place.ndim > 1 and len(place) < times:
                raise ShapeError(f"a {what} that moves needs a row for each of {times} times, got {len(place)}.")
            place = place[:times] if place.ndim > 1 else place
        if place.ndim and place.shape[-1] != k:
            raise _other_dimension(what, place.shape[-1], k)
        return place


@checked
@dataclass(frozen=True, eq=False)
class Ball(_Placed):
    """All positions up to a radius from the center.

    Attributes:
        center: the center, ``(k,)``; see :class:`Set`.
        radius: the radius, in the units of the states.
    """

    _: dataclasses.KW_ONLY
    radius: PositiveFloat

    def _from_center(self, at: Array) -> Array:
        return np.asarray(np.linalg.norm(at, axis=-1) - self.radius)

    def grown(self, by: float) -> Ball:
        if self.radius + by <= 0:
            raise InputError(f"nothing is left of a Ball of radius {self.radius:g} that shrinks by {-by:g}.")
        return dataclasses.replace(self, radius=self.radius + by)


@checked
@dataclass(frozen=True, eq=False)
class Box(_Placed):
    """All positions between two corners, which are relative to the center.

    Raises:
        InputError: if it has no end or no inside.
        ShapeError: if low and high differ in length.
    """

    _: dataclasses.KW_ONLY
    low: Any = None  #: the corners, ``(k,)``; infinite or None where there is no end. One of them may be left out.
    high: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        known: Any = self.high if self.low is None else self.low
        if known is None:
            raise InputError("a Box must have an end: give low, high or both.")
        for name, none in (("low", -np.inf), ("high", np.inf)):
            given: Any = getattr(self, name)
            corner = np.full(np.shape(known), none) if given is None else given
            if isinstance(corner, list | tuple):
                corner = [none if end is None else end for end in corner]
            object.__setattr__(self, name, as_floats(f"{name} of the Box", corner))
        low, high = self.low, self.high
        if low.ndim != 1 or low.shape != high.shape or not len(low):
            raise ShapeError(f"low and high of a Box must be two equally long lists, got {low!r}, {high!r}.")
        if not (low < high).all():
            raise InputError(f"low and high of a Box must be low < high, got {low.tolist()} and {high.tolist()}.")
        if np.isinf(low).all() and np.isinf(high).all():
            raise InputError("a Box must have an end, and all corners are infinite.")

    def _from_center(self, at: Array) -> Array:
        if at.shape[-1] != len(self.low):
            raise _other_dimension("Box", len(self.low), at.shape[-1])
        beyond = np.maximum(self.low - at, at - self.high)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return np.asarray(outside + np.minimum(beyond.max(axis=-1), 0.0))

    def grown(self, by: float) -> Box:
        if not (self.low - by < self.high + by).all():
            box = f"a Box from {self.low.tolist()} to {self.high.tolist()}"
            raise InputError(f"nothing is left of {box} that shrinks by {-by:g}.")
        return dataclasses.replace(self, low=self.low - by, high=self.high + by)


@checked
@dataclass(frozen=True, eq=False)
class Polytope(_Placed):
    """All positions with ``A x <= b``, where x is relative to the center.

    The signed distance is the largest one to the planes of the faces. Outside it is at most the Euclidean distance.

    Raises:
        InputError: if it has no inside.
        ShapeError: if A and b do not fit together.
    """

    _: dataclasses.KW_ONLY
    A: Any  #: one row for each face, ``(q, k)``
    b: Any  #: ``(q,)``

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("A", "b"):
            object.__setattr__(self, name, as_finite(f"{name} of the Polytope", getattr(self, name)))
        A, b = self.A, self.b
        if A.ndim != 2 or b.shape != A.shape[:1] or not A.size:
            raise ShapeError(f"a Polytope needs A (q, k) and b (q,), got {A.shape} and {b.shape}.")
        if not A.any(axis=1).all():
            raise InputError("a row of A of a Polytope must not be zero.")
        from scipy.optimize import linprog  # imported here, because it is slow to load and seldom needed

        # The largest ball inside, of a radius of at most 1.
        cost, rows = np.append(np.zeros(A.shape[1]), -1.0), np.column_stack([A, np.linalg.norm(A, axis=1)])
        ball = linprog(cost, A_ub=rows, b_ub=b, bounds=[(None, None)] * A.shape[1] + [(0, 1)])
        if ball.status != 0 or not ball.x[-1] > 0:
            raise InputError("a Polytope must have an inside, and no position keeps A x < b.")

    def _from_center(self, at: Array) -> Array:
        if at.shape[-1] != self.A.shape[1]:
            raise _other_dimension("Polytope", self.A.shape[1], at.shape[-1])
        return np.asarray(((at @ self.A.T - self.b) / np.linalg.norm(self.A, axis=1)).max(axis=-1))

    def grown(self, by: float) -> Polytope:
        try:
            return dataclasses.replace(self, b=self.b + by * np.linalg.norm(self.A, axis=1))
        except InputError:
            raise InputError(f"nothing is left of a Polytope that shrinks by {-by:g}.") from None


@checked
@dataclass(frozen=True, eq=False)
class Union(Set):
    """All positions that are in one of several sets."""

    sets: Sequence[Any]  #: the sets, or tables of their arguments with their ``type``

    def __post_init__(self) -> None:
        object.__setattr__(self, "sets", as_sets("sets of a Union", self.sets))

    def signed_distance(self, positions: Array, task: Task) -> Array:
        return np.asarray(functools.reduce(np.minimum, (each.signed_distance(positions, task) for each in self.sets)))

    def grown(self, by: float) -> Union:
        if by >= 0:
            return Union([each.grown(by) for each in self.sets])
        left = []
        for each in self.sets:
            with suppress(InputError):  # nothing is left of it
                left.append(each.grown(by))
        if not left:
            raise InputError(f"nothing is left of a Union of {len(self.sets)} sets that shrinks by {-by:g}.")
        return Union(left)


@checked
@dataclass(frozen=True, eq=False)
class Outside(Set):
    """All positions that are not in a set; to avoid them is to stay in the set."""

    of: Any  #: the set, or a table of its arguments with its ``type``

    def __post_init__(self) -> None:
        object.__setattr__(self, "of", as_set("the set of Outside", self.of))

    def signed_distance(self, positions: Array, task: Task) -> Array:
        return np.asarray(-self.of.signed_distance(positions, task))

    def grown(self, by: float) -> Self:
        return dataclasses.replace(self, of=self.of.grown(-by))


SETS: Registry[Set] = Registry(
    "set",
    "ctxval.specs",
    method="signed_distance",
    modules={name: f"{__name__}:{name}" for name in ("Ball", "Box", "Outside", "Polytope", "Union")},
)
"""The sets that are found by name: those of this package, and those that installed packages add."""


def as_set(what: str, given: Any) -> Set:
    """Return a set from itself, or from a table of its arguments with its ``type``."""
    match given:
        case Set():
            return given
        case {"type": str(name), **arguments}:
            if name not in SETS.built_in:  # a table runs no code of other packages
                raise UnknownNameError.among("set", name, SETS.built_in)
            return SETS.make(name, **{str(key): value for key, value in arguments.items()})
    raise InputError(f"{what} must be a set, such as Box(low=[0, 0], high=[1, 1]), or its table, got {given!r}.")


def as_sets(what: str, given: Any) -> tuple[Set, ...]:
    """Return sets from a list of sets or tables; one alone is a list of one."""
    listed = given if isinstance(given, list | tuple) else [given]
    if not listed:
        raise InputError(f"{what} must name at least one set, got none.")
    return tuple(as_set(what, each) for each in listed)


def _other_dimension(what: str, got: int, wanted: int) -> ShapeError:
    dimensions = f"{wanted} dimension{'s' if wanted > 1 else ''}"
    which = "one for each state that the specification looks at"
    return ShapeError(f"the {what} must have {dimensions}, {which}, got {got}.")
