"""Recordings: logs as states and inputs at equal steps, split wherever something is missing; also as a system."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.columns import FAR, conversion, sentinels, time_column, unit_advice
from ctxval._util.refusals import reworded
from ctxval._util.representation import ShortRepr, counted
from ctxval._util.texts import enumerated
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.data.log import Clock, Log, Signal, Table
from ctxval.data.mapping import LogMapping, Observer
from ctxval.data.rates import Clocked, Column, require_scale
from ctxval.data.readers import component_names, read_logs
from ctxval.data.sampling import Break, Channel, sampled
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class Recording(ShortRepr):
    """A part of a log without gaps, at equal steps; it begins in the log at ``start``, and its own times begin at 0."""

    source: str
    start: float
    trajectory: Trajectory


@dataclass(frozen=True, eq=False)
class Recordings(ShortRepr):
    """Recordings of one system with one time step."""

    runs: tuple[Recording, ...]  #: the recordings
    breaks: tuple[Break, ...]  #: where logs were split, and why
    dt: float  #: length of a step, seconds
    states: dict[str, str]  #: the names of the states and inputs with their units
    inputs: dict[str, str]
    notes: tuple[str, ...] = ()  #: sentences on how the logs were read

    @property
    def steps(self) -> int:
        """The number of recorded steps."""
        return sum(run.trajectory.horizon for run in self.runs)

    def transitions(self, runs: Iterable[int] | None = None) -> tuple[Transitions, Rows]:
        """Return the steps of some recordings as transitions, and the number of the recording of each."""
        numbers = list(range(len(self.runs)) if runs is None else runs)
        parts = [self.runs[number].trajectory.transitions() for number in numbers]
        of = np.repeat(np.array(numbers, dtype=np.intp), [len(part) for part in parts])
        return replace(Transitions.joined(parts), dt=self.dt, states=self.states, inputs=self.inputs), of


def read_recordings(
    paths: Sequence[str | Path],
    mapping: LogMapping | None = None,
    *,
    states: Mapping[str, str] | None = None,
    inputs: Mapping[str, str] | None = None,
    **changes: Any,
) -> Recordings:
    """Return the recordings in files and folders.

    Args:
        paths: CSV, NPZ, MATLAB, Parquet, ULog and MCAP files, ROS bags, LeRobot data sets, or folders of such files.
        mapping: which fields are states and inputs; by default, they are found by the names below, or by usual names.
        states, inputs: names and units of an experiment, to which values are converted.
        changes: other values of the mapping, such as ``dt`` and ``delay``.
    """
    logs = read_logs(paths)
    chosen = LogMapping.usual(logs[0], states, inputs) if mapping is None else mapping
    names = component_names(paths) if mapping is None else {}
    return recordings_of(logs, replace(chosen.in_units(states or {}, inputs or {}), **changes), names)


def recordings_of(
    logs: Sequence[Log], mapping: LogMapping | None = None, names: Mapping[str, list[str]] | None = None
) -> Recordings:
    """Return the recordings in logs; ``names`` are those of the components of vector fields, if they are known.

    Raises:
        InputError: if nothing is recorded in steps of dt, or logs differ in states.
    """
    chosen = LogMapping.usual(logs[0]) if mapping is None else mapping
    runs, breaks, notes, first = list[Recording](), list[Break](), list[str](), list[Channel]()
    dt = chosen.dt
    used = [field.path for field in chosen.fields.values()]
    for log in (episode for whole in logs for episode in whole.episodes(used)):
        channels = _channels(log, chosen, names or {}, notes)
        labels = [(channel.name, channel.of_input) for channel in channels]
        if first and labels != [(channel.name, channel.of_input) for channel in first]:
            raise InputError(f"{log.source} has other states or inputs than {logs[0].source}: read them separately.")
        first = first or channels
        channels = [_in_unit_of(log, *pair) for pair in zip(channels, first, strict=True)]
        dt = _mean_period(log, channels[0]) if dt is None else dt
        # States must not be recorded much less often than every step, or have times of another unit.
        period = min((channel.period for channel in channels if not channel.of_input and channel.period), default=dt)
        if chosen.longest_gap is None and (period > FAR * dt or unit_advice(period, dt)):
            usual = f"give dt = {period:g}, or longest_gap if states are to be interpolated over so many steps"
            times = f"a sample of {channels[0].name} every {period:g} s, and a step takes {dt:g} s"
            raise InputError(f"{log.source} has {times}: {unit_advice(period, dt) or usual}.")
        parts, gaps = sampled(log.source, channels, dt, chosen.delay, chosen.longest_gap)
        runs += [Recording(log.source, start, trajectory) for start, trajectory in parts]
        breaks += gaps
    if dt is None or not runs:
        why = "; ".join(map(str, breaks[:3]))
        raise InputError(f"no log has two samples of all states and inputs in a row: {why or 'they are empty'}.")
    how = [] if chosen.dt is not None else [f"the time step {dt:g} s is the mean period of {first[0].path}"]
    for channel in first:
        if not channel.of_input and channel.period > 1.2 * dt:
            seldom = f"every {channel.period:.3g} s, less often than every step of {dt:g} s"
            how.append(f"{channel.name} is recorded {seldom}: its values between two samples are interpolated")
    if chosen.delay:
        how.append(f"inputs act {chosen.delay:g} s after they are logged")
    states = {channel.name: channel.unit for channel in first if not channel.of_input}
    inputs = {channel.name: channel.unit for channel in first if channel.of_input}
    notes += _scale_notes(runs, first, dt, _clocked(logs[0], chosen))
    whole = Recordings(tuple(runs), tuple(breaks), dt, states, inputs, (*how, *dict.fromkeys(notes)))
    return _with_lags(_with_observer(_with_derivatives(whole, chosen), chosen), chosen.lags)


def _scale_notes(runs: Sequence[Recording], channels: Sequence[Channel], dt: float, clock: Clocked) -> list[str]:
    """Refuse times, units and signs that contradict each other in one log or in all; return what is unusual of them."""
    columns = [Column(channel.name, channel.unit, channel.of_input, channel.scaled) for channel in channels]
    groups = {run.source: [each.trajectory for each in runs if each.source == run.source] for run in runs[:100]}
    if len(groups) > 1:
        groups["all logs"] = [run.trajectory for run in runs]
    return [note for source, some in groups.items() for note in require_scale(source, some, columns, dt, clock)]


def _clocked(log: Log, mapping: LogMapping) -> Clocked:
    """Return in which unit the times of a log are taken, and who states it; messages and dates state it themselves."""
    times = log.numbered_times(_clock(log, mapping))
    return Clocked() if times is None else Clocked.of(*times, stated=mapping.dt is not None)


def _clock(log: Log, mapping: LogMapping) -> Clock:
    """Return the clock of a mapping; rows of a table without times have equal steps."""
    if mapping.clock.field is not None or not isinstance(log, Table) or time_column(log.source, log.fields()):
        return mapping.clock
    return replace(mapping.clock, period=log.period or mapping.dt)


def _channels(log: Log, mapping: LogMapping, names: Mapping[str, list[str]], notes: list[str]) -> list[Channel]:
    """Return the components of all states and inputs over time; sentences on how they were read are added to notes."""
    clock, condition = _clock(log, mapping), mapping.condition
    paths = [field.path for field in mapping.fields.values()]
    signals = log.signals([*paths, *([condition[0]] if condition else [])], clock)
    notes += log.remarks
    channels: list[Channel] = []
    for name, field in mapping.fields.items():
        signal = signals[field.path]
        values = signal.values.copy()
        if condition is not None:
            status, equal, number = signals[condition[0]], *condition[1:]
            at = np.searchsorted(status.times, signal.times, side="right") - 1
            rows = slice(None) if status.times is signal.times else np.maximum(at, 0)
            values[(status.values[rows, 0] == number) != equal] = np.nan
        if signal.clock:
            moment = {"log": "those at which they were logged", "publish": "those at which they were sent"}
            notes.append(f"the times of messages are {moment.get(signal.clock, 'their header stamps')}")
        components = names.get(field.path, [])
        width, scale = values.shape[1], field.scale(signal.unit)
        for k, column in enumerate(values.T):
            label = components[k] if len(components) == width else (name if width == 1 else f"{name}{k}")
            _without_marks(f"{log.source}: {label}", column, scale, signal, notes)
            unit = field.unit or (signal.unit if field.factor is None else "")
            converted = scale * column + field.offset
            about = field.angle, field.held, field.path, (signal.word, signal.first), field.factor is not None
            channels.append(Channel(label, unit, name in mapping.inputs, signal.times, converted, *about))
    # In LeRobot data sets, states and actions have the same names.
    states = {channel.name for channel in channels if not channel.of_input}
    return [
        replace(channel, name=f"{channel.name} command") if channel.of_input and channel.name in states else channel
        for channel in channels
    ]


def _without_marks(name: str, column: Array, scale: float, signal: Signal, notes: list[str]) -> None:
    for value in sentinels(column, scale):
        marked = column == value
        places = counted(int(marked.sum()), signal.word)
        notes.append(f"{name} is {value:g} in {places}, far from all other values: it is taken as missing")
        column[marked] = np.nan
    largest = float(np.abs(column[np.isfinite(column)]).max(initial=0.0))
    if largest > 1e100:  # squares of errors must be finite
        raise InputError(f"{name} must be at most 1e+100, got {largest:g}; leave out missing values.")


def _in_unit_of(log: Log, channel: Channel, first: Channel) -> Channel:
    if channel.unit == first.unit:
        return channel
    if not channel.unit or not first.unit:
        here, others = (each.unit or "an unknown unit" for each in (channel, first))
        others = f"other logs have it in {others}: state its unit in all files, or in none"
        raise InputError(f"{log.source} has {channel.name} in {here}, and {others}.")
    return replace(channel, unit=first.unit, values=conversion(channel.unit, first.unit) * channel.values)


def _mean_period(log: Log, channel: Channel) -> float:
    """Return the mean period of a channel, rounded if that does not move a sample."""
    period, steps = channel.period, np.diff(channel.recorded)
    if not period:
        raise InputError(f"{log.source} has fewer than two samples of {channel.path}, so its time step is unknown.")
    rounded = float(f"{period:.6g}")
    # A rounded step must not drift away from the samples over the whole recording.
    return rounded if abs(rounded - period) * steps[steps > 0].sum() < 1e-3 * period**2 else period


# States that are not recorded but follow from records: derivatives, and records of earlier steps


def _with_derivatives(recordings: Recordings, mapping: LogMapping) -> Recordings:
    derived = {name: field for name, field in mapping.states.items() if field.derivative_of}
    if not derived:
        return recordings
    from scipy.signal import savgol_filter  # imported here, because it is slow to load and seldom needed

    known, dt = list(recordings.states), recordings.dt
    for name, field in derived.items():
        if field.derivative_of not in known:
            wanted = f"which must be a recorded state with one component; these are {', '.join(known)}"
            raise InputError(f"{name} is the derivative of {field.derivative_of!r}, {wanted}.")
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
        runs.append(_from_step(0, run, np.stack([columns[label] for label in order], axis=-1), dt))
    units, notes = dict(recordings.states), list(recordings.notes)
    for name, field in derived.items():
        base_unit = recordings.states[field.derivative_of]
        units[name] = field.unit or (f"{base_unit}/s" if base_unit else "")
        fitted = f"that of a parabola through {field.window} records around each"
        later = f"{field.window // 2 * dt:.3g} s ahead, so a controller would have it that much later"
        notes.append(f"{name} is the derivative of {field.derivative_of}, {fitted}: it looks {later}")
    named = {label: units[label] for label in order}
    return replace(recordings, runs=tuple(runs), breaks=breaks, states=named, notes=tuple(notes))


def _with_observer(recordings: Recordings, mapping: LogMapping) -> Recordings:
    observer = mapping.observer
    if not isinstance(observer, Observer):
        return recordings
    name = observer.reference or getattr(observer.function, "__name__", "")
    if observer.function is None:
        how = "replay, fit and start do it; in Python, give the mapping the function"
        raise InputError(f"the observer {name} is not loaded: {how}.")
    runs, breaks, widths = list[Recording](), list(recordings.breaks), set[int]()
    for run in recordings.runs:
        y, u = run.trajectory.states, run.trajectory.inputs
        with reworded(f"the observer {name} failed on {run.source}"):  # the user's function
            x = np.asarray(observer.function(y.copy(), u.copy(), recordings.dt), dtype=np.float64)
        if x.ndim != 2 or len(x) != len(y) or not x.shape[1]:
            wanted = f"states of shape ({len(y)}, n)"
            raise InputError(f"the observer {name} must return {wanted}, got {x.shape}.")
        widths.add(x.shape[1])
        finite: Mask = np.asarray(np.isfinite(x).all(axis=1))
        first = int(finite.argmax()) if finite.any() else len(x)
        if not finite[first:].all():
            row = first + int(finite[first:].argmin())
            raise InputError(f"the observer {name} must return finite states; row {row} of {run.source} has {x[row]}.")
        if len(x) - first < 2:
            breaks.append(_too_short(run, name, recordings.dt))
        else:
            runs.append(_from_step(first, run, x[first:], recordings.dt))
    if not runs:
        raise InputError(f"the observer {name} returns no two finite states in a row.")
    n = min(widths)
    states = dict(observer.states)
    if not states:
        states = recordings.states if n == len(recordings.states) else {f"x{k}": "" for k in range(n)}
    if widths != {len(states)}:
        wanted = f"{len(states)} states ({enumerated(states, 6)})"
        raise InputError(f"the observer {name} must return {wanted}, got {max(widths)}.")
    notes = (*recordings.notes, f"the states are estimated by {name} from {enumerated(recordings.states, 6)}")
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
        runs.append(_from_step(lags, run, np.hstack([*states, *inputs]), recordings.dt))
    named = dict(recordings.states)
    for units in (recordings.states, recordings.inputs):
        for k in range(1, lags + 1):
            ago = "a step before" if k == 1 else f"{k} steps before"
            named |= {f"{name} {ago}": unit for name, unit in units.items()}
    return replace(recordings, runs=tuple(runs), breaks=breaks, states=named)


def _long_enough(recordings: Recordings, records: int, what: str) -> tuple[list[Recording], tuple[Break, ...]]:
    kept, left = list[Recording](), list[Recording]()
    for run in recordings.runs:
        (kept if len(run.trajectory.states) >= max(records, 2) else left).append(run)
    if not kept:
        raise InputError(f"no recording has {what}.")
    return kept, (*recordings.breaks, *(_too_short(run, what, recordings.dt) for run in left))


def _from_step(first: int, run: Recording, states: Array, dt: float) -> Recording:
    """Return a recording from a step on, with states in the place of its own."""
    whole = run.trajectory
    later = Trajectory(whole.times[: len(states)], states, whole.inputs[first:])
    return replace(run, start=run.start + first * dt, trajectory=later)


def _too_short(run: Recording, what: str, dt: float) -> Break:
    return Break(run.source, run.start, run.trajectory.horizon * dt, "a part", f"is too short for {what}")
