"""Recordings: logs as states and inputs at equal steps, split wherever something is missing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Rows
from ctxval._util.representation import Shown, call, counted
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.data.log import TIMES, Clock, Log, Table
from ctxval.data.mapping import LogMapping
from ctxval.data.parquet import ACTION, STATE, lerobot_names
from ctxval.data.readers import is_lerobot, read_logs
from ctxval.data.sampling import Break, Channel, sampled
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class Recording:
    """A part of a log without gaps, at equal steps.

    Attributes:
        source: the file, and the episode in it.
        start: the time at which it begins in the log, seconds.
        trajectory: the states and inputs; its times begin at 0.
    """

    source: str
    start: float
    trajectory: Trajectory

    def __repr__(self) -> str:
        return call(self, self.source, self.trajectory, start=self.start)


@dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings of one system with one time step.

    Attributes:
        runs: the recordings.
        breaks: where logs were split, and why.
        dt: length of a step, seconds.
        states, inputs: the names of the states and inputs with their units.
        notes: sentences on how the logs were read.
    """

    runs: tuple[Recording, ...]
    breaks: tuple[Break, ...]
    dt: float
    states: dict[str, str]
    inputs: dict[str, str]
    notes: tuple[str, ...] = ()

    @property
    def steps(self) -> int:
        """The number of recorded steps."""
        return sum(run.trajectory.horizon for run in self.runs)

    def transitions(self, runs: Iterable[int] | None = None) -> tuple[Transitions, Rows]:
        """Return the steps of some recordings as transitions, and the number of the recording of each.

        Args:
            runs: the numbers of the recordings; all of them by default.
        """
        numbers = list(range(len(self.runs)) if runs is None else runs)
        parts = [self.runs[number].trajectory.transitions() for number in numbers]
        return Transitions.joined(parts), np.repeat(np.array(numbers, dtype=np.intp), [len(part) for part in parts])

    def __repr__(self) -> str:
        size = Shown(f"{counted(len(self.runs), 'recording')}, {counted(self.steps, 'step')} of {self.dt:g} s")
        return call(self, size, states=list(self.states), inputs=list(self.inputs), breaks=len(self.breaks))


def read_recordings(paths: Sequence[str | Path], mapping: LogMapping | None = None, **changes: Any) -> Recordings:
    """Return the recordings in files and folders.

    Args:
        paths: CSV, NPZ, MATLAB, Parquet and MCAP files, ROS bags, LeRobot data sets, or folders of such files.
        mapping: which fields are states and inputs; by default, they are found by usual names.
        changes: other values of the mapping, such as ``dt`` and ``delay``.

    Raises:
        InputError: if a file cannot be read, or lacks a field; the message names file, field and row.
    """
    logs = read_logs(paths)
    chosen = LogMapping.usual(logs[0]) if mapping is None else mapping
    names = _stated_names(paths) if mapping is None else {}
    return recordings_of(logs, replace(chosen, **changes), names)


def recordings_of(
    logs: Sequence[Log], mapping: LogMapping | None = None, names: dict[str, list[str]] | None = None
) -> Recordings:
    """Return the recordings in logs.

    Args:
        logs: the logs.
        mapping: which fields are states and inputs; by default, they are found by usual names.
        names: names of the components of vector fields, if they are known.

    Raises:
        InputError: if a log lacks a field, if logs differ in their fields, or if nothing can be used.
    """
    chosen = LogMapping.usual(logs[0]) if mapping is None else mapping
    runs: list[Recording] = []
    breaks: list[Break] = []
    dt, first = chosen.dt, None
    for log in logs:
        channels = _channels(log, chosen, names or {})
        labels = [(channel.name, channel.of_input) for channel in channels]
        if first is None:
            first = channels
        elif labels != [(channel.name, channel.of_input) for channel in first]:
            raise InputError(f"{log.source} has other states or inputs than {logs[0].source}: read them separately.")
        dt = _period(log, channels[0]) if dt is None else dt
        parts, found = sampled(log.source, channels, dt, chosen.delay, chosen.longest_gap)
        runs += [Recording(log.source, start, trajectory) for start, trajectory in parts]
        breaks += found
    if first is None or dt is None or not runs:
        why = "; ".join(str(one) for one in breaks[:3])
        raise InputError(f"no log has two samples of all states and inputs in a row: {why or 'they are empty'}.")
    units = {channel.name: channel.unit for channel in first}
    inputs = {channel.name for channel in first if channel.of_input}
    return Recordings(
        tuple(runs),
        tuple(breaks),
        dt,
        {name: unit for name, unit in units.items() if name not in inputs},
        {name: unit for name, unit in units.items() if name in inputs},
        tuple(_notes(chosen, dt, first)),
    )


def _channels(log: Log, mapping: LogMapping, names: dict[str, list[str]]) -> list[Channel]:
    """Return the components of all states and inputs over time."""
    fields = mapping.fields
    stated = mapping.clock
    regular = mapping.dt if stated.field is None and not _has_times(log) else None
    clock = Clock(stated.field, stated.unit, regular, stated.stamp)
    signals = log.signals([one.path for one in fields.values()], clock)
    found = []
    for name, one in fields.items():
        signal = signals[one.path]
        width = signal.values.shape[1]
        own = names.get(one.path, [])
        for k in range(width):
            label = own[k] if len(own) == width else (name if width == 1 else f"{name}{k}")
            found.append(
                Channel(
                    label,
                    one.unit,
                    name in mapping.inputs,
                    signal.times,
                    one.scale * signal.values[:, k] + one.offset,
                    angle=one.angle,
                    held=one.held,
                    path=one.path,
                    place=(signal.word, signal.first),
                )
            )
    return _distinct(found)


def _distinct(channels: list[Channel]) -> list[Channel]:
    """Return channels with distinct names: in LeRobot data sets, states and actions have the same ones."""
    states = {channel.name for channel in channels if not channel.of_input}
    return [
        replace(one, name=f"{one.name} command") if one.of_input and one.name in states else one for one in channels
    ]


def _has_times(log: Log) -> bool:
    return not isinstance(log, Table) or any(name in log.names() for name in TIMES)


def _period(log: Log, channel: Channel) -> float:
    """Return the median period of a channel."""
    steps = np.diff(channel.times)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not len(steps):
        raise InputError(f"{log.source} has fewer than two samples of {channel.path}, so its time step is unknown.")
    period = float(np.median(steps))
    return float(f"{period:.6g}")


def _notes(mapping: LogMapping, dt: float, channels: Sequence[Channel]) -> Iterable[str]:
    if mapping.dt is None:
        yield f"the time step {dt:g} s is the median period of {channels[0].path}"
    for channel in channels:
        period = channel.period
        if not channel.of_input and period > 1.2 * dt:
            yield (
                f"{channel.name} is recorded every {period:.3g} s, less often than every step of {dt:g} s: its values "
                "between two samples are interpolated"
            )
    if mapping.delay:
        yield f"inputs act {mapping.delay:g} s after they are logged"


def _stated_names(paths: Sequence[str | Path]) -> dict[str, list[str]]:
    """Return the names of the components of states and actions, if one LeRobot data set is read."""
    if len(paths) != 1 or not is_lerobot(Path(paths[0])):
        return {}
    try:
        stated = lerobot_names(Path(paths[0]))
    except (InputError, AttributeError, TypeError):  # names are only labels
        return {}
    return {column: stated[column] for column in (STATE, ACTION) if column in stated}
