"""Mistakes of timing: inputs that act later than they are logged, and a model with another time step.

A suggestion is made only if the errors on recordings that did not choose it clearly fall.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import record
from ctxval.core.model import Model
from ctxval.replay.steps import RecordedSteps, Windows, stepped

# Delays of the inputs that are tried in whole steps; tenths of a step are tried around the best of them.
_SHIFTS = tuple(range(-3, 11))
_MULTIPLES = (2, 3, 4, 5, 10)  # ratios of the two time steps that are tried
# Largest ratio of held-out errors with and without a change that is suggested.
_CLEAR = {"delay": 0.85, "time step": 0.7}
# Largest difference between the values that two halves of the recordings choose: steps, or ratios of time steps.
_ALIKE_VALUES = {"delay": 0.5, "time step": 0.0}
_MOST = 8000  # largest number of recorded steps that are used


@dataclass(frozen=True)
class Suggestion:
    """A change of timing with which the model predicts held-out recordings clearly better.

    Attributes:
        kind: ``delay`` or ``time step``.
        value: the delay in seconds, or the time step of the model in seconds.
        ratio: the held-out one-step error with the change, divided by that without it.
        agreeing: share of the recordings in which the error falls.
        sentence: what it means.
    """

    kind: Literal["delay", "time step"]
    value: float
    ratio: float
    agreeing: float
    sentence: str
    __repr__ = record


def suggestions(model: Model, recorded: RecordedSteps) -> tuple[Suggestion, ...]:
    """Return the change of timing with which the model predicts held-out recordings clearly better, if there is one.

    Of two, only the better one is returned, because one mistake can look like another one.
    """
    found = [one for one in (_time_step(model, recorded), _delay(model, recorded)) if one is not None]
    return tuple(sorted(found, key=lambda one: one.ratio)[:1])


def _delay(model: Model, recorded: RecordedSteps) -> Suggestion | None:
    """Suggest a delay if the model, or an affine model of the recordings themselves, predicts better with it."""
    if not recorded.recordings.inputs:
        return None
    where = recorded.windows(max(_SHIFTS) + 1, 1 - min(_SHIFTS), _MOST)
    if not len(where):
        return None
    x, reached = recorded.states(where), recorded.states(where, 1)
    sizes = _sizes(reached - x)

    def delayed(shift: float) -> Array:
        """Return the mean input of each step if an input acts so many steps later."""
        whole = math.floor(shift)
        part = shift - whole
        now = recorded.inputs(where, -whole)
        return now + part * (recorded.inputs(where, -whole - 1) - now) if part else now

    by_model = _over_shifts(lambda shift: _errors(stepped(model, x, delayed(shift)) - reached, sizes))
    chosen = _chosen("delay", by_model, where.groups, 0.0)
    dt = recorded.recordings.dt
    if chosen is not None:
        shift, ratio, agreeing = chosen
        when = "after" if shift > 0 else "before"
        text = (
            f"the one-step error falls to {100 * ratio:.0f} % if the inputs act {abs(shift) * dt:.3g} s "
            f"({abs(shift):g} steps) {when} the time at which they are taken here: add {shift * dt:.3g} to delay in "
            "the mapping of the recordings, or let the model have this delay"
        )
        return Suggestion("delay", shift * dt, ratio, agreeing, text)
    groups = where.groups
    fitted = _over_shifts(lambda shift: _errors(_affine_errors(x, delayed(shift), reached, groups), sizes))
    chosen = _chosen("delay", fitted, where.groups, 0.0)
    # A model that predicts better than these affine models was not learned with inputs of another time.
    if chosen is None or by_model[0].mean() <= fitted[chosen[0]].mean():
        return None
    shift, ratio, agreeing = chosen
    text = (
        f"an affine model that is fitted to the recordings has {100 * ratio:.0f} % of the error if the inputs act "
        f"{abs(shift) * dt:.3g} s ({abs(shift):g} steps) {'after' if shift > 0 else 'before'} the time at which they "
        "are taken here; the model was perhaps learned with inputs of another time"
    )
    return Suggestion("delay", shift * dt, ratio, agreeing, text)


def _over_shifts(errors_of: Callable[[float], Array]) -> dict[float, Array]:
    """Return the errors for all delays in whole steps, and in tenths of steps around the best of them."""
    errors = {float(shift): errors_of(shift) for shift in _SHIFTS}
    best = min(errors, key=lambda shift: errors[shift].mean())
    around = {round(best + k / 10, 1) for k in range(-9, 10)} - {best}
    return errors | {s: errors_of(s) for s in sorted(around) if min(_SHIFTS) <= s <= max(_SHIFTS)}


def _time_step(model: Model, recorded: RecordedSteps) -> Suggestion | None:
    """Suggest another time step of the model if it then predicts better."""
    where = recorded.windows(0, max(_MULTIPLES), _MOST)
    if not len(where):
        return None
    errors: dict[float, Array] = {1.0: _relative(model, recorded, where, 1, 1)}
    for k in _MULTIPLES:
        errors[1 / k] = _relative(model, recorded, where, k, 1)
        errors[float(k)] = _relative(model, recorded, where, 1, k)
    chosen = _chosen("time step", errors, where.groups, 1.0)
    if chosen is None:
        return None
    factor, ratio, agreeing = chosen
    own, dt = factor * recorded.recordings.dt, recorded.recordings.dt
    text = (
        f"the error relative to the motion falls to {100 * ratio:.0f} % if one step of the model takes {own:g} s "
        f"instead of {dt:g} s: check the time step of the model, or give dt = {own:g}"
    )
    return Suggestion("time step", own, ratio, agreeing, text)


def _relative(model: Model, recorded: RecordedSteps, where: Windows, own: int, steps: int) -> Array:
    """Return squared errors relative to the recorded change, if so many steps of each take the same time."""
    x = start = recorded.states(where)
    inputs = [recorded.inputs(where, k) for k in range(steps)]
    held = np.mean(inputs, axis=0)
    for _ in range(own):
        x = stepped(model, x, held)
    reached = recorded.states(where, steps)
    return _errors(x - reached, _sizes(reached - start))


def _sizes(changes: Array) -> Array:
    """Return the root mean square of each state's change; infinity for states that never change."""
    sizes = np.sqrt((changes**2).mean(axis=0)) if len(changes) else np.ones(changes.shape[1])
    return np.where(sizes > 0, sizes, np.inf)


