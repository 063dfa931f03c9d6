"""The task space P: a named box of parameters, its map to the unit cube, and the distribution of tasks over it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, as_floats, read_only, require_shape
from ctxval._util.checked import Must, NonNegativeInt, checked
from ctxval._util.representation import call, named
from ctxval._util.texts import parted, shortened
from ctxval.core.task import Task
from ctxval.core.task_distribution import ByParameter, BySampler, Continuous, Sampler, TaskDistribution
from ctxval.errors import InputError, ShapeError, UnknownNameError

Point = float | list[float] | str

AxisPoints = Annotated[int, Must("an integer of at least 2", lambda value: value >= 2)]

DISTRIBUTION = "_distribution"
"""Key of the distribution of tasks in the description of a space; no parameter can have this name."""


class Parameters:
    """Task parameters p by name, for one task or a batch of tasks.

    A scalar parameter such as ``p.goal`` has shape ``(...)``, a vector parameter such as ``p.amplitudes`` ``(..., k)``.
    """

    __slots__ = ("_space", "points")

    def __init__(self, space: TaskSpace, points: Array) -> None:
        self._space = space
        self.points = read_only(points)
        """The parameters as rows, shape ``(..., d)``, in the space's own units; read-only."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self[name]

    def __getitem__(self, name: str) -> Any:
        values = self._space.values_of(name, self.points)
        return values.copy() if isinstance(values, np.ndarray) else values  # which may be changed

    def __repr__(self) -> str:
        if self.points.ndim == 1:
            return call(self, named(self._space.describe_point(self.points), self._space.units))
        by_name = {name: self[name] for name in self._space.units}
        return call(self, named(by_name, self._space.units), batch=self.points.shape[:-1])


_LENGTHS = ("m", "mm", "cm", "km", "in", "ft")


def _different_axes(first: str, second: str) -> str:
    """Return ``xy`` of names such as ``goal_x`` and ``goal_y``, which differ in one letter; empty if they do not."""
    different = [a + b for a, b in zip(first.lower(), second.lower(), strict=False) if a != b]
    return different[0] if len(first) == len(second) and len(different) == 1 else ""


def are_coordinates_of_ground(first: str, second: str) -> bool:
    """Return whether labels ``name [unit]`` of two states are those of a place on the ground.

    They are lengths in one unit, or numbers without a unit whose names end in x and y and are no velocities. Those of
    x and z are no place on the ground.
    """
    (name, unit), (other, unit_of_other) = parted(first), parted(second)
    axes = _different_axes(name, other)
    if not unit:
        return not unit_of_other and axes == "xy" and not name.lower().startswith("v")
    return unit in _LENGTHS and unit == unit_of_other and axes not in ("xz", "yz")


