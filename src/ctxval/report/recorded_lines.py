"""Trajectories as data of the page: few points, compact numbers, and not more than a report may hold."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.texts import shortened, visible
from ctxval.report.context import ReportContext


@dataclass(frozen=True, eq=False)
class RecordedLines:
    """The lines of as many trials as fit, the worst first.

    Attributes:
        data: the lines, ready for JSON.
        kept: the numbers of the trials whose lines are in it.
        left_out: the numbers of those whose lines are not.
        points: the largest number of points of a line.
        thinned: whether a trajectory has more points than its line.
    """

    data: dict[str, Any]
    kept: tuple[int, ...]
    left_out: tuple[int, ...]
    points: int
    thinned: bool


def recorded_lines(context: ReportContext, most: int = 850_000) -> RecordedLines:
    """Return the lines of the trials, with fewer points or fewer trials if they have too many characters together."""
    numbers, points = list(context.recordings), 0
    lines: dict[int, dict[str, Any]] = {}
    for points in (200, 120, 70):
        lines, used = {}, 0
        for number in numbers:
            of_trial = lines_of(context, number, points)
            parts = [of_trial["t"], *of_trial["m"], *of_trial["e"], *of_trial.get("c", ()), *of_trial.get("r", ())]
            used += sum(len(part.get("data", "")) + 60 for part in parts if part)
            if used > most:
                break
            lines[number] = of_trial
        if len(lines) == len(numbers):
            break
    kinds = zip(("state", "input"), context.signals, strict=True)
    signals = [{"label": shortened(visible(name), 120), "kind": kind} for kind, names in kinds for name in names]
    longest = max((run.system.horizon + 1 for run in context.recordings.values()), default=0)
    data = {"signals": signals, "trials": {str(number): of_trial for number, of_trial in lines.items()}}
    return RecordedLines(data, tuple(lines), tuple(numbers[len(lines) :]), points, longest > points)


def lines_of(context: ReportContext, number: int, points: int) -> dict[str, Any]:
    """Return the lines of one trial: times, M, S minus M, corrected M minus M, and the reference.

    Differences are stored, because a small error of M would vanish in the steps of the values.
    """
    model, system = context.recordings[number].model, context.recordings[number].system
    rows: Rows = np.arange(system.horizon + 1)
    if len(rows) > points:  # evenly spread, and those of the largest error of each state
        peaks = np.abs(system.states - model.states).argmax(axis=0)
        rows = np.unique(np.concatenate([np.linspace(0, system.horizon, points).astype(np.intp), peaks]))
    inner = rows[rows < system.horizon]

    def columns(states: Array, inputs: Array) -> list[dict[str, Any]]:
        return [packed(column) for column in (*states[rows].T, *inputs[inner].T)]

    lines: dict[str, Any] = {
        "t": packed(system.times[rows]),
        "m": columns(model.states, model.inputs),
        "e": columns(system.states - model.states, system.inputs - model.inputs),
    }
    replay = context.replays.get(number)
    if replay is None:
        return lines
    corrected, reference = replay.corrected, replay.task.reference
    if corrected is not None and corrected.states.shape == model.states.shape:
        lines["c"] = columns(corrected.states - model.states, corrected.inputs - model.inputs)
    if reference.shape == model.states.shape:
        lines["r"] = [packed(column) if column.any() else None for column in reference[rows].T]
    return lines


def packed(values: Array) -> dict[str, Any]:
    """Return numbers ``(k,)`` as their smallest value, a step, and multiples of the step in 16 bits each as base64."""
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    step = (high - low) / 65_535
    if not (np.isfinite(step) and step > 0):
        return {"low": low if np.isfinite(low) else 0.0, "step": 0.0, "n": len(values)}
    levels = np.rint((values - low) / step).astype("<u2")
    return {"low": low, "step": step, "data": base64.b64encode(levels.tobytes()).decode()}
