"""The page of ``ctxval replay``: what recordings show of a model, in the frame of every report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ctxval._util.files import write_text
from ctxval._util.representation import counted
from ctxval._util.texts import visible
from ctxval.replay import PredictedTask, ReplayReport, StepError
from ctxval.report.charts import SMALL, Axis, Chart, small_charts
from ctxval.report.markup import bar, bullets, details, joined, number, paragraph, percent, quantity, table
from ctxval.report.page import Rendered, SectionOf, framed, now, rendered_section

__all__ = ["replay_page", "write_replay_page"]

_CHARTED = 12
"""Largest number of states and inputs with charts of their own."""


class InsightsOfReplay:
    """What follows from the recordings, in sentences."""

    title = "What follows"

    def render(self, context: ReplayReport) -> Markup:
        """Return the sentences; a replay always has some, except of a model without any error."""
        if not context.insights:
            return paragraph("The model predicts these recordings, and nothing is unusual.")
        return bullets(_sentence(finding) for finding in context.insights)


class ErrorsOfReplay:
    """The errors of the prediction after one and several steps."""

    title = "Error of the prediction"

    def render(self, context: ReplayReport) -> Markup:
        """Return the table of errors, and a chart of the relative error over the number of steps for each state."""
        if not context.errors:
            return paragraph("No recording has a single step.")
        by_state = {state: [each for each in context.errors if each.state == state] for state in context.data.states}
        headers = (
            "State",
            "Steps",
            "RMS error",
            "Over the recordings",
            "95 % below",
            "Share of the change",
            "Diverged",
        )
        rows = [
            (
                error.state,
                error.steps,
                quantity(error.rms, error.unit),
                f"{number(error.lowest, 3)} to {number(error.highest, 3)}",
                number(error.upper, 3),
                percent(error.relative, 3) if np.isfinite(error.relative) else "more than any change",
                percent(error.diverged),
            )
            for errors in by_state.values()
            for error in errors
        ]
        meaning = (
            "A share of 100 % of the change is the error of a model that predicts no change. The errors are those of "
            "recordings that the model has not seen, unless it has seen all of them."
        )
        charts = [_error_chart(errors) for errors in by_state.values() if len(errors) > 1][:_CHARTED]
        return joined(
            [
                paragraph(meaning),
                *([small_charts(charts)] if charts else []),
                table("Errors after one and several steps", headers, rows),
            ]
        )


class RegionsOfReplay:
    """Where in state and input the one-step error is large."""

    title = "Where the error is large"

    def render(self, context: ReplayReport) -> Markup:
        """Return a chart for each state and input, and the table behind them."""
        if not context.regions:
            return paragraph("There are too few recorded steps to divide them into regions.")
        names = list(dict.fromkeys(region.variable for region in context.regions))
        charts = [_region_chart(context, name) for name in names[:_CHARTED]]
        rows = [
            (
                _named(region.variable, region.unit),
                f"{number(region.low)} to {number(region.high)}",
                region.count,
                region.ratio,
            )
            for region in context.regions
        ]
        headers = ("State or input", "Between", "Steps", "Error, as a multiple of the average")
        meaning = (
            "Each state and input is divided into ranges with equally many steps. The error is that of one step over "
            "all states, divided by its average over all recorded steps."
        )
        numbers = details("All regions", table("One-step error in each region", headers, rows))
        return joined([paragraph(meaning), small_charts(charts), numbers])


class ResidualsOfReplay:
    """How much of the error a better model could explain."""

    title = "What a better model could explain"

    def render(self, context: ReplayReport) -> Markup:
        """Return the table of shares."""
        if not context.residuals:
            return paragraph("There are too few recorded steps to tell.")
        headers = (
            *("State", "RMS residual", "Explained by state and input", "By an affine function"),
            *("RMS of the rest", "Rest explained by the step before"),
        )
        rows = [
            (
                residual.state,
                quantity(residual.rms, residual.unit),
                _bar(residual.explained),
                _bar(residual.linear),
                quantity(residual.rest, residual.unit),
                _bar(residual.history),
            )
            for residual in context.residuals
        ]
        meaning = (
            "All shares are of the mean square of the one-step residual, measured on held-out recordings. A large "
            "share of the step before shows a state that is not recorded, a delay, or filtered measurements."
        )
        return joined([paragraph(meaning), table("One-step residual", headers, rows)])


class TasksOfReplay:
    """What the recordings predict of the tasks of an experiment.

    Args:
        units: the units of the distance.
    """

    title = "Tasks"

    def __init__(self, units: str = "") -> None:
        self.units = units

    def render(self, context: ReplayReport) -> Markup:
        """Return the worst tasks and the executions that would tell most; no execution has tested them."""
        tasks = context.tasks
        if tasks is None:
            return paragraph("Nothing is predicted of tasks: give an experiment with --experiment.")
        bound = (
            f"The largest distance over all tasks is {quantity(tasks.median, self.units)} in the median of "
            f"{tasks.draws} draws of the dynamics, and at most {quantity(tasks.upper, self.units)} in 95 % of them. "
            "No execution has tested this, and it is no verdict."
        )
        numbers = np.arange(1.0, len(tasks.worst) + 1)
        low, median, high = (
            np.array([getattr(recording, name) for recording in tasks.worst]) for name in ("low", "median", "high")
        )
        label = f"distance [{self.units}]" if self.units else "distance"
        axes = Axis("task in the table below", 0.5, len(numbers) + 0.5), Axis.over(label, high, zero=True)
        chart = Chart("Predicted distances of the worst tasks, with 90 % of the draws", *axes)
        chart.whiskers(numbers, low, high, "corrected").marks(numbers, median, "corrected", "predicted")
        left = paragraph(f"No controller can be designed for {percent(tasks.unplanned)} of the tasks.")
        return joined(
            [
                paragraph(bound),
                *([left] if tasks.unplanned else []),
                chart,
                self._table("Tasks with the largest predicted distances", tasks.worst),
                self._table("Executions that would tell most of the largest distance", tasks.executions),
            ]
        )

    def _table(self, caption: str, tasks: Sequence[PredictedTask]) -> Markup:
        resolved = any(task.resolved is not None for task in tasks)
        headers = ("Number", "Task", "Distance", "90 % between", *(("Resolved",) if resolved else ()))
        rows = [
            (
                str(row),
                ", ".join(f"{name} = {number(value)}" for name, value in task.parameters.items()),
                quantity(task.median, self.units),
                f"{number(task.low)} and {number(task.high)}",
                *((percent(task.resolved or 0.0),) if resolved else ()),
            )
            for row, task in enumerate(tasks, 1)
        ]
        return table(caption, headers, rows)


class RecordingsOfReplay:
    """The recordings, how they were read and where they were split."""

    title = "Recordings"

    def render(self, context: ReplayReport) -> Markup:
        """Return the sizes, the sources and the splits."""
        data = context.data
        named = [_named(name, unit) for name, unit in data.states.items()]
        inputs = [_named(name, unit) for name, unit in data.inputs.items()]
        rows: list[tuple[str, object]] = [
            ("Recordings", data.recordings),
            ("Steps", data.steps),
            ("Time step", quantity(data.dt, "s")),
            ("Duration", quantity(data.steps * data.dt, "s")),
            ("States", ", ".join(named)),
            ("Inputs", ", ".join(inputs) or "none"),
            ("Recordings that the model was learned from", data.seen),
        ]
        splits = [str(split) for split in data.breaks]
        return joined(
            [
                table("The recordings", ("Quantity", "Value"), rows, class_="facts"),
                *([paragraph("How they were read:"), bullets(map(_sentence, data.notes))] if data.notes else []),
                details(f"{counted(len(data.sources), 'source')}", bullets(_cut(data.sources))),
                *([details(f"{counted(len(splits), 'split')}", bullets(_cut(splits)))] if splits else []),
            ]
        )


def replay_page(report: ReplayReport, *, name: str = "", units: str = "") -> str:
    """Return what recordings show of a model as one HTML page, which opens no connection."""
    sections: tuple[SectionOf[ReplayReport], ...] = (
        InsightsOfReplay(),
        ErrorsOfReplay(),
        RegionsOfReplay(),
        ResidualsOfReplay(),
        *((TasksOfReplay(units),) if report.tasks is not None else ()),
        RecordingsOfReplay(),
    )
    with np.errstate(all="ignore"):  # recordings may have any numbers
        rendered: list[Rendered] = [rendered_section(section, report) for section in sections]
    count = counted(report.data.recordings, "recording")
    title = f"Recordings replayed on {visible(name) or 'a model'}"
    return framed(title, f"{count} compared with the model; nothing was executed; report made {now()}.", rendered)


def write_replay_page(report: ReplayReport, path: str | Path, *, name: str = "", units: str = "") -> Path:
    """Write :func:`replay_page` as one file, and return its path."""
    return write_text(path, replay_page(report, name=name, units=units))


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}." if words else ""


def _named(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _cut(lines: Sequence[str]) -> list[str]:
    more = [f"and {len(lines) - 20} others; --json lists them"] if len(lines) > 20 else []
    return [*lines[:20], *more]


def _bar(share: float) -> Markup:
    return joined([percent(share, 3), bar(min(max(share, 0.0), 1.0))])


def _error_chart(errors: Sequence[StepError]) -> Chart:
    """Return the root mean square error of one state over the number of steps, with the spread over recordings."""
    steps = np.array([float(error.steps) for error in errors])
    rms, low, high, change = (
        np.array([getattr(error, k) for error in errors]) for k in ("rms", "lowest", "highest", "change")
    )
    first = errors[0]
    x, y = Axis.over("steps", steps, room=0.03), Axis.over(_named(first.state, first.unit), high, rms, zero=True)
    chart = Chart(f"Error of {first.state} after a number of steps", x, y, **SMALL)
    chart.whiskers(steps, low, high, "model").line(steps, rms, "model", "error, with its range over the recordings")
    # Far above the error, the change would only make the error invisible.
    if (change <= 3 * np.nanmax(np.append(high, rms))).all():
        chart.line(steps, change, "reference", "change: the error of predicting no change")
    return chart.marks(steps, rms, "mean", "", [f"{error.steps} steps: {number(error.rms)}" for error in errors])


def _region_chart(context: ReplayReport, name: str) -> Chart:
    """Return the error in the ranges of one state or input, as steps."""
    own = [region for region in context.regions if region.variable == name]
    across = np.repeat([own[0].low, *(region.high for region in own)], 2)[1:-1]
    up = np.repeat([region.ratio for region in own], 2)
    everywhere = [region.ratio for region in context.regions]
    x = Axis.over(_named(name, own[0].unit), across, room=0.02)
    y = Axis.over("error / average", everywhere, [1.2], zero=True)
    chart = Chart(f"One-step error over {name}", x, y, **SMALL)
    chart.line(x.ends, [1.0, 1.0], "reference", "average")
    return chart.line(across, up, "model", "one-step error")
