"""States that are not recorded but follow from records: derivatives, and records of earlier steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.trajectory import Trajectory
from ctxval.data.mapping import LogMapping
from ctxval.data.sampling import Break
from ctxval.errors import InputError

if TYPE_CHECKING:
    from ctxval.data.recordings import Recording, Recordings


def with_derived(recordings: Recordings, mapping: LogMapping) -> Recordings:
    """Return recordings with the derivatives and the earlier records that a mapping asks for, as further states."""
    return _with_lags(_with_derivatives(recordings, mapping), mapping.lags)


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
