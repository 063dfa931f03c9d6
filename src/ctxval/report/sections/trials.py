"""The trials: a table that can be sorted, the trajectories of each, and the five worst at once."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array
from ctxval._util.representation import call, counted
from ctxval._util.texts import parted
from ctxval.core.trial import Trial
from ctxval.report.charts import SMALL, Axis, Chart, small_charts
from ctxval.report.context import ReportContext
from ctxval.report.markup import cell, details, element, heading, joined, paragraph, quantity
from ctxval.report.recorded_lines import RecordedLines, recorded_lines

DATA = "trial-data"
"""Identifier of the element with the trajectories."""

_ROWS = 1000
"""Largest number of trials in the table: those with the largest distances, and those without a distance."""

_WORST = 5


class TrialsSection:
    """All trials, and what S and M did in them."""

    title = "Trials"

    def render(self, context: ReportContext) -> Markup:
        """Return the table, the place for one trial, its data, and the worst trials."""
        if not context.trials:
            return paragraph("There are no trials.")
        lines = recorded_lines(context)
        return joined(
            [
                _left_out(context, lines),
                _table(context, lines),
                element("div", id="trial", aria_live="polite", class_="needs-script"),
                data_element(DATA, lines.data),
                _worst(context),
            ]
        )

    __repr__ = call


def data_element(identifier: str, data: Any) -> Markup:
    """Return data for the page's script. The element is no script itself, and its content cannot end it."""
    plain = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        plain = plain.replace(character, f"\\u{ord(character):04x}")
    return element("script", Markup(plain), type="application/json", id=identifier)


def _left_out(context: ReportContext, lines: RecordedLines) -> Markup:
    sentences = []
    if lines.left_out:
        sentences.append(
            f"The page has the trajectories of {len(lines.kept)} of {len(context.trials)} trials. Those of "
            f"{len(lines.left_out)} trials with smaller distances are left out, so that the page stays small."
        )
    if lines.thinned:
        sentences.append(
            f"Each line has about {lines.points} of the recorded points; `ctxval export` writes all of them."
        )
    if not context.replays and context.missing:
        sentences.append("The corrected model is not drawn, because the experiment is not loaded.")
    elif context.replays:
        sentences.append("The corrected model in each trial is learned from the other trials.")
    return paragraph(" ".join(sentences)) if sentences else Markup("")


def _table(context: ReportContext, lines: RecordedLines) -> Markup:
    shown = [*context.worst_first, *(trial for trial in context.trials if trial.distance is None)][:_ROWS]
    headers = (
        *("trial", "distance", "state", "origin"),
        *context.space.labels,
        *("time [s]", "attempts", "remarks"),
    )
    heads = element("tr", *(element("th", label, scope="col") for label in headers))
    points = context.coordinates(shown)
    rows = [_row(trial, point, trial.number in lines.kept) for trial, point in zip(shown, points, strict=True)]
    caption = f"Trials, the largest distance first{'' if len(shown) == len(context.trials) else f' ({_ROWS} of them)'}"
    inside = element("caption", caption), element("thead", heads), element("tbody", *rows)
    whole = element("table", *inside, class_="sortable", id="trials")
    return element("div", whole, class_="scroll tall", tabindex="0", role="region", aria_label="Table of trials")


def _row(trial: Trial, point: Array, recorded: bool) -> Markup:
    first: object = trial.number
    if recorded:
        first = element(
            "button", str(trial.number), type="button", data_trial=trial.number, aria_label=f"Show trial {trial.number}"
        )
    remarks = "; ".join(filter(None, (trial.failure, trial.because)))
    values = (trial.distance, trial.state, trial.origin, *point.tolist(), trial.seconds, trial.attempts, remarks)
    head = element("th", cell(first) if recorded else cell(trial.number), scope="row", data_value=trial.number)
    return element("tr", head, *map(_cell, values))


def _cell(value: object) -> Markup:
    exact = repr(float(value)) if isinstance(value, int | float) else None
    return element("td", cell(value) if value != "" else "", data_value=exact)


def _worst(context: ReportContext) -> Markup:
    """Return the trajectories of the worst trials, drawn without a script."""
    worst = context.worst_tasks(_WORST, recorded=True)
    if not worst:
        return paragraph("No trajectories are recorded, so the worst tasks cannot be drawn.")
    parts = [heading(f"The {counted(len(worst), 'worst task')}")]
    for trial in worst:
        head = f"Trial {trial.number}: {quantity(trial.distance, context.labels.units)} at {task_of(context, trial)}"
        charts = small_charts(_signals(context, trial.number))
        parts.append(details(head, charts, opened=trial is worst[0]))
    return joined(parts)


def task_of(context: ReportContext, trial: Trial) -> str:
    """Return the task of a trial: its first parameters with their units."""
    values, labels = context.coordinates([trial])[0].tolist(), map(parted, context.space.labels)
    listed = [f"{name} = {quantity(value, unit)}" for (name, unit), value in zip(labels, values, strict=True)]
    return ", ".join(listed[:4]) + (f" and {len(listed) - 4} more" if len(listed) > 4 else "")


def _signals(context: ReportContext, number_: int) -> list[Chart]:
    """Return one chart for each state and input of a trial, those with the largest errors if they are many."""
    recording = context.recordings[number_]
    replay = context.replays.get(number_)
    corrected = None if replay is None else replay.corrected
    labels = [label for named in context.signals for label in named]
    of_model, of_system = ([*run.states.T, *run.inputs.T] for run in (recording.model, recording.system))
    n = recording.model.states.shape[-1]
    sizes = [
        float(np.abs(s - m).max(initial=0.0) / max(np.ptp(m), 1e-300)) for m, s in zip(of_model, of_system, strict=True)
    ]
    # Largest number of states and inputs that are drawn for each of the worst trials: those with the largest errors.
    chosen = sorted(np.argsort(sizes)[::-1][:10].tolist())
    drawn = []
    for j in chosen:
        lines = {"system": of_system[j], "model": of_model[j]}
        if corrected is not None:
            lines["corrected"] = corrected.states[:, j] if j < n else corrected.inputs[:, j - n]
        target = None if replay is None or j >= n else replay.task.reference[:, j]
        reference = target if target is not None and target.any() else None
        drawn.append(_signal(f"{labels[j]} in trial {number_}", labels[j], recording.system.times, lines, reference))
    return drawn


def _signal(title: str, label: str, times: Array, lines: dict[str, Array], reference: Array | None) -> Chart:
    every = [*lines.values(), *([] if reference is None else [reference])]
    chart = Chart(title, Axis("time [s]", float(times[0]), float(times[-1])), Axis.over(label, *every), **SMALL)
    if reference is not None:
        _thin(chart, times, reference, "reference", "reference")
    # The corrected model is drawn first, as a wide line, because it often coincides with S.
    for kind, name in (("corrected", "corrected model"), ("system", "system S"), ("model", "model M")):
        if kind in lines:
            _thin(chart, times, lines[kind], kind, name)
    return chart


def _thin(chart: Chart, times: Array, values: Array, kind: Any, name: str) -> None:
    # Number of points of a line of the worst trials.
    rows = np.unique(np.linspace(0, len(values) - 1, min(90, len(values))).astype(int))
    chart.line(times[: len(values)][rows], values[rows], kind, name)
