"""A finite suite of named tasks in the place of a box of task parameters: d* is the largest of finitely many distances.

A suite is a task space whose tasks are members of a list. Each member has a point in the unit cube, so searches and
predictions see what they see of a box; any other point stands for the nearest member. A category is a coordinate that
counts its values in the order in which they first occur.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows, as_finite, as_floats, require_shape
from ctxval._util.checked import PositiveInt, require
from ctxval._util.representation import call
from ctxval._util.texts import enumerated, shortened
from ctxval.core.space import Parameters, Point, TaskSpace
from ctxval.core.task import Task
from ctxval.core.task_distribution import Continuous, Sampler
from ctxval.errors import InputError, UnknownNameError

SUITE = "_tasks"  #: key of the tasks in the description of a suite; no parameter can have this name

TASK = "task"
"""The name of a task, by which trials, tables and command lines call it; and the category of tasks with names alone."""


class TaskSuite(TaskSpace):
    """A finite list of named tasks with parameters, which are numbers or categories.

    The task function gets the parameters of a task as those of a :class:`TaskSpace`: numbers, and texts for
    categories; for a batch of tasks, arrays of both. ``p.task`` is the name of the task, which the task that it makes
    gets too.

    Args:
        tasks: the parameters of each task by its name, with the same parameters for all tasks; or names alone, which
            are then the category ``task``.
        units: the units of parameters by name.
        repeats: how often a campaign executes each task at most, because executions of one task differ. All tasks are
            executed once before one is repeated.

    >>> suite = TaskSuite({"slow lift": {"speed": 0.2, "path": "lift"}, "fast turn": {"speed": 1.0, "path": "turn"}})
    >>> suite.task_names
    ('slow lift', 'fast turn')

    Raises:
        InputError: if two tasks have the same parameters.
    """

    def __init__(
        self,
        tasks: Mapping[str, Mapping[str, float | str]] | Sequence[str],
        units: Mapping[str, str] | None = None,
        repeats: PositiveInt = 1,
    ) -> None:
        self.repeats = require("repeats", PositiveInt, repeats)
        self._tasks = _by_name(tasks)
        self.task_names: tuple[str, ...] = tuple(self._tasks)
        names, units = list(next(iter(self._tasks.values()))), units or {}
        self._categories: dict[str, list[str]] = {}
        columns = [self._numbers(name, [values[name] for values in self._tasks.values()]) for name in names]
        rows = np.stack(columns, axis=-1)
        ends = zip(names, rows.min(axis=0), rows.max(axis=0), strict=True)
        super().__init__(**{name: (low, high, units.get(name, "")) for name, low, high in ends})
        for name in units:
            self.columns(name)  # refuses units of unknown parameters
        self._rows = rows
        self.members: Array = super().to_unit(rows)
        """The tasks as points of the unit cube, shape ``(N, d)``."""
        _, first, of_task = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        for row, same in enumerate(first[of_task.ravel()]):
            if same != row:
                raise InputError(
                    f"the tasks {self.task_names[same]!r} and {self.task_names[row]!r} have the same parameters: give "
                    "them a parameter that differs, such as a number of the repetition."
                )

    def _numbers(self, name: str, values: list[Any]) -> Array:
        """Return a parameter of all tasks as numbers; those of a category count its values."""
        if all(isinstance(value, str) for value in values):
            known = self._categories[name] = list(dict.fromkeys(values))
            column = np.array([known.index(value) for value in values], dtype=np.float64)
        elif any(isinstance(value, str) for value in values):
            raise InputError(f"{name} must be a number in all tasks or a text in all tasks, got {values[:6]!r}.")
        else:
            column = as_finite(name, values)
            if column.ndim != 1:
                raise InputError(f"{name} must be one number or one text in each task, got {values[0]!r}.")
        if len(set(column.tolist())) == 1:
            raise InputError(f"{name} is {values[0]!r} in all tasks: leave it out of their parameters.")
        return column

    def __getitem__(self, name: str) -> dict[str, float | str]:
        """Return the parameters of the task with a name."""
        if name not in self._tasks:
            raise UnknownNameError.among("task", str(name), self.task_names)
        return dict(self._tasks[name])

    @property
    def features(self) -> Array | None:
        """The logarithms of positive parameters and the other ones as they are ``(N, d)``; None with a category."""
        if self._categories:
            return None
        positive = (self._rows > 0).all(axis=0)
        return np.where(positive, np.log(np.where(positive, self._rows, 1.0)), self._rows)

    def __len__(self) -> int:
        return len(self.task_names)

    def __repr__(self) -> str:
        names = shortened(enumerated(self.task_names, 4), 120)
        repeats = self.repeats if self.repeats > 1 else None
        return call(self, names, parameters=self.names, tasks=len(self), repeats=repeats)

    def describe(self) -> dict[str, Any]:
        """Return what identifies this suite in a store: the parameters of each task by its name, units and repeats."""
        units = {name: unit for name, unit in self.units.items() if unit}
        repeats = {"_repeats": self.repeats} if self.repeats > 1 else {}
        return {SUITE: {name: dict(values) for name, values in self._tasks.items()}, "_units": units, **repeats}

    @classmethod
    def described(cls, description: Mapping[str, Any]) -> TaskSuite:
        """Return the suite of a description."""
        return cls(description[SUITE], description.get("_units"), description.get("_repeats", 1))

    # Members

    def rows_at(self, unit: ArrayLike) -> Rows:
        """Return the rows of the members that are nearest to points ``(..., d)`` of the unit cube."""
        points = require_shape("points", as_floats("points", unit), (self.dimension,))
        gaps = ((points[..., None, :] - self.members) ** 2).sum(axis=-1)
        return np.asarray(gaps.argmin(axis=-1))

    def name_at(self, unit: ArrayLike) -> str:
        """Return the name of the member at one point ``(d,)`` of the unit cube."""
        return self.task_names[int(self.rows_at(unit))]

    def executions(self, known: Array) -> Rows:
        """Return how many of points ``(n, d)`` of the unit cube are executions of each member, ``(N,)``."""
        return np.bincount(self.rows_at(known) if len(known) else [], minlength=len(self))

    def candidates(self, points: Array) -> Array:
        return self.members

    def remaining(self, known: Array) -> Array:
        executions = self.executions(known)
        return np.asarray(self.members[executions == min(executions.min(), self.repeats - 1)])

    def are_executed(self, known: Array) -> bool:
        return bool(self.executions(known).all())

    @property
    def axes(self) -> int:
        return 0

    def near(self, change: float) -> float:
        return 1e-9

    def examples(self, count: int, rng: np.random.Generator) -> Array:
        return rng.permutation(self._rows)[: count + 3]

    def named(self, task: Task, points: Array) -> Task:
        return task.named(self.task_names_at(points))

    # Between points, the unit cube and names

    def from_unit(self, unit: ArrayLike) -> Array:
        return np.asarray(self._rows[self.rows_at(unit)])

    def rounded(self, unit: ArrayLike) -> Array:
        return np.asarray(self.members[self.rows_at(unit)])

    def values_of(self, name: str, points: Array) -> Any:
        if name == TASK:
            return self.task_names_at(points)
        values = points[..., self.columns(name)]
        known = self._categories.get(name)
        if known is None:
            return values
        chosen = np.asarray(known)[np.rint(np.clip(values, 0, len(known) - 1)).astype(int)]
        return chosen if chosen.ndim else str(chosen)

    def parameters(self, points: ArrayLike) -> Parameters:
        return Parameters(self, self.from_unit(self.to_unit(points)))

    def task_names_at(self, points: Array) -> Any:
        """Return the names of the tasks at points ``(..., d)`` of the space, ``(...)``."""
        names = np.asarray(self.task_names)[self.rows_at(self.to_unit(points))]
        return names if names.ndim else str(names)

    def point(self, values: Mapping[str, Any]) -> Array:
        if set(values) != {TASK}:
            raise InputError(f"a task of a suite is given by its name, as {{'{TASK}': ...}}, got {dict(values)!r}.")
        if values[TASK] not in self.task_names:
            raise UnknownNameError.among("task", str(values[TASK]), self.task_names)
        return np.array(self._rows[self.task_names.index(values[TASK])])

    def describe_point(self, point: Array) -> dict[str, Point]:
        return {TASK: self.task_names_at(point)}

    def labelled(self, point: Array) -> dict[str, float | str]:
        return {TASK: self.task_names_at(point)}

    # Sets of points

    def unit_draws(self, n: int, rng: np.random.Generator) -> Array:
        return np.asarray(self.members[rng.integers(len(self), size=n)])

    def grid(self, per_axis: int) -> Array:
        """Return all tasks, shape ``(N, d)``, whatever the number of points for each axis is."""
        return self._rows.copy()

    def distributed(self, **by_name: Continuous) -> NoReturn:
        raise InputError("a suite of tasks has no distribution: all of its tasks count alike.")

    def sampled(self, sampler: Sampler) -> NoReturn:
        self.distributed()


def _by_name(tasks: Any) -> dict[str, dict[str, Any]]:
    """Return the parameters of each task by its name, after a check of their shape."""
    if isinstance(tasks, Mapping):
        by_name = {str(name): dict(values) for name, values in tasks.items() if isinstance(values, Mapping)}
    elif isinstance(tasks, Sequence) and not isinstance(tasks, str) and all(isinstance(name, str) for name in tasks):
        by_name = {name: {TASK: name} for name in tasks}
    else:
        by_name = {}
    if len(by_name) != len(tasks) or len(by_name) < 2:
        raise InputError(
            "a suite needs at least two tasks with different names, such as "
            f"TaskSuite({{'slow': {{'speed': 0.2}}, 'fast': {{'speed': 1.0}}}}), got {shortened(repr(tasks), 200)}."
        )
    first, *others = by_name.items()
    if not first[1]:
        raise InputError(f"the task {first[0]!r} of a suite has no parameters.")
    if isinstance(tasks, Mapping) and TASK in first[1]:
        raise InputError("a parameter of a suite must not be called 'task': that is the name of each task.")
    for name, values in others:
        if set(values) != set(first[1]):
            have = f"{first[0]!r} has {enumerated(first[1], 6)}, {name!r} has {enumerated(values, 6) or 'none'}"
            raise InputError(f"all tasks of a suite must have the same parameters: {have}.")
    return by_name