def _errors(errors: Array, sizes: Array) -> Array:
    """Return the mean over the states of squared errors relative to sizes, ``(N,)``; large if not finite."""
    with np.errstate(all="ignore"):
        return np.asarray(np.nan_to_num(((errors / sizes) ** 2).mean(axis=1), nan=1e30, posinf=1e30).clip(max=1e30))


def _affine_errors(x: Array, u: Array, reached: Array, groups: Rows) -> Array:
    """Return held-out errors of an affine model of the recordings; every second group is held out in turn."""
    Z = np.column_stack([np.ones(len(x)), x, u])
    Z = Z / np.maximum(np.abs(Z).max(axis=0), 1e-12)
    odd = np.searchsorted(np.unique(groups), groups) % 2 == 1
    found = np.zeros_like(reached)
    for held in (odd, ~odd):
        if held.any() and (~held).sum() > Z.shape[1]:
            weights = np.linalg.lstsq(Z[~held], (reached - x)[~held], rcond=1e-10)[0]
            found[held] = Z[held] @ weights + x[held] - reached[held]
    return found


def _chosen(kind: str, errors: Mapping[float, Array], groups: Rows, usual: float) -> tuple[float, float, float] | None:
    """Return the value that two halves of the recordings choose alike, its held-out ratio and the agreeing share.

    Returns None unless the error clearly falls, in most recordings.
    """
    known = np.unique(groups)
    if len(known) < 2:
        return None
    values = list(errors)
    table = np.array([[errors[value][groups == group].mean() for group in known] for value in values])
    base = table[values.index(usual)]
    halves = [np.arange(len(known)) % 2 == k for k in (0, 1)]
    picked = [values[int(np.argmin(table[:, half].sum(axis=1)))] for half in halves]
    # Smaller errors are rounding.
    if abs(picked[0] - picked[1]) > _ALIKE_VALUES[kind] or usual in picked or base.mean() < 1e-9**2:
        return None
    row = int(np.argmin(table.sum(axis=1)))
    ratio, agreeing = float(np.sqrt(table[row].sum() / base.sum())), float((table[row] < base).mean())
    if ratio > _CLEAR[kind] or agreeing < 0.8:  # in most recordings
        return None
    return values[row], ratio, agreeing
