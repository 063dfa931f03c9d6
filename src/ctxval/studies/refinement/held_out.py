"""What the executions of all rounds teach, and the errors of a model on those that it was not learned from.

These errors by regions of states and inputs are what a robust controller must assume.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.describe import plain_json
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import aligned
from ctxval.core.labels import labels_of
from ctxval.core.model import Model
from ctxval.core.state_geometry import geometry_of
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.errors import CtxvalError, InputError, ModelError
from ctxval.studies.fitting.fit import part_of
from ctxval.studies.replay.accuracy import Windows, predicted


@dataclass(frozen=True, eq=False)
class Records(ShortRepr):
    """Executions of the system in the order of the rounds, and the data of the first model, which belong to none.

    Raises:
        InputError: if there are no records.
    """

    executed: tuple[Trajectory, ...]
    own: Transitions | None = None

    def __post_init__(self) -> None:
        if not self.executed and (self.own is None or not len(self.own)):
            raise InputError(
                "there is nothing to learn from: no execution is stored with its trajectory, and the model carries no "
                "data. Record the states and inputs of the executions, or give the model its data."
            )

    @classmethod
    def of(cls, model: Model, executed: Sequence[Trajectory]) -> Records:
        """Return the records of executions, and the data of the first model."""
        data = getattr(model, "data", None)
        return cls(tuple(executed), data if isinstance(data, Transitions) and len(data) else None)

    @property
    def transitions(self) -> Transitions:
        """All transitions, those of the first model first."""
        return Transitions.joined([*filter(None, [self.own]), *(run.transitions() for run in self.executed)])

    @property
    def sources(self) -> Rows:
        """The execution of each transition; -1 for the data of the first model."""
        horizons = [0 if self.own is None else len(self.own), *(run.horizon for run in self.executed)]
        return np.repeat(np.arange(-1, len(self.executed)), horizons)

    def folds(self) -> list[tuple[Records, Records]]:
        """Return pairs of records: those to learn from, and those that are held out.

        One execution is held out at a time. If there is only one and the model carries no data, its halves are; if
        there is none, halves of the data.

        Raises:
            InputError: if the only execution has one step.
        """
        count = len(self.executed)
        if count == 0 and self.own is not None:
            halves = np.array_split(np.random.default_rng(0).permutation(len(self.own)), 2)
            first, second = (Records((), self.own[half]) for half in halves)
            return [(first, second), (second, first)]
        if count == 1 and self.own is None:
            run, middle = self.executed[0], self.executed[0].horizon // 2
            if middle < 1:
                raise InputError("the only execution has one step: too few to hold a part out.")
            first, second = (Records((part_of(run, *ends),)) for ends in ((0, middle), (middle, run.horizon)))
            return [(first, second), (second, first)]
        folds, parts = [], min(count, 10)  # of more executions, some are held out together
        for part in range(parts):
            others = tuple(run for k, run in enumerate(self.executed) if k % parts != part)
            folds.append((replace(self, executed=others), Records(self.executed[part::parts])))
        return folds


@dataclass(frozen=True, eq=False)
class HeldOut(ShortRepr):
    """One-step errors ``S(x, u) - M(x, u)`` on N transitions that the model was not learned from."""

    pairs: Array  #: the states and inputs, shape ``(N, n + m)``
    errors: Array  #: those of the learned model and of the first one, shapes ``(N, n)``
    before: Array
    changes: Array  #: the recorded changes of the states in one step, shape ``(N, n)``
    #: errors of both models after ten steps, shapes ``(K, n)``; they choose corrections, because noise hides less there
    later: Array
    later_before: Array
    new: Mask | None = None  #: transitions that were new to the model itself, ``(N,)``; None if there are none

    @property
    def better(self) -> Mask:
        """The states whose root mean square error became smaller, ``(n,)``.

        Errors that choose states and are also reported are slightly too small; those of the last round choose nothing.
        """
        after, before = self._choosing
        return np.asarray((after**2).mean(axis=0) < (before**2).mean(axis=0))

    @property
    def left(self) -> float:
        """The share of the first model's error that is left, of the states that are better corrected; at most 1."""
        after, before = (np.sqrt((errors**2).mean(axis=0)) for errors in self._choosing)
        known = before > 1e-7 * self.changes.std(axis=0)
        shares = np.minimum(after, before)[known] / before[known]
        return float(np.sqrt((shares**2).mean())) if known.any() else 1.0

    @property
    def _choosing(self) -> tuple[Array, Array]:
        return (self.later, self.later_before) if len(self.later) else (self.errors, self.before)

    @property
    def counted(self) -> Mask:
        """The transitions whose errors are those of the model itself: the new ones, or all if there are none."""
        return np.ones(len(self.errors), dtype=bool) if self.new is None else self.new

    @property
    def rms(self) -> Array:
        """The root mean square of each state's error on the transitions that count, shape ``(n,)``."""
        return np.asarray(np.sqrt((self.errors[self.counted] ** 2).mean(axis=0)))

    @property
    def rms_before(self) -> Array:
        """That of the first model, shape ``(n,)``."""
        return np.asarray(np.sqrt((self.before[self.counted] ** 2).mean(axis=0)))

    def kept(self, chosen: Mask) -> HeldOut:
        """Return the errors if only the chosen states ``(n,)`` are corrected."""
        return replace(self, errors=np.where(chosen, self.errors, self.before))

    def with_executions(self, model: Model, before: Model, executed: Sequence[Trajectory]) -> HeldOut:
        """Return these errors and those on executions that the model itself was not learned from."""
        joined = _joined([self, *(_compared(run.transitions(), [run], model, before) for run in executed)])
        return replace(joined, new=np.arange(len(joined.pairs)) >= len(self.pairs)) if executed else self


