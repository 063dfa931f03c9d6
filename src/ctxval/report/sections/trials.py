"""The trials: a table that can be sorted, the trajectories of each as data of the page, and the five worst at once."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import counted
from ctxval._util.texts import parted, shortened, visible
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.report.charts import SMALL, Axis, Chart, Kind, small_charts
from ctxval.report.context import ReportContext
from ctxval.report.markup import cell, details, element, heading, joined, paragraph, quantity, table

_ROWS = 1000  # largest number of trials in the table

_LINES = {"reference": "reference", "corrected": "corrected model", "system": "system S", "model": "model M"}


def trials(context: ReportContext) -> Markup:
    """Return the table of all trials, the place for one trial, its data, and the worst trials."""
    if not context.trials:
        return paragraph("There are no trials.")
    data, points = recorded_lines(context)
    kept, notes = data["trials"], list[str]()
    if left_out := len(context.recordings) - len(kept):
        notes.append(
            f"The page has the trajectories of {len(kept)} of {len(context.trials)} trials. Those of {left_out} trials "
            "with smaller distances are left out, so that the page stays small."
        )
    if any(run.system.horizon + 1 > points for run in context.recordings.values()):
        notes.append(f"Each line has about {points} of the recorded points; `ctxval export` writes all of them.")
    if not context.replays and context.missing:
        notes.append("The corrected model is not drawn, because the experiment is not loaded.")
    elif context.replays:
        notes.append("The corrected model in each trial is learned from the other trials.")
    # Data for the page's script: the element is no script itself, and its content cannot end it.
    plain = json.dumps(data, allow_nan=False, separators=(",", ":"))
    escaped = Markup(plain.translate({ord(character): f"\\u{ord(character):04x}" for character in "<>&"}))
    # Those with the largest distances, and those without a distance.
    shown = [*context.worst_first, *(trial for trial in context.trials if trial.distance is None)][:_ROWS]
    headers = ("trial", "distance", "state", "origin", *context.task_labels, "time [s]", "attempts", "remarks")
    tasks = zip(shown, context.tasks_of(shown), strict=True)
    rows = [_row(trial, task, str(trial.number) in kept) for trial, task in tasks]
    caption = f"Trials, the largest distance first{'' if len(shown) == len(context.trials) else f' ({_ROWS} of them)'}"
    worst = context.worst_tasks(recorded=True)
    drawn = [heading(f"The {counted(len(worst), 'worst task')}")]
    for trial in worst:
        head = f"Trial {trial.number}: {quantity(trial.distance, context.labels.units)} at {task_of(context, trial)}"
        drawn.append(details(head, small_charts(signals_of(context, trial.number)), opened=trial is worst[0]))
    without = paragraph("No trajectories are recorded, so the worst tasks cannot be drawn.")
    parts = [paragraph(" ".join(notes))] if notes else []
    parts += [
        table(caption, headers, rows, "sortable", id_="trials", label="Table of trials", scroll="scroll tall"),
        element("div", id="trial", aria_live="polite", class_="needs-script"),
        element("script", escaped, type="application/json", id="trial-data"),
    ]
    return joined([*parts, *(drawn if worst else [without])])


def _row(trial: Trial, task: list[float | str], recorded: bool) -> Markup:
    number, shows = trial.number, f"Show trial {trial.number}"
    button = element("button", str(number), type="button", data_trial=number, aria_label=shows) if recorded else number
    remarks = "; ".join(filter(None, (trial.failure, trial.because)))
    values = (trial.distance, trial.state, trial.origin, *task, trial.seconds, trial.attempts, remarks)
    cells = [element("th", cell(button), scope="row", data_value=number)]
    for value in values:
        exact = repr(float(value)) if isinstance(value, int | float) else None
        cells.append(element("td", cell(value), data_value=exact))
    return element("tr", *cells)


def task_of(context: ReportContext, trial: Trial) -> str:
    """Return the task of a trial: its first parameters with their units."""
    values, labels = context.tasks_of([trial])[0], map(parted, context.task_labels)
    listed = [f"{name} = {quantity(value, unit)}" for (name, unit), value in zip(labels, values, strict=True)]
    return ", ".join(listed[:4]) + (f" and {len(listed) - 4} more" if len(listed) > 4 else "")


def signals_of(context: ReportContext, trial: int) -> list[Chart]:
    """Return one chart for each state and input of a trial, those with the largest errors if they are many."""
    pair, replay = context.recordings[trial], context.replays.get(trial)
    corrected = None if replay is None else replay.corrected
    # The corrected model is drawn first, as a wide line, because it often coincides with S.
    runs: dict[Kind, Trajectory | None] = {"corrected": corrected, "system": pair.system, "model": pair.model}
    signals = {kind: [*run.states.T, *run.inputs.T] for kind, run in runs.items() if run is not None}
    labels, times = [label for names in context.signals for label in names], pair.system.times
    errors = [
        float(np.abs(s - m).max(initial=0.0) / max(np.ptp(m), 1e-300))
        for m, s in zip(signals["model"], signals["system"], strict=True)
    ]
    charts = []
    for j in sorted(np.argsort(errors)[::-1][:10].tolist()):
        lines = {name: values[j] for name, values in signals.items()}
        if replay is not None and j < pair.model.states.shape[-1] and replay.task.reference[:, j].any():
            lines = {"reference": replay.task.reference[:, j], **lines}
        x, y = Axis("time [s]", float(times[0]), float(times[-1])), Axis.over(labels[j], *lines.values())
        chart = Chart(f"{labels[j]} in trial {trial}", x, y, **SMALL)
        for kind, values in lines.items():
            rows = np.unique(np.linspace(0, len(values) - 1, min(90, len(values))).astype(int))
            chart.line(times[: len(values)][rows], values[rows], kind, _LINES[kind])
        charts.append(chart)
    return charts


def recorded_lines(context: ReportContext, most: int = 850_000) -> tuple[dict[str, Any], int]:
    """Return the lines of as many trials as fit, ready for JSON, the worst first, and the largest number of points."""
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
    return {"signals": signals, "trials": {str(number): of_trial for number, of_trial in lines.items()}}, points


def lines_of(context: ReportContext, number: int, points: int) -> dict[str, Any]:
    """Return the lines of one trial: times, M, the differences of S and corrected M from M, and the reference."""
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
