"""How accurate a model is on recordings: errors over one and several steps, and where they are large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import record
from ctxval.core.model import Model
from ctxval.data.recordings import Recordings
from ctxval.replay.steps import Predictions, RecordedSteps, predicted, root_mean_square


@dataclass(frozen=True)
class StepError:
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

    __repr__ = record


@dataclass(frozen=True)
class Region:
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
    __repr__ = record


def step_errors(model: Model, recorded: RecordedSteps, steps: Sequence[int]) -> tuple[StepError, ...]:
    """Return the errors of all states after numbers of steps for which a recording is long enough."""
    found: list[StepError] = []
    for count in steps:
        made = predicted(model, recorded, count)
        if len(made.errors):
            found += _errors(made, recorded.recordings)
    return tuple(found)


def _errors(made: Predictions, recordings: Recordings) -> list[StepError]:
    finite: Mask = np.asarray(np.isfinite(made.errors).all(axis=1))
    rms, change = root_mean_square(made.errors), root_mean_square(made.changes)
    own = np.array([root_mean_square(made.errors[made.groups == group]) for group in np.unique(made.groups)])
    sizes = np.abs(made.errors[finite]) if finite.any() else np.full((1, made.errors.shape[1]), np.nan)
    known = own[np.isfinite(own).all(axis=1)] if np.isfinite(own).any() else own
    return [
        StepError(
            *(name, unit, made.steps, float(rms[i]), float(known[:, i].min()), float(known[:, i].max())),
            *(float(np.median(sizes[:, i])), float(np.quantile(sizes[:, i], 0.95)), float(sizes[:, i].max())),
            *(float(change[i]), len(finite), float(1 - finite.mean())),
        )
        for i, (name, unit) in enumerate(recordings.states.items())
    ]


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
    found: list[Region] = []
    for (name, unit), column in zip(labels.items(), values.T, strict=True):
        edges = np.unique(np.quantile(column, np.linspace(0, 1, 6)))
        bins = np.clip(np.searchsorted(edges, column, side="right") - 1, 0, max(len(edges) - 2, 0))
        for k in range(max(len(edges) - 1, 0)):
            inside = error[known][bins == k]
            own = float(np.sqrt((inside**2).mean())) if len(inside) else 0.0
            ratio = own / overall if overall > 0 else 1.0
            found.append(Region(name, unit, float(edges[k]), float(edges[k + 1]), len(inside), own, ratio))
    return tuple(found)
