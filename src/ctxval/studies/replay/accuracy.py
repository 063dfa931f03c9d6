"""How accurate a model is on recordings: errors over one and several steps, and where they are large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows, as_floats
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.core.state_geometry import geometry_of
from ctxval.core.trajectory import Trajectory
from ctxval.data.recordings import Recordings
from ctxval.errors import CtxvalError, ModelError


@dataclass(frozen=True)
class StepError(ShortRepr):
    """The error of one state after a number of steps."""

    state: str
    unit: str
    steps: int
    rms: float  #: root mean square of the error, and its smallest and largest value over the recordings
    lowest: float
    highest: float
    median: float  #: median, 0.95 quantile and maximum of the magnitude of the error
    upper: float
    largest: float
    change: float  #: root mean square of the recorded change, which is the error of a model that predicts none
    count: int  #: number of predictions, and the share that diverged, which is left out of the numbers above
    diverged: float

    @property
    def relative(self) -> float:
        """The error as a share of the recorded change; 1 or more means that the model predicts nothing."""
        return self.rms / self.change if self.change > 0 else (0.0 if self.rms == 0 else float("inf"))

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as plain values."""
        return {**vars(self), "relative": self.relative}


def useless(errors: Sequence[StepError]) -> StepError | None:
    """Return the largest error that is no smaller than the recorded change, after one step or the most; None if none.

    An error after one step that hardly grows with the steps, and is small against the change over them, is no fault of
    the model: over a step of a slow or often sampled system, noise may be larger than the motion.
    """
    most = max((error.steps for error in errors), default=0)
    last = {error.state: error for error in errors if error.steps == most}

    def is_noise(error: StepError) -> bool:
        end = last[error.state]
        return error is not end and end.rms < 2 * error.rms and error.rms < 0.3 * end.change

    ends = [each for each in errors if each.steps in (1, most) and each.relative >= 1 and not is_noise(each)]
    return max(ends, key=lambda error: error.relative, default=None)


@dataclass(frozen=True)
class RegionalError(ShortRepr):
    """The one-step error in a range of one state or input, with so many recorded steps."""

    variable: str
    unit: str
    low: float
    high: float
    count: int
    error: float  #: root mean square over the states of the one-step error, as a share of their typical changes
    ratio: float  #: this error, divided by that over all steps


