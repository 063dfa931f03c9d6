"""States that are not recorded but follow from records: derivatives, and records of earlier steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.texts import enumerated, reason_of
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
    order = [label for name in mapping.states for label in ([name] if name in derived else _components(name, known))]

    def states(run: Trajectory) -> Array:
        columns = dict(zip(known, run.states.T, strict=True))
        for name, field in derived.items():
            base = columns[field.derivative_of]
            columns[name] = savgol_filter(base, field.window, 2, deriv=1, delta=dt)
        return np.stack([columns[label] for label in order], axis=-1)

    window = max(field.window for field in derived.values())
    kept, breaks = _long_enough(recordings, window, f"the {window} records of a derivative")
    runs = tuple(replace(run, trajectory=_with_states(run.trajectory, states(run.trajectory))) for run in kept)
    units = dict(recordings.states)
    for name, field in derived.items():
        base_unit = recordings.states[field.derivative_of]
        units[name] = field.unit or (f"{base_unit}/s" if base_unit else "")
    notes = [
        f"{name} is the derivative of {field.derivative_of}, that of a parabola through {field.window} records around "
        f"each: it looks {field.window // 2 * dt:.3g} s ahead, so a controller would have it that much later"
        for name, field in derived.items()
    ]
    named = {label: units[label] for label in order}
    return replace(recordings, runs=runs, breaks=breaks, states=named, notes=(*recordings.notes, *notes))


def _components(name: str, known: Sequence[str]) -> list[str]:
    """Return the labels of a field: its name, or those of its components."""
    if name in known:
        return [name]
    return [label for label in known if label.startswith(name) and label[len(name) :].isdecimal()]


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
        x, old = _estimated(observer.function, name, run, recordings.dt), run.trajectory
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


def _estimated(function: Callable[[Array, Array, float], Array], name: str, run: Recording, dt: float) -> Array:
    """Return the states ``(H + 1, n)`` that a user's function returns for a recording."""
    y, u = run.trajectory.states, run.trajectory.inputs
    try:
        x = np.asarray(function(y.copy(), u.copy(), dt), dtype=np.float64)
    except Exception as error:  # the user's function
        raise InputError(f"the observer {name} failed on {run.source}: {reason_of(error)}.") from error
    if x.ndim != 2 or len(x) != len(y) or not x.shape[1]:
        raise InputError(f"the observer {name} must return states of shape ({len(y)}, n), got {x.shape}.")
    return x


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
    for k in range(1, lags + 1):
        named |= {f"{name} {_ago(k)}": unit for name, unit in recordings.states.items()}
    for k in range(1, lags + 1):
        named |= {f"{name} {_ago(k)}": unit for name, unit in recordings.inputs.items()}
    return replace(recordings, runs=tuple(runs), breaks=breaks, states=named)


def _ago(steps: int) -> str:
    return "a step before" if steps == 1 else f"{steps} steps before"


def _long_enough(recordings: Recordings, records: int, what: str) -> tuple[list[Recording], tuple[Break, ...]]:
    """Return the recordings with so many records, and the breaks with those that are left out."""
    kept = [run for run in recordings.runs if len(run.trajectory.states) >= max(records, 2)]
    short = [run for run in recordings.runs if len(run.trajectory.states) < max(records, 2)]
    if not kept:
        raise InputError(f"no recording has {what}.")
    left = [
        Break(run.source, run.start, run.trajectory.horizon * recordings.dt, "a part", f"is too short for {what}")
        for run in short
    ]
    return kept, (*recordings.breaks, *left)


def _with_states(run: Trajectory, states: Array) -> Trajectory:
    return Trajectory(run.times, states, run.inputs)
