"""The page of ``ctxval replay``: what recordings show of a model, in the frame of every report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ctxval._util.files import write_text
from ctxval._util.representation import counted
from ctxval._util.texts import visible
from ctxval.core.labels import labels_of
from ctxval.report.charts import SMALL, Axis, Chart, small_charts
from ctxval.report.markup import bar, bullets, details, joined, number, paragraph, percent, quantity, sentence, table
from ctxval.report.page import framed, now
from ctxval.studies.replay import PredictedTask, PredictedTasks, ReplayReport, StepError

_CHARTED = 12  # largest number of states and inputs with charts of their own


def replay_page(report: ReplayReport, *, name: str = "", units: str = "") -> str:
    """Return what recordings show of a model as one HTML page, which opens no connection."""
    tasks, none = report.tasks, paragraph("The model predicts these recordings, and nothing is unusual.")
    follows = bullets(f"{sentence(words)}." for words in report.insights) if report.insights else none
    sections: list[tuple[str, Callable[[], object]]] = [
        ("What follows", lambda: follows),
        ("Error of the prediction", lambda: _errors(report)),
        ("Where the error is large", lambda: _regions(report)),
        ("What a better model could explain", lambda: _residuals(report)),
        *([] if tasks is None else [("Tasks", lambda: _tasks(tasks, units))]),
        ("Recordings", lambda: _recordings(report)),
    ]
    count = counted(report.data.recordings, "recording")
    title = f"Recordings replayed on {visible(name) or 'a model'}"
    return framed(title, f"{count} compared with the model; nothing was executed; report made {now()}.", sections)


def write_replay_page(report: ReplayReport, path: str | Path, *, name: str = "", units: str = "") -> Path:
    """Write :func:`replay_page` as one file, and return its path."""
    return write_text(path, replay_page(report, name=name, units=units))


def _errors(report: ReplayReport) -> Markup:
    if not report.errors:
        return paragraph("No recording has a single step.")
    by_state = {state: [error for error in report.errors if error.state == state] for state in report.data.states}
    rows = []
    for error in (error for errors in by_state.values() for error in errors):
        spread = f"{number(error.lowest, 3)} to {number(error.highest, 3)}"
        share = percent(error.relative, 3) if np.isfinite(error.relative) else "more than any change"
        sizes = (quantity(error.rms, error.unit), spread, number(error.upper, 3), share)
        rows.append((error.state, error.steps, *sizes, percent(error.diverged)))
    headers = ("State", "Steps", "RMS error", "Over the recordings", "95 % below", "Share of the change", "Diverged")
    meaning = (
        "A share of 100 % of the change is the error of a model that predicts no change. The errors are those of "
        "recordings that the model has not seen, unless it has seen all of them."
    )
    charts = [_error_chart(errors) for errors in by_state.values() if len(errors) > 1][:_CHARTED]
    drawn = [small_charts(charts)] if charts else []
    return joined([paragraph(meaning), *drawn, table("Errors after one and several steps", headers, rows)])


def _regions(report: ReplayReport) -> Markup:
    if not report.regions:
        return paragraph("There are too few recorded steps to divide them into regions.")
    names = list(dict.fromkeys(region.variable for region in report.regions))
    rows = []
    for region in report.regions:
        (label,), between = labels_of({region.variable: region.unit}), f"{number(region.low)} to {number(region.high)}"
        rows.append((label, between, region.count, region.ratio))
    headers = ("State or input", "Between", "Steps", "Error, as a multiple of the average")
    meaning = (
        "Each state and input is divided into ranges with equally many steps. The error is that of one step over all "
        "states, divided by its average over all recorded steps."
    )
    numbers = details("All regions", table("One-step error in each region", headers, rows))
    charts = small_charts([_region_chart(report, name) for name in names[:_CHARTED]])
    return joined([paragraph(meaning), charts, numbers])


def _residuals(report: ReplayReport) -> Markup:
    if not report.residuals:
        return paragraph("There are too few recorded steps to tell.")

    def share(value: float) -> Markup:
        return joined([percent(value, 3), bar(min(max(value, 0.0), 1.0))])

    explained = ("Explained by state and input", "By an affine function")
    headers = ("State", "RMS residual", *explained, "RMS of the rest", "Rest explained by the step before")
    rows = []
    for state in report.residuals:
        rms, rest = quantity(state.rms, state.unit), quantity(state.rest, state.unit)
        rows.append((state.state, rms, share(state.explained), share(state.linear), rest, share(state.history)))
    meaning = (
        "All shares are of the mean square of the one-step residual, measured on held-out recordings. A large share of "
        "the step before shows a state that is not recorded, a delay, or filtered measurements."
    )
    return joined([paragraph(meaning), table("One-step residual", headers, rows)])


def _tasks(tasks: PredictedTasks, units: str) -> Markup:
    bound = (
        f"The largest distance over all tasks is {quantity(tasks.median, units)} in the median of {tasks.draws} "
        f"posterior samples of the dynamics, and at most {quantity(tasks.upper, units)} in 95 % of them. No execution "
        "has tested this, and it is no verdict."
    )
    left = f"No controller can be designed for {percent(tasks.unplanned)} of the tasks."
    numbers = np.arange(1.0, len(tasks.worst) + 1)
    low, median, high = (np.array([getattr(task, name) for task in tasks.worst]) for name in ("low", "median", "high"))
    label = f"distance [{units}]" if units else "distance"
    axes = Axis("task in the table below", 0.5, len(tasks.worst) + 0.5), Axis.over(label, high, zero=True)
    chart = Chart("Predicted distances of the worst tasks, with 90 % of the samples", *axes)
    chart.whiskers(numbers, low, high, "corrected").marks(numbers, median, "corrected", "predicted")
    worst = _task_table("Tasks with the largest predicted distances", tasks.worst, units)
    telling = _task_table("Executions that would tell most of the largest distance", tasks.executions, units)
    return joined([paragraph(bound), *([paragraph(left)] if tasks.unplanned else []), chart, worst, telling])


def _task_table(caption: str, tasks: Sequence[PredictedTask], units: str) -> Markup:
    headers = ["Number", "Task", "Distance", "90 % between"]
    if any(task.resolved is not None for task in tasks):
        headers.append("Resolved")
    rows = []
    for row, task in enumerate(tasks, 1):
        parameters = ", ".join(f"{name} = {number(value)}" for name, value in task.parameters.items())
        interval = f"{number(task.low)} and {number(task.high)}"
        cells = [str(row), parameters, quantity(task.median, units), interval, percent(task.resolved or 0.0)]
        rows.append(cells[: len(headers)])
    return table(caption, headers, rows)


def _recordings(report: ReplayReport) -> Markup:
    data = report.data
    rows: list[tuple[str, object]] = [
        ("Recordings", data.recordings),
        ("Steps", data.steps),
        ("Time step", quantity(data.dt, "s")),
        ("Duration", quantity(data.steps * data.dt, "s")),
        ("States", ", ".join(labels_of(data.states))),
        ("Inputs", ", ".join(labels_of(data.inputs)) or "none"),
        ("Recordings that the model was learned from", data.seen),
    ]
    parts = [table("The recordings", ("Quantity", "Value"), rows, class_="facts")]
    if data.notes:
        parts += [paragraph("How they were read:"), bullets(f"{sentence(words)}." for words in data.notes)]
    for name, lines in ("source", list(data.sources)), ("split", [str(gap) for gap in data.breaks]):
        more = [f"and {len(lines) - 20} others; --json lists them"] if len(lines) > 20 else []
        if lines:
            parts.append(details(counted(len(lines), name), bullets([*lines[:20], *more])))
    return joined(parts)


def _error_chart(errors: Sequence[StepError]) -> Chart:
    steps = np.array([float(error.steps) for error in errors])
    names = ("rms", "lowest", "highest", "change")
    rms, low, high, change = (np.array([getattr(error, name) for error in errors]) for name in names)
    first = errors[0]
    (label,) = labels_of({first.state: first.unit})
    x, y = Axis.over("steps", steps, room=0.03), Axis.over(label, high, rms, zero=True)
    chart = Chart(f"Error of {first.state} after a number of steps", x, y, **SMALL)
    chart.whiskers(steps, low, high, "model").line(steps, rms, "model", "error, with its range over the recordings")
    # Far above the error, the change would only make the error invisible.
    if (change <= 3 * np.nanmax(np.append(high, rms))).all():
        chart.line(steps, change, "reference", "change: the error of predicting no change")
    return chart.marks(steps, rms, "mean", "", [f"{error.steps} steps: {number(error.rms)}" for error in errors])


def _region_chart(report: ReplayReport, name: str) -> Chart:
    parts = [region for region in report.regions if region.variable == name]
    across = np.repeat([parts[0].low, *(region.high for region in parts)], 2)[1:-1]
    up = np.repeat([region.ratio for region in parts], 2)
    everywhere = [region.ratio for region in report.regions]
    x = Axis.over(*labels_of({name: parts[0].unit}), across, room=0.02)
    y = Axis.over("error / average", everywhere, [1.2], zero=True)
    chart = Chart(f"One-step error over {name}", x, y, **SMALL)
    chart.line(x.ends, [1.0, 1.0], "reference", "average")
    return chart.line(across, up, "model", "one-step error")
