"""Trajectories as data of the page: few points, compact numbers, and not more than a report may hold."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.texts import shortened, visible
from ctxval.report.context import Recording, ReportContext

MOST_CHARACTERS = 850_000
"""Largest number of characters of all lines together; a report stays below 1.5 MB."""

_POINTS = (200, 120, 70)
"""Numbers of points of a line that are tried, until the lines of all trials fit."""


@dataclass(frozen=True, eq=False)
class RecordedLines:
    """The lines of as many trials as fit, the worst first, ready for JSON.

    Attributes:
        kept, left_out: the numbers of the trials whose lines are in the data, and of those whose are not.
        points: the largest number of points of a line.
        thinned: whether a trajectory has more points than its line.
    """

    data: dict[str, Any]
    kept: tuple[int, ...]
    left_out: tuple[int, ...]
    points: int
    thinned: bool


def recorded_lines(context: ReportContext, most: int = MOST_CHARACTERS) -> RecordedLines:
    """Return the lines of the trials, with fewer points or fewer trials if they would be too many."""
    numbers, points = list(context.recordings), _POINTS[0]
    found: dict[int, dict[str, Any]] = {}
    for points in _POINTS:
        found = _fitting(context, points, most)
        if len(found) == len(numbers):
            break
    longest = max((recording.system.horizon + 1 for recording in context.recordings.values()), default=0)
    states, inputs = context.signals
    signals = [
        {"label": shortened(visible(label), 120), "kind": kind}
        for kind, labels in (("state", states), ("input", inputs))
        for label in labels
    ]
    return RecordedLines(
        {"signals": signals, "trials": {str(number): one for number, one in found.items()}},
        tuple(found),
        tuple(numbers[len(found) :]),
        points,
        longest > points,
    )


def _fitting(context: ReportContext, points: int, most: int) -> dict[int, dict[str, Any]]:
    """Return the lines of the worst trials, as many as fit into a number of characters."""
    found: dict[int, dict[str, Any]] = {}
    used = 0
    for number in context.recordings:
        lines = lines_of(context, number, points)
        used += _size(lines)
        if used > most:
            break
        found[number] = lines
    return found


def lines_of(context: ReportContext, number: int, points: int) -> dict[str, Any]:
    """Return the lines of one trial: times, M, S minus M, corrected M minus M, and the reference.

    Differences are stored, because a small error of M would vanish in the steps of the values.
    """
    recording = context.recordings[number]
    replay = context.replays.get(number)
    rows = _rows(recording, points)
    inner = rows[rows < recording.system.horizon]
    lines: dict[str, Any] = {
        "t": packed(recording.system.times[rows]),
        "m": [*_columns(recording.model.states[rows]), *_columns(recording.model.inputs[inner])],
        "e": [
            *_columns((recording.system.states - recording.model.states)[rows]),
            *_columns((recording.system.inputs - recording.model.inputs)[inner]),
        ],
    }
    corrected = None if replay is None else replay.corrected
    if corrected is not None and corrected.states.shape == recording.model.states.shape:
        lines["c"] = [
            *_columns((corrected.states - recording.model.states)[rows]),
            *_columns((corrected.inputs - recording.model.inputs)[inner]),
        ]
    if replay is not None and replay.task.reference.shape == recording.model.states.shape:
        reference = replay.task.reference
        lines["r"] = [packed(column) if column.any() else None for column in reference[rows].T]
    return lines


def _rows(recording: Recording, points: int) -> Rows:
    """Return the rows of a trajectory that are drawn: evenly spread, and those of the largest error of each state."""
    length = recording.system.horizon + 1
    if length <= points:
        return np.arange(length)
    errors = np.abs(recording.system.states - recording.model.states)
    peaks = errors.argmax(axis=0)
    return np.unique(np.concatenate([np.linspace(0, length - 1, points).astype(np.intp), peaks]))


def _columns(values: Array) -> list[dict[str, Any]]:
    return [packed(column) for column in values.T]


def packed(values: Array) -> dict[str, Any]:
    """Return numbers ``(k,)`` as their smallest value, a step, and multiples of the step in 16 bits each as base64."""
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    # Number of steps of a value between the smallest and the largest one of its line.
    step = (high - low) / 65_535
    if not (np.isfinite(step) and step > 0):
        return {"low": low if np.isfinite(low) else 0.0, "step": 0.0, "n": len(values)}
    levels = np.rint((values - low) / step).astype("<u2")
    return {"low": low, "step": step, "data": base64.b64encode(levels.tobytes()).decode()}


def _size(lines: dict[str, Any]) -> int:
    every = [lines["t"], *lines["m"], *lines["e"], *lines.get("c", ()), *filter(None, lines.get("r", ()))]
    return sum(len(one.get("data", "")) + 60 for one in every)