@dataclass(frozen=True, eq=False)
class Windows:
    """Places in recordings with recorded steps before and after them."""

    all_states: Array  #: of all recordings, one after the other, shapes ``(M, n)`` and ``(M', m)``
    all_inputs: Array
    of_states: Rows  #: the rows of the places among these, and the parts of the recordings that they lie in, ``(N,)``
    of_inputs: Rows
    groups: Rows

    @staticmethod
    def of(recorded: Recordings | Sequence[Trajectory], before: int, after: int, most: int = 40_000) -> Windows:
        """Return places with so many recorded steps before and after them; of too many, every second, third, ..."""
        runs = [run.trajectory for run in recorded.runs] if isinstance(recorded, Recordings) else recorded
        parts, first = [], 0
        for number, run in enumerate(runs):
            at = np.arange(before, run.horizon - after + 1)
            # A single recording is divided into five parts of equal length.
            group = np.full(len(at), number) if len(runs) > 1 else (5 * at) // (run.horizon + 1)
            parts.append((first + number + at, first + at, group))
            first += run.horizon
        rows, of_inputs, groups = (np.concatenate(part).astype(np.intp) for part in zip(*parts, strict=True))
        states, inputs = (np.concatenate([getattr(run, name) for run in runs]) for name in ("states", "inputs"))
        every = max(1, -(-len(rows) // most))
        return Windows(states, inputs, rows[::every], of_inputs[::every], groups[::every])

    def __len__(self) -> int:
        return len(self.groups)

    def __getitem__(self, chosen: Mask) -> Windows:
        rows = (each[chosen] for each in (self.of_states, self.of_inputs, self.groups))
        return Windows(self.all_states, self.all_inputs, *rows)

    def states(self, shift: int = 0) -> Array:
        """Return the recorded states so many steps later, shape ``(N, n)``."""
        return np.asarray(self.all_states[self.of_states + shift])

    def inputs(self, shift: int = 0) -> Array:
        """Return the recorded inputs so many steps later, shape ``(N, m)``."""
        return np.asarray(self.all_inputs[self.of_inputs + shift])

    def pairs(self, shift: int = 0) -> Array:
        """Return the recorded states and inputs so many steps later, shape ``(N, n + m)``."""
        return np.concatenate([self.states(shift), self.inputs(shift)], axis=1)


def predicted(model: Model, where: Windows, steps: int) -> tuple[Array, Array]:
    """Return predicted minus recorded states after a number of steps, and the recorded changes, both ``(N, n)``."""
    x = start = where.states()
    for k in range(steps):
        x = stepped(model, x, where.inputs(k))
    reached, geometry = where.states(steps), geometry_of(model)
    return geometry.difference(x, reached), geometry.difference(reached, start)


def stepped(model: Model, x: Array, u: Array) -> Array:
    """Return the next states of a model, ``(N, n)``."""
    try:
        with np.errstate(all="ignore"):
            x_next = as_floats("states of a step", model.step(x, u))
        if x_next.shape != x.shape:
            raise ModelError(f"it returned the shape {x_next.shape}")
    except (Exception, SystemExit) as error:  # the user's model
        why = str(error) if isinstance(error, CtxvalError) else f"{type(error).__name__}: {str(error)[:200]}"
        raise ModelError(
            f"the model cannot predict a step of the recordings, which have {x.shape[1]} states and {u.shape[1]} "
            f"inputs: {why.removesuffix('.')}."
        ) from error
    return x_next


def squared(errors: Array, sizes: Array) -> Array:
    """Return the mean over states of squared errors in units of sizes, 0 for size 0, ``(N,)``; large if not finite."""
    with np.errstate(all="ignore"):
        squares = ((errors / np.where(sizes > 0, sizes, np.inf)) ** 2).mean(axis=1)
        return np.asarray(np.nan_to_num(squares, nan=1e12, posinf=1e12).clip(max=1e12))


def root_mean_square(values: Array) -> Array:
    """Return the root mean square over the first axis, without rows whose squares are not finite; NaN if none is."""
    with np.errstate(over="ignore"):
        squares = values**2
    finite = np.isfinite(squares).all(axis=tuple(range(1, values.ndim)))
    if not finite.any():
        return np.full(values.shape[1:], np.nan)
    return np.asarray(np.sqrt(squares[finite].mean(axis=0)))


def step_errors(model: Model, recordings: Recordings, steps: Sequence[int]) -> tuple[StepError, ...]:
    """Return the errors of all states after numbers of steps for which a recording is long enough."""
    results: list[StepError] = []
    for count in steps:
        where = Windows.of(recordings, 0, count, min(40_000, max(200, 400_000 // count)))
        if not len(where):
            continue
        errors, changes = predicted(model, where, count)
        finite: Mask = np.asarray(np.isfinite(errors).all(axis=1))
        rms, change = root_mean_square(errors), root_mean_square(changes)
        by_group = np.array([root_mean_square(errors[where.groups == k]) for k in np.unique(where.groups)])
        known = by_group[np.isfinite(by_group).all(axis=1)] if np.isfinite(by_group).any() else by_group
        sizes = np.abs(errors[finite]) if finite.any() else np.full((1, errors.shape[1]), np.nan)
        spread = [known.min(axis=0), known.max(axis=0)]
        typical = [np.median(sizes, axis=0), np.quantile(sizes, 0.95, axis=0), sizes.max(axis=0)]
        columns = np.stack([rms, *spread, *typical, change], axis=1).tolist()
        diverged = float(1 - finite.mean())
        for (name, unit), numbers in zip(recordings.states.items(), columns, strict=True):
            results.append(StepError(name, unit, count, *[*numbers, len(finite), diverged]))
    return tuple(results)


def normalised(errors: Array, changes: Array) -> Array:
    """Return errors as shares of typical changes, the root mean square over the states that change, ``(N,)``."""
    sizes = changes.std(axis=0)
    moving = sizes > 1e-12 * max(float(sizes.max(initial=0.0)), 1e-300)
    if not moving.any():
        return np.zeros(len(errors))
    return np.asarray(np.sqrt(((errors[:, moving] / sizes[moving]) ** 2).mean(axis=1)))


def regions(model: Model, recordings: Recordings) -> tuple[RegionalError, ...]:
    """Return the one-step error in five ranges of each state and input that have equally many steps."""
    where = Windows.of(recordings, 0, 1)
    error = normalised(*predicted(model, where, 1)) if len(where) else np.empty(0)
    known = np.isfinite(error)
    if not known.any():
        return ()
    overall = float(np.sqrt((error[known] ** 2).mean()))
    values = where.pairs()[known]
    labels = recordings.states | recordings.inputs
    results: list[RegionalError] = []
    for (name, unit), column in zip(labels.items(), values.T, strict=True):
        edges = np.unique(np.quantile(column, np.linspace(0, 1, 6)))
        bins = np.clip(np.searchsorted(edges, column, side="right") - 1, 0, max(len(edges) - 2, 0))
        for k, (low, high) in enumerate(pairwise(edges.tolist())):
            inside = error[known][bins == k]
            rms = float(np.sqrt((inside**2).mean())) if len(inside) else 0.0
            results.append(
                RegionalError(name, unit, low, high, len(inside), rms, rms / overall if overall > 0 else 1.0)
            )
    return tuple(results)
