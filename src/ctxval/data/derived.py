"""States that are not recorded but follow from records: derivatives, and records of earlier steps."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Mask
from ctxval._util.refusals import reworded
from ctxval._util.texts import enumerated
from ctxval.core.trajectory import Trajectory
from ctxval.data.mapping import LogMapping, Observer
from ctxval.data.sampling import Break
from ctxval.errors import InputError

if TYPE_CHECKING:
    from ctxval.data.recordings import Recording, Recordings


def with_derived(recordings: Recordings, mapping: LogMapping) -> Recordings:
    """Return recordings with derivatives, with the states of an observer, and with those of earlier steps."""
    whole = _with_derivatives(recordings, mapping)
    if isinstance(mapping.observer, Observer):
        whole = _with_observer(whole, mapping.observer)
    return _with_lags(whole, mapping.lags)


def _with_derivatives(recordings: Recordings, mapping: LogMapping) -> Recordings:
    derived = {name: field for name, field in mapping.states.items() if field.derivative_of}
    if not derived:
        return recordings
    from scipy.signal import savgol_filter  # imported here, because it is slow to load and seldom needed

    known, dt = list(recordings.states), recordings.dt
    for name, field in derived.items():
        if field.derivative_of not in known:
            raise InputError(
                f"{name} is the derivative of {field.derivative_of!r}, which must be a recorded state with one "
                f"component; these are {', '.join(known)}."
            )
    # Components of vectors have names of their own, and stay where their field is.
    order = []
    for name in mapping.states:
        components = [label for label in known if label.startswith(name) and label[len(name) :].isdecimal()]
        order += [name] if name in derived or name in known else components
    window = max(field.window for field in derived.values())
    kept, breaks = _long_enough(recordings, window, f"the {window} records of a derivative")
    runs = []
    for run in kept:
        columns = dict(zip(known, run.trajectory.states.T, strict=True))
        for name, field in derived.items():
            columns[name] = savgol_filter(columns[field.derivative_of], field.window, 2, deriv=1, delta=dt)
        states = np.stack([columns[label] for label in order], axis=-1)
        runs.append(replace(run, trajectory=Trajectory(run.trajectory.times, states, run.trajectory.inputs)))
    units, notes = dict(recordings.states), list(recordings.notes)
    for name, field in derived.items():
        base_unit = recordings.states[field.derivative_of]
        units[name] = field.unit or (f"{base_unit}/s" if base_unit else "")
        notes.append(
            f"{name} is the derivative of {field.derivative_of}, that of a parabola through {field.window} records "
            f"around each: it looks {field.window // 2 * dt:.3g} s ahead, so a controller would have it that much later"
        )
    named = {label: units[label] for label in order}
    return replace(recordings, runs=tuple(runs), breaks=breaks, states=named, notes=tuple(notes))


def _with_observer(recordings: Recordings, observer: Observer) -> Recordings:
    """Return recordings with the states that a user's function estimates from them."""
    name = observer.reference or getattr(observer.function, "__name__", "")
    if observer.function is None:
        raise InputError(
            f"the observer {name} is not loaded: replay, fit and start do it; in Python, give the mapping the function."
        )
    runs: list[Recording] = []
    breaks, widths = list(recordings.breaks), set[int]()
    for run in recordings.runs:
        old = run.trajectory
        with reworded(f"the observer {name} failed on {run.source}"):  # the user's function
            x = np.asarray(observer.function(old.states.copy(), old.inputs.copy(), recordings.dt), dtype=np.float64)
        if x.ndim != 2 or len(x) != len(old.states) or not x.shape[1]:
            wanted = f"states of shape ({len(old.states)}, n)"
            raise InputError(f"the observer {name} must return {wanted}, got {x.shape}.")
        widths.add(x.shape[1])
        finite: Mask = np.asarray(np.isfinite(x).all(axis=1))
        first = int(finite.argmax()) if finite.any() else len(x)
        if not finite[first:].all():
            row = first + int(finite[first:].argmin())
            raise InputError(f"the observer {name} must return finite states; row {row} of {run.source} has {x[row]}.")
        if len(x) - first < 2:
            length, reason = old.horizon * recordings.dt, f"is too short for {name}"
            breaks.append(Break(run.source, run.start, length, "a part", reason))
            continue
        later = Trajectory(old.times[: len(x) - first], x[first:], old.inputs[first:])
        runs.append(replace(run, start=run.start + first * recordings.dt, trajectory=later))
    if not runs:
        raise InputError(f"the observer {name} returns no two finite states in a row.")
    n = min(widths)
    states = dict(observer.states)
    if not states:
        states = recordings.states if n == len(recordings.states) else {f"x{k}": "" for k in range(n)}
    if widths != {len(states)}:
        raise InputError(
            f"the observer {name} must return {len(states)} states ({enumerated(states, 6)}), got {max(widths)}."
        )
    note = f"the states are estimated by {name} from {enumerated(recordings.states, 6)}"
    notes = (*recordings.notes, note)
    return replace(recordings, runs=tuple(runs), breaks=tuple(breaks), states=states, notes=notes)


def _with_lags(recordings: Recordings, lags: int) -> Recordings:
    """Return recordings whose states have those of so many earlier steps beside them, and the inputs of these."""
    if not lags:
        return recordings
    kept, breaks = _long_enough(recordings, lags + 1, f"{lags + 1} records in a row")
    runs = []
    for run in kept:
        x, u, horizon = run.trajectory.states, run.trajectory.inputs, run.trajectory.horizon
        states = [x[lags - k : horizon + 1 - k] for k in range(lags + 1)]
        inputs = [u[lags - k : horizon + 1 - k] for k in range(1, lags + 1)]
        later = Trajectory(run.trajectory.times[: horizon + 1 - lags], np.hstack([*states, *inputs]), u[lags:])
        runs.append(replace(run, start=run.start + lags * recordings.dt, trajectory=later))
    named = dict(recordings.states)
    for units in (recordings.states, recordings.inputs):
        for k in range(1, lags + 1):
            ago = "a step before" if k == 1 else f"{k} steps before"
            named |= {f"{name} {ago}": unit for name, unit in units.items()}
    return replace(recordings, runs=tuple(runs), breaks=breaks, states=named)


def _long_enough(recordings: Recordings, records: int, what: str) -> tuple[list[Recording], tuple[Break, ...]]:
    """Return the recordings with so many records, and the breaks with those that are left out."""
    kept: list[Recording] = []
    left: list[Break] = []
    for run in recordings.runs:
        if len(run.trajectory.states) >= max(records, 2):
            kept.append(run)
        else:
            length = run.trajectory.horizon * recordings.dt
            left.append(Break(run.source, run.start, length, "a part", f"is too short for {what}"))
    if not kept:
        raise InputError(f"no recording has {what}.")
    return kept, (*recordings.breaks, *left)