def held_out(learn: Callable[[Records], Model], before: Model, records: Records) -> HeldOut:
    """Return the errors on each part of the records, of the model that is learned from the other parts.

    Transitions on which a model is not finite count with the error of the first model, and so do parts that leave too
    few records to learn from.
    """
    parts = []
    for known, held in records.folds():
        model = before
        with suppress(CtxvalError):
            model = learn(known)
        parts.append(_compared(held.transitions, held.executed, model, before))
    return _joined(parts)


def _compared(data: Transitions, runs: Sequence[Trajectory], model: Model, before: Model) -> HeldOut:
    geometry = geometry_of(before)
    with np.errstate(all="ignore"):
        errors, first = (geometry.difference(data.x_next, each.step(data.x, data.u)) for each in (model, before))
        later, later_first = (_errors_later(each, runs, data.x.shape[1]) for each in (model, before))
    usable, later_usable = (np.isfinite(array).all(axis=1) for array in (first, later_first))
    errors, later = np.where(np.isfinite(errors), errors, first), np.where(np.isfinite(later), later, later_first)
    pairs, changes = np.concatenate([data.x, data.u], axis=1), geometry.difference(data.x_next, data.x)
    pairs, errors, first, changes = (array[usable] for array in (pairs, errors, first, changes))
    return HeldOut(pairs, errors, first, changes, later[later_usable], later_first[later_usable])


def _errors_later(model: Model, runs: Sequence[Trajectory], n: int, steps: int = 10) -> Array:
    """Return the errors ``(K, n)`` of a model after some steps with recorded inputs, from each state that has these."""
    if not any(run.horizon >= steps for run in runs):
        return np.zeros((0, n))
    where = Windows.of(runs, 0, steps, sum(run.horizon for run in runs))
    with suppress(ModelError):  # users' models, at states that were not recorded
        return -predicted(model, where, steps)[0]
    return np.full((len(where), n), np.nan)


def _joined(parts: list[HeldOut]) -> HeldOut:
    arrays = ([value for name, value in vars(part).items() if name != "new"] for part in parts)
    return HeldOut(*(np.concatenate(together) for together in zip(*arrays, strict=True)))


@dataclass(frozen=True, eq=False)
class ResidualRegion(ShortRepr):
    """The magnitude of the residual in one region."""

    low: Array  #: the box of states and inputs, shapes ``(n + m,)``; infinite where it has no end
    high: Array
    steps: int  #: number of held-out transitions in it
    quantile: Array  #: 0.95 quantile and maximum of the residual of each state in one step, shapes ``(n,)``
    largest: Array


