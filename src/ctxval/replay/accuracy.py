"""How accurate a model is on recordings: errors over one and several steps, and where they are large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.data.recordings import Recordings
from ctxval.errors import CtxvalError, ModelError

_PARTS = 5  # number of parts of a single recording, which then take the place of recordings


@dataclass(frozen=True)
class StepError(ShortRepr):
    """The error of one state after a number of steps.

    Attributes:
        state, unit: the state and its unit.
        steps: the number of steps.
        rms: root mean square of the error.
        lowest, highest: the smallest and the largest root mean square over the recordings.
        median, upper, largest: median, 0.95 quantile and maximum of the magnitude of the error.
        change: root mean square of the recorded change of the state over the steps. A model that predicts no change
            has this error.
        count: number of predictions.
        diverged: share of the predictions in which the model diverged; they are left out of the numbers above.
    """

    state: str
    unit: str
    steps: int
    rms: float
    lowest: float
    highest: float
    median: float
    upper: float
    largest: float
    change: float
    count: int
    diverged: float

    @property
    def relative(self) -> float:
        """The error as a share of the recorded change; 1 or more means that the model predicts nothing."""
        return self.rms / self.change if self.change > 0 else (0.0 if self.rms == 0 else float("inf"))


@dataclass(frozen=True)
class Region(ShortRepr):
    """The one-step error in a range of one state or input.

    Attributes:
        variable, unit: the state or input and its unit.
        low, high: the range.
        count: number of recorded steps in it.
        error: root mean square over the states of the one-step error, as a share of the typical change of each state.
        ratio: this error, divided by that over all steps.
    """

    variable: str
    unit: str
    low: float
    high: float
    count: int
    error: float
    ratio: float


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of k steps from recorded states, under the recorded inputs.

    Attributes:
        errors: predicted minus recorded states, shape ``(N, n)``; not finite if the model diverged.
        changes: recorded changes of the states over the steps, shape ``(N, n)``.
        states, inputs: recorded states and inputs at the start, shapes ``(N, n)`` and ``(N, m)``.
        groups: the part of the recordings in which each prediction lies, shape ``(N,)``.
    """

    errors: Array
    changes: Array
    states: Array
    inputs: Array
    groups: Rows


@dataclass(frozen=True, eq=False)
class Windows:
    """The places in recordings from which so many steps before and after are recorded.

    Attributes:
        runs, places: the recording, and the step in it, shape ``(N,)``.
        groups: the part of the recordings in which each lies, shape ``(N,)``.
    """

    runs: Rows
    places: Rows
    groups: Rows

    def __len__(self) -> int:
        return len(self.runs)