class TaskSpace:
    """A named box of task parameters.

    Each keyword is ``name=(low, high)`` or ``name=(low, high, "unit")``. Bounds that are arrays define a vector
    parameter. Tasks are distributed uniformly, unless :meth:`distributed` or :meth:`sampled` says otherwise.

    >>> space = TaskSpace(goal=(-3.14, 3.14, "rad"), offset=([0, 0], [1, 2]))
    >>> space.names
    ('goal', 'offset[0]', 'offset[1]')

    Raises:
        InputError: if there is no parameter, or if a name or bound is not valid.
    """

    members: Array | None = None
    repeats: int = 1  # how often a campaign executes each member at most
    """The tasks as points of the unit cube ``(N, d)``, if they are finitely many; None if they fill the box."""

    def __init__(self, **bounds: tuple[Any, ...]) -> None:
        if not bounds:
            raise InputError("a task space needs at least one parameter, such as TaskSpace(goal=(-1, 1)).")
        self._columns: dict[str, int | slice] = {}
        self.units: dict[str, str] = {}
        """The unit of each parameter by its name; empty if it has no unit."""
        names, lows, highs = list[str](), list[Array](), list[Array]()
        for name, bound in bounds.items():
            if name == "points" or name.startswith("_"):
                raise InputError(f"a task parameter must not be called 'points' or begin with _, got {name!r}.")
            low, high, self.units[name] = _bounds(name, bound)
            scalar, start = low.ndim == 0, len(names)
            self._columns[name] = start if scalar else slice(start, start + low.size)
            names += [name] if scalar else [f"{name}[{i}]" for i in range(low.size)]
            lows.append(np.atleast_1d(low))
            highs.append(np.atleast_1d(high))
        self.names: tuple[str, ...] = tuple(names)
        self.dimension = len(names)
        """The number of scalar parameters; the paper writes it as the cardinality of P."""
        self.low, self.high = (read_only(np.concatenate(ends)) for ends in (lows, highs))
        self._scalar_units = [shortened(self.units[name]) for name, low in zip(bounds, lows, strict=True) for _ in low]
        labels = zip(names, self._scalar_units, strict=True)
        self.labels = tuple(f"{name} [{unit}]" if unit else name for name, unit in labels)
        """An axis label for each scalar parameter: its name and its unit."""
        # Digits after the point of tasks that are chosen, 1e-9 of the range, and of those that are recognised.
        largest = np.maximum(np.abs(self.low), np.abs(self.high))
        magnitude, extent = np.ceil(np.log10(np.maximum([largest, self.high - self.low], 1e-300)))
        chosen = np.minimum(9 - extent, 15 - magnitude)
        # Powers of ten that are exact as floats.
        self._chosen, self._decimals = 10.0 ** np.clip([chosen, np.maximum(chosen, 12 - magnitude)], 0, 22)
        self.distribution: TaskDistribution | None = None
        """The distribution of tasks; None if it is uniform."""

    def __repr__(self) -> str:
        bounds = {name: (self.low[at], self.high[at]) for name, at in self._columns.items()}
        ends = named({name: (*ends, *filter(None, [self.units[name]])) for name, ends in bounds.items()})
        return call(self, ends, distribution=self.distribution)

    def describe(self) -> dict[str, Any]:
        """Return what identifies this space in a store, by scalar names, with a distribution if there is one."""
        distribution = {} if self.distribution is None else {DISTRIBUTION: self.distribution.describe()}
        return distribution | {
            name: [float(low), float(high), *([unit] if unit else [])]
            for name, low, high, unit in zip(self.names, self.low, self.high, self._scalar_units, strict=True)
        }

    def columns(self, name: str) -> int | slice:
        """Return the index or the slice of a parameter in a row of points."""
        try:
            return self._columns[name]
        except KeyError:
            raise UnknownNameError.among("task parameter", name, self._columns) from None

    @property
    def positions(self) -> tuple[slice, ...]:
        """The columns of the parameters that are positions in space, two or three components in a unit of length.

        They are vectors, or neighbouring numbers whose names differ in an axis alone: ``goal_x`` and ``goal_y``, and
        perhaps ``goal_z``. Numbers such as x and z alone are no place on the ground.
        """
        groups, last = list[slice](), ""  # the number before, if it is a length
        for name, columns in self._columns.items():
            at = columns if isinstance(columns, slice) else slice(columns, columns + 1)
            is_length, is_number = self.units[name] in _LENGTHS, at is not columns
            axes = "yz" if groups and groups[-1].stop - groups[-1].start == 2 else "xy"
            if (
                is_length
                and is_number
                and last
                and self.units[last] == self.units[name]
                and _different_axes(last, name) == axes
            ):
                groups[-1] = slice(groups[-1].start, at.stop)
            elif is_length:
                groups.append(at)
            last = name if is_number and is_length else ""
        return tuple(at for at in groups if at.stop - at.start in (2, 3))

    def values_of(self, name: str, points: Array) -> Any:
        """Return the values of a parameter in points ``(..., d)`` of the space, ``(...)`` or ``(..., k)``."""
        return points[..., self.columns(name)]

    # Between points, the unit cube and names

    def to_unit(self, points: ArrayLike) -> Array:
        """Map points ``(..., d)`` of the space to the unit cube."""
        rows = require_shape("points", as_floats("points", points), (self.dimension,))
        return (rows - self.low) / (self.high - self.low)

    def from_unit(self, unit: ArrayLike) -> Array:
        """Map points ``(..., d)`` of the unit cube to the space.

        If a number with fewer digits maps to the same point of the unit cube, it is returned.
        """
        rows = require_shape("points", as_floats("points", unit), (self.dimension,))
        points = np.clip(self.low + rows * (self.high - self.low), self.low, self.high)
        points = np.where(rows == 1, self.high, points)
        # A number that a user gave as 0.2 comes back as 0.2, not as 0.19999999999999996.
        short = np.clip(np.rint(points * self._decimals) / self._decimals + 0.0, self.low, self.high)
        return np.where((short - self.low) / (self.high - self.low) == rows, short, points)

    def rounded(self, unit: ArrayLike) -> Array:
        """Return points ``(..., d)`` of the unit cube next to those given, whose parameters are short enough to type.

        The parameters are rounded to about 1e-9 of their ranges; bounds stay. ``from_unit`` returns them exactly.
        """
        rows, points = as_floats("points", unit), self.from_unit(unit)
        short = np.clip(np.rint(points * self._chosen) / self._chosen + 0.0, self.low, self.high)
        return np.where((rows == 0) | (rows == 1), rows, self.to_unit(short))

    def parameters(self, points: ArrayLike) -> Parameters:
        """Return points ``(..., d)`` of the space as named parameters."""
        return Parameters(self, require_shape("points", as_floats("points", points), (self.dimension,)))

    def point(self, values: Mapping[str, Any]) -> Array:
        """Return the point ``(d,)`` with these values by name.

        Raises:
            InputError: if a value is missing or outside of the space.
            ShapeError: if a value has another shape.
        """
        point = np.full(self.dimension, np.nan)
        for name, value in values.items():
            columns, given = self.columns(name), as_finite(name, value)
            if given.shape != np.shape(point[columns]):
                raise ShapeError(f"{name} must have shape {np.shape(point[columns])}, got {given.shape}.")
            point[columns] = given
        missing = [name for name, value in zip(self.names, point, strict=True) if np.isnan(value)]
        if missing:
            raise InputError(f"no value is given for {', '.join(missing)}.")
        outside = (point < self.low) | (point > self.high)
        if outside.any():
            i = int(np.argmax(outside))
            bounds = f"[{self.low[i]:g}, {self.high[i]:g}]"
            raise InputError(f"{self.names[i]} = {point[i]:g} is outside the task space, {bounds}.")
        return point

    def describe_point(self, point: Array) -> dict[str, Point]:
        """Return one point ``(d,)`` as ``{name: number or list}``, ready for JSON."""
        return {name: point[columns].tolist() for name, columns in self._columns.items()}

    def labelled(self, point: Array) -> dict[str, float | str]:
        """Return what a sentence calls the task at a point ``(d,)`` of the space: its parameters by their labels."""
        return dict(zip(self.labels, point.tolist(), strict=True))

    def candidates(self, points: Array) -> Array:
        """Return the tasks that a search may choose, ``(m, d)``: the given points of the unit cube, or all members."""
        return points

    def remaining(self, known: Array) -> Array | None:
        """Return the members that may follow executions at points ``(n, d)``; None if tasks fill the box."""
        return None

    def are_executed(self, known: Array) -> bool:
        """Return whether executions at points ``(n, d)`` of the unit cube are of all tasks."""
        return False

    @property
    def axes(self) -> int:
        """The number of parameters along which a distance is drawn: 0 in a suite, which has no tasks between its."""
        return self.dimension

    def near(self, change: float) -> float:
        """Return the largest change of each coordinate to a task that is no new one; of a suite, all others are new."""
        return change

    def examples(self, count: int, rng: np.random.Generator) -> Array:
        """Return the lowest, the middle and the highest task, and so many random ones, points ``(m, d)`` of the space.

        Of a suite, they are as many of its tasks.
        """
        return np.concatenate([[self.low, 0.5 * (self.low + self.high), self.high], self.iid(count, rng)])

    def named(self, task: Task, points: Array) -> Task:
        """Return the task at a point of the space ``(d,)``, or a batch of points, with its name if it has one."""
        return task

    def unit_function(self, function: Callable[[Parameters], ArrayLike]) -> Callable[[Array], Array]:
        """Return a function of named parameters as one of unit-cube points ``(n, d)``, which searches know."""

        def of_points(unit: Array) -> Array:
            values = as_floats("prior mean", function(self.parameters(self.from_unit(unit))))
            return np.broadcast_to(values, unit.shape[:-1])

        return of_points

    # The distribution of tasks

    def distributed(self, **by_name: Continuous) -> TaskSpace:
        """Return this space with a distribution of tasks: independent parameters, all others uniform.

        Independent draws of tasks follow it, and a volume is then the probability under it; searches are not affected.
        Each parameter has a :class:`Normal` or a frozen continuous distribution of ``scipy.stats``, truncated to its
        bounds.

        >>> space = TaskSpace(goal=(-1, 1), load=(0, 5)).distributed(goal=Normal(0.0, 0.3))

        Raises:
            InputError: if no distribution is given.
        """
        if not by_name:
            raise InputError("distributed needs the distribution of at least one parameter, such as goal=Normal(0, 1).")
        columns = {name: self.columns(name) for name in by_name}
        slices = {name: at if isinstance(at, slice) else slice(at, at + 1) for name, at in columns.items()}
        return self._with(ByParameter(self.low, self.high, slices, by_name))

    def sampled(self, sampler: Sampler) -> TaskSpace:
        """Return this space with a distribution of tasks that a function draws from.

        The sampler ``(rng, n)`` returns n independent tasks, rows ``(n, d)`` within the bounds and in the units of the
        space.

        Raises:
            InputError: if the sampler is no function ``(rng, n)``.
        """
        if not callable(sampler):
            raise InputError(f"sampler must be a function (rng, n) -> rows (n, d), got {sampler!r}.")
        return self._with(BySampler(self.low, self.high, sampler))

    def unit_draws(self, n: int, rng: np.random.Generator) -> Array:
        """Return n independent draws from the distribution of tasks, points of the unit cube ``(n, d)``."""
        if self.distribution is None:
            return rng.random((n, self.dimension))
        return np.clip(self.to_unit(self.distribution.draw(n, rng)), 0.0, 1.0)

    def _with(self, distribution: TaskDistribution) -> TaskSpace:
        space = copy.copy(self)
        space.distribution = distribution
        return space

    # Sets of points

    @checked
    def iid(self, n: NonNegativeInt, rng: np.random.Generator) -> Array:
        """Return n points drawn independently from the distribution of tasks, shape ``(n, d)``."""
        return self.from_unit(self.unit_draws(n, rng))

    @checked
    def grid(self, per_axis: AxisPoints) -> Array:
        """Return a full grid that includes both bounds of each axis, shape ``(per_axis ** d, d)``."""
        axes = [np.linspace(low, high, per_axis) for low, high in zip(self.low, self.high, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.dimension)


def _bounds(name: str, bound: Any) -> tuple[Array, Array, str]:
    if not isinstance(bound, tuple | list) or len(bound) not in (2, 3):
        raise InputError(f"bounds of {name} must be (low, high) or (low, high, unit), got {bound!r}.")
    unit = bound[2] if len(bound) == 3 else ""
    if not isinstance(unit, str):
        raise InputError(f"the unit of {name} must be a string, got {unit!r}.")
    low = as_finite(f"lower bound of {name}", bound[0])
    high = as_finite(f"upper bound of {name}", bound[1])
    if low.shape != high.shape or low.ndim > 1 or low.size == 0:
        raise InputError(f"bounds of {name} must be two numbers or two equally long lists, got {bound!r}.")
    if not (low < high).all():
        raise InputError(f"bounds of {name} must have low < high, got {bound!r}.")
    with np.errstate(over="ignore"):
        if not np.isfinite(high - low).all():
            raise InputError(f"bounds of {name} must have a finite range high - low, got {bound!r}.")
    return low, high, unit
