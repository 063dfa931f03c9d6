"""The distances in the order of the executions with the bound, and the time of each execution."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from ctxval._util.representation import call
from ctxval.report.charts import Axis, Chart
from ctxval.report.context import ReportContext
from ctxval.report.diagnostics import stored_predictions
from ctxval.report.markup import element, joined, number, paragraph


class ConvergenceSection:
    """How the search came to its worst task, and what the executions took."""

    title = "Convergence"

    def render(self, context: ReportContext) -> Markup:
        """Return the chart of the distances and the chart of the times."""
        chart = distances_in_order(context)
        if chart is None:
            return paragraph("No distance is known yet.")
        seconds = [trial.seconds for trial in context.trials if trial.seconds is not None]
        attempts, sentences = sum(trial.attempts for trial in context.trials), []
        if attempts > len(context.trials):
            sentences.append(f"{attempts} attempts were made in {len(context.trials)} trials.")
        if seconds:
            total, median = number(float(np.sum(seconds))), number(float(np.median(seconds)))
            sentences.append(f"The executions took {total} s, {median} s in the median.")
        spent = [paragraph(" ".join(sentences))] if sentences else []
        return joined([element("div", chart, _times(context), class_="charts"), *spent])

    __repr__ = call


def distances_in_order(context: ReportContext) -> Chart | None:
    """Return the distance of each trial and the largest one so far, with the limits; None if no distance is known."""
    if not context.completed:
        return None
    numbers = np.array([trial.number for trial in context.completed], dtype=np.float64)
    so_far = np.maximum.accumulate(context.distances)
    last = float(max(trial.number for trial in context.trials))
    limits = [value for value in (context.threshold, context.bound) if value is not None]
    beforehand = [(trial.number, prediction.median) for trial, prediction in stored_predictions(context)]
    chart = Chart(
        "Distance of each trial, and the largest one so far",
        _trial_axis(last),
        Axis.over(context.distance_label, context.distances, limits, zero=True),
    )
    risen = np.flatnonzero(np.diff(so_far, prepend=-1.0) > 0)  # the line is the same without all other points
    steps = np.repeat(numbers[risen], 2)[1:], np.repeat(so_far[risen], 2)[:-1]
    chart.line(np.append(steps[0], last), np.append(steps[1], so_far[-1]), "best", "largest so far")
    chart.limit(context.threshold, "threshold", "threshold").limit(context.bound, "bound", "bound on d*")
    names = [f"trial {trial.number}: {number(trial.distance)}" for trial in context.completed]
    if beforehand:
        at, expected = zip(*beforehand, strict=True)
        chart.marks(at, expected, "covering", "predicted before the execution")
    chart.marks(numbers, context.distances, "sample", "executed", names)
    failed = [float(trial.number) for trial in context.failed]
    if failed:
        where = np.full(len(failed), 0.03 * chart.y.ends[1])
        chart.marks(failed, where, "failed", "no distance is known")
    return chart


def _times(context: ReportContext) -> Chart | None:
    timed = [(trial.number, trial.seconds) for trial in context.trials if trial.seconds is not None]
    if not timed:
        return None
    numbers, seconds = np.array(timed, dtype=np.float64).T
    chart = Chart(
        "Time of each execution",
        _trial_axis(float(numbers.max())),
        Axis.over("time [s]", seconds, zero=True),
    )
    return chart.marks(numbers, seconds, "sample", "time of the execution")


def _trial_axis(last: float) -> Axis:
    return Axis("trial", -0.02 * max(last, 1.0), 1.02 * max(last, 1.0), whole=True)