class RecordedSteps:
    """The steps of some recordings.

    If there is only one recording, it is divided into five parts of equal length, which take the place of recordings.
    """

    def __init__(self, recordings: Recordings, used: Sequence[int]) -> None:
        self.recordings = recordings
        self._used = [recordings.runs[number].trajectory for number in used]
        self._states = np.concatenate([run.states for run in self._used])
        self._inputs = np.concatenate([run.inputs for run in self._used])
        self._horizons = np.array([run.horizon for run in self._used])
        self._first_input = np.cumsum([0, *self._horizons[:-1]])
        self._first_state = self._first_input + np.arange(len(self._used))

    def windows(self, before: int, after: int, most: int = 40_000) -> Windows:
        """Return places with so many recorded steps before and after them; of too many, every second, third, ..."""
        runs, places, groups = [], [], []
        for number, horizon in enumerate(self._horizons.tolist()):
            at = np.arange(before, horizon - after + 1)
            runs.append(np.full(len(at), number))
            places.append(at)
            groups.append(np.full(len(at), number) if len(self._used) > 1 else (_PARTS * at) // (horizon + 1))
        joined = [np.concatenate(part).astype(np.intp) for part in (runs, places, groups)]
        every = max(1, -(-len(joined[0]) // most))
        return Windows(*(part[::every] for part in joined))

    def states(self, where: Windows, shift: int = 0) -> Array:
        """Return the recorded states so many steps after places, shape ``(N, n)``."""
        return np.asarray(self._states[self._first_state[where.runs] + where.places + shift])

    def inputs(self, where: Windows, shift: int = 0) -> Array:
        """Return the recorded inputs so many steps after places, shape ``(N, m)``."""
        return np.asarray(self._inputs[self._first_input[where.runs] + where.places + shift])


def predicted(model: Model, recorded: RecordedSteps, steps: int) -> Predictions:
    """Return predictions of a number of steps from recorded states; none if no recording is so long."""
    where = recorded.windows(0, steps, min(40_000, max(200, 400_000 // steps)))
    x = start = recorded.states(where)
    for k in range(steps if len(where) else 0):
        x = stepped(model, x, recorded.inputs(where, k))
    reached = recorded.states(where, steps) if len(where) else start
    return Predictions(x - reached, reached - start, start, recorded.inputs(where), where.groups)


def stepped(model: Model, x: Array, u: Array) -> Array:
    """Return the next states of a model, ``(N, n)``."""
    try:
        with np.errstate(all="ignore"):
            x_next = np.asarray(model.step(x, u), dtype=np.float64)
    except CtxvalError as error:
        raise _unusable(x, u, str(error)) from error
    except Exception as error:  # the user's model
        raise _unusable(x, u, f"{type(error).__name__}: {str(error)[:200]}") from error
    if x_next.shape != x.shape:
        raise _unusable(x, u, f"it returned the shape {x_next.shape}")
    return x_next


def _unusable(x: Array, u: Array, why: str) -> ModelError:
    return ModelError(
        f"the model cannot predict a step of the recordings, which have {x.shape[1]} states and {u.shape[1]} inputs: "
        f"{why.removesuffix('.')}."
    )


def root_mean_square(values: Array) -> Array:
    """Return the root mean square over the first axis, without rows whose squares are not finite; NaN if none is."""
    with np.errstate(over="ignore"):
        squares = values**2
    finite = np.isfinite(squares).all(axis=tuple(range(1, values.ndim)))
    if not finite.any():
        return np.full(values.shape[1:], np.nan)
    return np.asarray(np.sqrt(squares[finite].mean(axis=0)))


def step_errors(model: Model, recorded: RecordedSteps, steps: Sequence[int]) -> tuple[StepError, ...]:
    """Return the errors of all states after numbers of steps for which a recording is long enough."""
    results: list[StepError] = []
    for count in steps:
        made = predicted(model, recorded, count)
        if not len(made.errors):
            continue
        finite: Mask = np.asarray(np.isfinite(made.errors).all(axis=1))
        rms, change = root_mean_square(made.errors), root_mean_square(made.changes)
        by_group = np.array([root_mean_square(made.errors[made.groups == k]) for k in np.unique(made.groups)])
        sizes = np.abs(made.errors[finite]) if finite.any() else np.full((1, made.errors.shape[1]), np.nan)
        known = by_group[np.isfinite(by_group).all(axis=1)] if np.isfinite(by_group).any() else by_group
        results += [
            StepError(
                *(name, unit, count, float(rms[i]), float(known[:, i].min()), float(known[:, i].max())),
                *(float(np.median(sizes[:, i])), float(np.quantile(sizes[:, i], 0.95)), float(sizes[:, i].max())),
                *(float(change[i]), len(finite), float(1 - finite.mean())),
            )
            for i, (name, unit) in enumerate(recorded.recordings.states.items())
        ]
    return tuple(results)


def normalised(errors: Array, changes: Array) -> Array:
    """Return errors as shares of the typical change of each state, the root mean square over the states, ``(N,)``.

    States that never change are left out.
    """
    sizes = changes.std(axis=0)
    moving = sizes > 1e-12 * max(float(sizes.max(initial=0.0)), 1e-300)
    if not moving.any():
        return np.zeros(len(errors))
    return np.asarray(np.sqrt(((errors[:, moving] / sizes[moving]) ** 2).mean(axis=1)))


def regions(model: Model, recorded: RecordedSteps) -> tuple[Region, ...]:
    """Return the one-step error in five ranges of each state and input that have equally many steps."""
    made = predicted(model, recorded, 1)
    error = normalised(made.errors, made.changes)
    known = np.isfinite(error)
    if not known.any():
        return ()
    overall = float(np.sqrt((error[known] ** 2).mean()))
    values = np.concatenate([made.states, made.inputs], axis=1)[known]
    labels = recorded.recordings.states | recorded.recordings.inputs
    results: list[Region] = []
    for (name, unit), column in zip(labels.items(), values.T, strict=True):
        edges = np.unique(np.quantile(column, np.linspace(0, 1, 6)))
        bins = np.clip(np.searchsorted(edges, column, side="right") - 1, 0, max(len(edges) - 2, 0))
        for k in range(max(len(edges) - 1, 0)):
            inside = error[known][bins == k]
            rms = float(np.sqrt((inside**2).mean())) if len(inside) else 0.0
            ratio = rms / overall if overall > 0 else 1.0
            results.append(Region(name, unit, float(edges[k]), float(edges[k + 1]), len(inside), rms, ratio))
    return tuple(results)