@dataclass(frozen=True, eq=False)
class MeasuredResidual(ShortRepr):
    """The residual ``S(x, u) - M'(x, u)`` of one step on transitions that are new to M': measured, not guaranteed."""

    states: dict[str, str]
    inputs: dict[str, str]
    whole: ResidualRegion  #: the residual in all regions together, whose box is the range of the records
    regions: tuple[ResidualRegion, ...]  #: disjoint, covering all states and inputs, those with small residuals first
    #: that of models learned without a part of the records, on it; None if ``whole`` and the regions are of these
    left_out: ResidualRegion | None = None

    @property
    def text(self) -> str:
        """The table as plain text."""
        units = labels_of(self.states)
        rows = [["region", "steps", *(f"{unit}: 95 %" for unit in units), *(f"{unit}: largest" for unit in units)]]
        listed = [(self._where(region), region) for region in self.regions]
        if self.left_out is None:
            listed.append(("all records", self.whole))
        else:
            listed += [("all that is new to the model", self.whole), ("left out in turn", self.left_out)]
        for where, region in listed:
            sizes = (*region.quantile.tolist(), *region.largest.tolist())
            rows.append([where, str(region.steps), *(f"{value:.3g}" for value in sizes)])
        return aligned(rows, right=True)

    @property
    def range_text(self) -> str:
        """The range of the records in one line; nothing was measured outside."""
        units, ends = {**self.states, **self.inputs}, self._ends(self.whole)
        return ", ".join(f"{name} {low:.3g} to {high:.3g} {units[name]}".rstrip() for name, low, high in ends)

    def _ends(self, region: ResidualRegion) -> list[tuple[str, float, float]]:
        return list(zip((*self.states, *self.inputs), region.low.tolist(), region.high.tolist(), strict=True))

    def _where(self, region: ResidualRegion) -> str:
        parts = []
        for name, low, high in self._ends(region):
            if np.isfinite(high):
                parts.append(f"{low:.3g} < {name} <= {high:.3g}" if np.isfinite(low) else f"{name} <= {high:.3g}")
            elif np.isfinite(low):
                parts.append(f"{name} > {low:.3g}")
        return ", ".join(parts) or "everywhere"

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as plain values; an end that is infinite is None."""

        def described(region: ResidualRegion) -> dict[str, Any]:
            return {
                "range": {name: ends for name, *ends in self._ends(region)},
                "steps": region.steps,
                "quantile": dict(zip(self.states, region.quantile.tolist(), strict=True)),
                "largest": dict(zip(self.states, region.largest.tolist(), strict=True)),
            }

        values = {
            "quantile_level": 0.95,
            "units": {**self.states, **self.inputs},
            "whole": described(self.whole),
            "left_out": self.left_out and described(self.left_out),
            "regions": list(map(described, self.regions)),
            "guaranteed": False,
        }
        return plain_json(values)


def measure_residual(held: HeldOut, states: dict[str, str], inputs: dict[str, str]) -> MeasuredResidual:
    """Return the residual by regions, from errors on transitions that were held out.

    If executions are new to the model, the regions are of these alone. The regions are those of a small regression
    tree: each split explains most of the spread of the logarithm of the error, in units of the typical change of each
    state. ``states`` and ``inputs`` are names with their units.
    """
    counted = held.counted

    def region(errors: Array, low: Array, high: Array) -> ResidualRegion:
        sizes = np.abs(errors)
        return ResidualRegion(low, high, len(sizes), np.quantile(sizes, 0.95, axis=0), sizes.max(axis=0))

    def whole(rows: Mask) -> ResidualRegion:
        return region(held.errors[rows], held.pairs[rows].min(axis=0), held.pairs[rows].max(axis=0))

    typical, errors = np.maximum(held.changes.std(axis=0), 1e-300), held.errors[counted]
    error = np.sqrt(((errors / typical) ** 2).mean(axis=1))
    logs = np.log(np.maximum(error, 1e-12 * max(float(error.max(initial=0.0)), 1e-300)))
    regions = [region(errors[inside], low, high) for inside, low, high in _split(held.pairs[counted], logs)]
    ordered = sorted(regions, key=lambda item: float((item.quantile / typical).max()))
    left_out = None if counted.all() else whole(~counted)
    return MeasuredResidual(states, inputs, whole(counted), tuple(ordered), left_out)


def _split(pairs: Array, logs: Array) -> list[tuple[Mask, Array, Array]]:
    """Return boxes with the transitions in them: the box whose split explains most is split first."""
    k = pairs.shape[1]
    boxes = [(np.ones(len(pairs), dtype=bool), np.full(k, -np.inf), np.full(k, np.inf))]
    # A split must explain a share of the spread, and more than rounding.
    least = max(0.1 * _spread(logs), 1e-6 * len(logs))
    while len(boxes) < 6:
        splits = [(*_best_split(pairs, logs, box[0]), i) for i, box in enumerate(boxes)]
        gain, column, place, best = max(splits, key=lambda split: split[0])
        if not gain > least:
            break
        inside, low, high = boxes.pop(best)
        below: Mask = np.asarray(pairs[:, column] <= place)
        lower_end, upper_end = high.copy(), low.copy()
        lower_end[column] = upper_end[column] = place
        boxes += [(inside & below, low, lower_end), (inside & ~below, upper_end, high)]
    return boxes


def _best_split(pairs: Array, logs: Array, inside: Mask) -> tuple[float, int, float]:
    """Return the spread that the best split of a box explains, with its column and its place."""
    best, chosen = (0.0, 0, 0.0), logs[inside]
    for column, values in enumerate(pairs[inside].T):
        # Rounded, so that they can be written down.
        for place in (float(f"{cut:.3g}") for cut in np.quantile(values, (0.25, 0.5, 0.75))):
            below = values <= place
            # The 0.95 quantile of fewer would be their largest value.
            if min(int(below.sum()), int((~below).sum())) >= 40:
                left = _spread(chosen[below]) + _spread(chosen[~below])
                best = max(best, (_spread(chosen) - left, column, place))
    return best


def _spread(values: Array) -> float:
    return float(((values - values.mean()) ** 2).sum())
