"""Resampling to equal steps: states are interpolated, inputs averaged, and nothing is bridged over a gap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from ctxval._util.arrays import Array, held_means
from ctxval._util.quaternions import continued, normalised, quaternions_in
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError

_SLACK = 1e-3  # a sample within this share of a period of a wanted time belongs to it, because times are rounded

Interval = tuple[float, float]


@dataclass(frozen=True)
class Break:
    """A place at which a log was split."""

    source: str
    time: float  #: the time of the last sample before it in the log, seconds
    seconds: float  #: the time that is left out; 0 if the times go back
    field: str  #: the name of the state or input
    reason: str  #: what is missing

    def __str__(self) -> str:
        return f"{self.source}, {self.time:g} s: {self.field} {self.reason}"


@dataclass(frozen=True, eq=False)
class Channel(ShortRepr):
    """One state or input over time, in the unit of the model."""

    name: str
    unit: str
    of_input: bool  #: whether it is an input, which holds until the next sample; a state is interpolated
    times: Array  #: its samples, shape ``(N,)``; NaN where there is no value
    values: Array
    angle: bool = False  #: whether it is an angle that is continued over turns
    held: bool = False  #: whether a value holds until the next one, however long that takes
    path: str = ""  #: its field in the log
    place: tuple[str, int] = ("row", 0)  #: what counts its samples in messages, and the number of the first one
    scaled: bool = False  #: whether the user states its factor

    @cached_property
    def recorded(self) -> Array:
        """The times of the samples that have a value: in a joined table, a row may hold another field alone."""
        return np.asarray(self.times[np.isfinite(self.values)])

    @cached_property
    def rhythm(self) -> tuple[float, float]:
        """The mean and the longest usual time between two samples, seconds, in which longer steps count as several."""
        return _rhythm(self.recorded if len(self.recorded) > 1 else self.times)

    @property
    def period(self) -> float:
        """The mean time between two samples, seconds; 0 if there are fewer than two."""
        return self.rhythm[0]

    @property
    def longest(self) -> float:
        """The longest time between two samples without a gap, in seconds; 1.5 periods, or usual longer steps."""
        return 1.5 * self.rhythm[1]


def _rhythm(times: Array) -> tuple[float, float]:
    """Return the mean period of times, and the longer of it and of the usual longer steps if their steps differ.

    Times may come in bursts, or with a jitter that is not small against the period. So steps are counted in runs of as
    few steps as differ in length by less than half a period, or else of as many as make the period least uncertain.
    """
    steps = np.diff(times)
    steps = steps[steps > 0]
    if not len(steps):
        return 0.0, 0.0
    ends, spreads = np.concatenate([[0.0], np.cumsum(steps)]), dict[tuple[int, float], float]()
    for count in (1, 2, 3, 4, 5, 6, 8, 10, 16):
        if count == 1 or len(steps) >= 4 * count:
            low, middle, high = (np.quantile(ends[count:] - ends[:-count], [0.25, 0.5, 0.75]) / count).tolist()
            spreads[count, middle] = high - low
            if count * (high - low) < 0.4 * middle:
                break
    best, period = min(spreads, key=spreads.__getitem__)
    starts = np.arange(0, len(steps), best * -(-8 // best))
    runs, lengths = np.add.reduceat(steps, starts), np.diff(starts, append=len(steps))
    for _ in range(4):  # a better period counts better
        period = float(runs.sum() / np.maximum(np.rint(runs / period), lengths).sum())
    return period, period if best == 1 else max(period, float(np.quantile(steps, 0.75)))


def sampled(
    source: str, channels: Sequence[Channel], dt: float, delay: float, longest_gap: float | None
) -> tuple[list[tuple[float, Trajectory]], list[Break]]:
    """Return the parts of a log in which all channels have values, at equal steps, and where it was split."""
    parts, breaks = list[tuple[float, Trajectory]](), list[Break]()
    for pieces in _forward_pieces(source, channels, breaks):
        moved = [replace(channel, times=channel.times + delay) if channel.of_input else channel for channel in pieces]
        common: list[Interval] = [(-np.inf, np.inf)]
        for channel in moved:
            common = _intersection(common, _intervals(source, channel, longest_gap, breaks))
        for start, end in common:
            part = _part(source, moved, start, end, dt)
            if part is not None:
                parts.append(part)
            elif np.isfinite([start, end]).all():
                reason = f"of {end - start:.3g} s is shorter than a step"
                breaks.append(Break(source, start, end - start, "a part", reason))
    return parts, breaks


def _forward_pieces(source: str, channels: Sequence[Channel], breaks: list[Break]) -> list[list[Channel]]:
    """Return the channels in pieces in which times increase; channels with times of their own must increase."""
    first = channels[0]
    steps = np.diff(first.times)
    word, line = first.place
    if not all(channel.times is first.times or np.array_equal(channel.times, first.times) for channel in channels):
        for channel in channels:
            back = np.flatnonzero(np.diff(channel.times) <= 0)
            if len(back):
                k, (word, line) = int(back[0]), channel.place
                must = f"its time must be after that of the one before, {channel.times[k]:.9g} s"
                where = f"{source}, {word} {line + k + 1} of {channel.path}"
                raise InputError(f"{where}: {must}, got {channel.times[k + 1]:.9g} s.")
        return [list(channels)]
    still = np.flatnonzero(steps == 0)
    if len(still) > 1 + 0.1 * len(first.times):  # single rows may be written twice
        what = f"{len(still)} of {len(first.times)} {word}s have the time of the {word} before"
        where = f"the first {word} {line + int(still[0]) + 1}, {first.times[still[0]]:.9g} s"
        raise InputError(f"{source}: {what}, {where}: give times with more digits.")
    ends = np.flatnonzero(steps <= 0).tolist()
    for end in ends:
        before, after = f"{first.times[end]:g} s", f"{first.times[end + 1]:g} s"
        how = f"stay at {before}" if steps[end] == 0 else f"go back from {before} to {after}"
        reason = f"{how} at {word} {line + end + 1}"
        breaks.append(Break(source, float(first.times[end]), 0.0, "times", reason))

    def piece(channel: Channel, start: int, stop: int) -> Channel:
        place = channel.place[0], channel.place[1] + start
        return replace(channel, times=channel.times[start:stop], values=channel.values[start:stop], place=place)

    bounds = pairwise([0, *(end + 1 for end in ends), len(first.times)])
    return [[piece(channel, *ends) for channel in channels] for ends in bounds]


def _intervals(source: str, channel: Channel, longest_gap: float | None, breaks: list[Break]) -> list[Interval]:
    """Return the intervals of time in which a channel has a value; what lies between them is added to the breaks."""
    times, good = channel.times, np.isfinite(channel.values)
    if not good.any():
        if len(times):
            breaks.append(Break(source, float(times[0]), float(np.ptp(times)), channel.name, "has no value"))
        return []
    period = channel.period
    if channel.held:
        return [(float(times[good][0]), np.inf)]
    rows = np.flatnonzero(good)
    word, first = channel.place
    longest, kept = channel.longest if longest_gap is None else longest_gap, times[good]
    # Each run of samples without a value between two with one, unless the rows between them hold other fields; the
    # input of the last row of a trajectory is not needed.
    missing = (np.diff(rows) > 1) & (np.diff(kept) > min(channel.longest, longest) * (1 + 1e-9))
    for before, after in ((int(rows[k]), int(rows[k + 1])) for k in np.flatnonzero(missing)):
        where = f"{word} {first + before + 1}"
        if after - before > 2:
            where = f"{word}s {first + before + 1} to {first + after - 1}"
        gap = float(times[after] - times[before])
        breaks.append(Break(source, float(times[before]), gap, channel.name, f"has no value in {where}"))
    cut = missing | (np.diff(kept) > longest * (1 + 1e-9))
    for k in np.flatnonzero(cut & ~missing).tolist():
        gap = float(kept[k + 1] - kept[k])
        breaks.append(Break(source, float(kept[k]), gap, channel.name, f"has no sample for {gap:.3g} s"))
    starts, ends = kept[np.append(True, cut)], kept[np.append(cut, True)]
    reach = min(period, longest) if channel.of_input else 0.0
    return [(float(a), float(b) + reach) for a, b in zip(starts, ends, strict=True)]


def _intersection(first: list[Interval], second: list[Interval]) -> list[Interval]:
    both, i, j = list[Interval](), 0, 0
    while i < len(first) and j < len(second):
        start, end = max(first[i][0], second[j][0]), min(first[i][1], second[j][1])
        if start <= end:
            both.append((start, end))
        if first[i][1] < second[j][1]:
            i += 1
        else:
            j += 1
    return both


def _part(
    source: str, channels: Sequence[Channel], start: float, end: float, dt: float
) -> tuple[float, Trajectory] | None:
    # Steps begin at samples of the first state, if its input is delayed by a part of one.
    samples = channels[0].recorded
    later = samples[np.searchsorted(samples, start - _SLACK * dt) :][:1]
    if len(later) and 0 < later[0] - start < channels[0].period:
        start = float(later[0])
    steps = np.floor((end - start) / dt + 1e-3)
    if not 1 <= steps < np.inf:
        return None
    if steps > 20_000_000:
        raise InputError(f"{source} has {steps:.3g} steps of {dt:g} s, more than 20000000: give a larger dt.")
    times: Array = np.asarray(dt * np.arange(int(steps) + 1), dtype=np.float64)
    states, inputs = list[Array](), list[Array]()
    channels, turning = _with_one_sign(channels)
    for channel in channels:
        if channel.of_input:  # it holds until the next sample, which may come within a step
            good = np.isfinite(channel.values)
            held = channel.times[good], channel.values[good, None]
            inputs.append(held_means(*held, start + times, _SLACK * dt)[:, 0])
        else:
            states.append(_interpolated(channel, start + times))
    columns = np.stack(inputs, axis=-1) if inputs else np.empty((int(steps), 0))
    together = np.stack(states, axis=-1)
    for at in turning:
        together[:, at] = normalised(together[:, at])
    return start, Trajectory(times, together, columns)


def _with_one_sign(channels: Sequence[Channel]) -> tuple[list[Channel], list[slice]]:
    """Return channels, the states first, whose quaternions keep one sign, and the places of these in states."""
    states, inputs = ([each for each in channels if each.of_input == of_input] for of_input in (False, True))
    recorded, turning = [each.values[np.isfinite(each.values)] for each in states], list[slice]()
    for at in quaternions_in(recorded):
        times = [each.recorded for each in states[at]]
        if all(np.array_equal(times[0], other) for other in times):
            turning.append(at)
            columns = zip(states[at], continued(np.stack(recorded[at], axis=-1)).T, strict=True)
            states[at] = [replace(each, times=times[0], values=column) for each, column in columns]
    return states + inputs, turning


def _interpolated(channel: Channel, times: Array) -> Array:
    good, slack = np.isfinite(channel.values), _SLACK * channel.period
    at, values = channel.times[good], channel.values[good]
    first = max(int(np.searchsorted(at, times[0] + slack, side="right")) - 1, 0)
    last = int(np.searchsorted(at, times[-1] - slack)) + 1
    at, values = at[first:last], values[first:last]
    if channel.angle:
        values = np.unwrap(values)
    states = np.interp(times, at, values)
    # Times of equal steps differ from recorded ones by rounding; the recorded value is then meant.
    after = np.clip(np.searchsorted(at, times), 0, len(at) - 1)
    for row in (after, np.maximum(after - 1, 0)):
        same = np.abs(at[row] - times) <= slack
        states[same] = values[row][same]
    return np.asarray(states)
