"""The distance over the tasks, as a curve, a map or slices, and in the order of execution."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array
from ctxval._util.progress import stage
from ctxval.core.trial import Trial
from ctxval.report.charts import SMALL, Axis, Chart, Kind, colour_scale, small_charts
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import Band, DistanceModel, distance_of
from ctxval.report.findings import stored_predictions
from ctxval.report.markup import bar, element, heading, joined, number, paragraph, percent, table

_CURVE, _GRID = 121, 32  # number of points of a curve, and of each side of a map

_ORIGINS: tuple[tuple[Kind, str, tuple[str, ...]], ...] = (
    ("initial", "initial, drawn as a test or chosen by a person", ("iid", "spread", "initial", "manual")),
    ("covering", "chosen to decide the verdict", ("covering",)),
    ("sample", "chosen by the search", ("acquisition",)),
)


def distances(context: ReportContext) -> Markup:
    """Return the distance over the tasks: the charts that suit the number of parameters, and the sensitivity."""
    model = context.distance_model
    if model is None:
        return paragraph("Fewer than two distances are known, so no picture of the distance can be drawn.")
    predicted = _predicted(context, model)
    # The distance over one parameter is on the first screen; a suite has no tasks between its own.
    if context.space.dimension == 1 or context.suite is not None:
        parts = [element("div", predicted, class_="charts")]
    else:
        caption = (
            "Sensitivity of the distance: the share of each parameter in the variance of the predicted distance, alone "
            "and together with others (total Sobol index)"
        )
        shares = ((context.space.labels[j], float(model.sensitivity[j])) for j in model.influence)
        rows = ((label, percent(share), bar(share)) for label, share in shares)
        second = element("div", table(caption, ("Parameter", "Share", "Bar"), rows), predicted, class_="charts")
        note = "Lines, bands and maps are pictures of what the trials suggest, and no certificate."
        parts = [paragraph(note), *_over_space(context, model), second]
    return joined([*parts, *_region(context)])


def _over_space(context: ReportContext, model: DistanceModel) -> list[Markup]:
    """Return a map with two slices if there are two parameters, otherwise a slice for each."""
    d = context.space.dimension
    if d == 2:
        values = (_estimated(context, _grid_of_tasks()) or model.predict(_grid_of_tasks())).median
        values = np.nan_to_num(values, nan=float(context.distances.max()))
        title = "Map of the distance over the two parameters, with the executed tasks"
        drawn = _map(context, title, values, context.distance_label)
        return [element("div", drawn, *(_slice(context, axis) for axis in range(2)), class_="charts")]
    axes = model.influence[:12]
    rest = f"{d - len(axes)} parameters with less influence have no slice here."
    slices = filter(None, (_slice(context, axis, small=True) for axis in axes))
    parts = [heading("Slices through the worst task"), small_charts(list(slices))]
    return parts if d == len(axes) else [paragraph(rest), *parts]


def _estimated(context: ReportContext, unit: Array) -> Band | None:
    """Return the distances at points of the unit cube by the learned dynamics, or by a Gaussian process with a band.

    That is the one which predicts the executed distances better, each from the other trials.
    """
    model, learned = context.distance_model, context.provenance.learned
    if learned is None or not (context.batched or context.space.dimension == 1):
        return None if model is None else model.predict(unit)
    errors = np.array([replay.distance - context.recordings[k].distance for k, replay in context.replays.items()])
    if model is None or (errors**2).mean() <= ((model.left_out.median - model.values) ** 2).mean():
        try:
            with stage("predicting distances", len(unit), "tasks"):
                values = learned.expected(unit, len(context.trials))
            if np.isfinite(values).any():
                return Band(values, values, values)
        except Exception:  # the user's parts, at states that no execution has reached, must not end a report
            pass
    return None if model is None else model.predict(unit)


def distance_over_task(context: ReportContext) -> Chart | None:
    """Return the distance over the only parameter with the executed tasks; None if too few distances are known."""
    return _slice(context, 0) if context.worst_first else None


def _slice(context: ReportContext, axis: int, *, small: bool = False) -> Chart | None:
    """Return the distance along one parameter, through the worst executed task; None if it cannot be estimated."""
    space, worst = context.space, context.worst_first[0]
    # Designs that cannot be made in a batch take long.
    count = _CURVE if context.batched or context.validation is None else 31
    unit = np.tile(worst.unit_point, (count, 1))
    unit[:, axis] = np.linspace(0, 1, count)
    x, band = space.from_unit(unit)[:, axis], _estimated(context, unit)
    if band is None:
        return None
    title = f"Distance over {space.labels[axis]}" + (
        "" if space.dimension == 1 else ", through the worst executed task"
    )
    limits = [limit for limit in (context.threshold, context.bound) if limit is not None]
    # A threshold far above all distances would flatten the curve, so it may lie outside.
    top = 3 * max(float(context.distances.max()), float(np.nanmax(band.median)))
    shown = [value for value in limits if value <= top or top == 0]
    high = np.minimum(band.high, max(top, *shown, 1e-300))
    y = Axis.over(context.distance_label, context.distances, high, shown, zero=True)
    chart = Chart(title, _parameter_axis(context, axis), y, **(SMALL if small else {}))
    if band.low is band.high:
        chart.line(x, band.median, "mean", "predicted by the learned dynamics")
    else:
        chart.band(x, band.low, band.high, "95 % band").line(x, band.median, "mean", "Gaussian process of the distance")
    chart.limit(context.threshold, "threshold", "threshold").limit(context.bound, "bound", "bound on d*")
    if space.dimension == 1:
        _add_trials(chart, context, 0)
    _add_marks(chart, context, [worst], (axis, None), "worst", "worst executed task")
    return chart


def _parameter_axis(context: ReportContext, axis: int) -> Axis:
    space = context.space
    return Axis(space.labels[axis], float(space.low[axis]), float(space.high[axis]))


def _add_trials(chart: Chart, context: ReportContext, x: int, y: int | None = None) -> None:
    """Add all tasks at their parameters x and y, or at their distances, with a mark for each origin."""
    for kind, label, origins in _ORIGINS:
        trials = [trial for trial in context.completed if trial.origin in origins]
        _add_marks(chart, context, trials, (x, y), kind, label)
    _add_marks(chart, context, list(context.failed), (x, y), "failed", "no distance is known")


def _add_marks(
    chart: Chart, context: ReportContext, trials: list[Trial], axes: tuple[int, int | None], kind: Kind, label: str
) -> None:
    if not trials:
        return
    at, (x, y) = context.coordinates(trials), axes
    distances = [0.03 * chart.y.ends[1] if trial.distance is None else trial.distance for trial in trials]
    known = ("no distance" if trial.distance is None else number(trial.distance) for trial in trials)
    names = [f"trial {trial.number}: {distance}" for trial, distance in zip(trials, known, strict=True)]
    chart.marks(at[:, x], distances if y is None else at[:, y], kind, label, names)


def _grid_of_tasks() -> Array:
    """Return the tasks of a map, points of the unit cube ``(_GRID**2, 2)``."""
    side = np.linspace(0, 1, _GRID)
    return np.stack(np.meshgrid(side, side, indexing="xy"), axis=-1).reshape(-1, 2)


def _map(context: ReportContext, title: str, values: Array, label: str) -> Markup:
    """Return a map of values on the grid of tasks, with the edge of the threshold and the executed tasks."""
    tau, top = context.threshold, max(float(values.max()), float(context.distances.max()))
    chart = Chart(title, _parameter_axis(context, 0), _parameter_axis(context, 1), height=360)
    chart.image(values.reshape(_GRID, _GRID), 0.0, top)
    if tau is not None and (values > tau).any() and (values <= tau).any():
        # The edge of the region above the threshold lies between the cells of the map.
        above = (values > tau).reshape(_GRID, _GRID)
        grid = context.space.from_unit(_grid_of_tasks()).reshape(_GRID, _GRID, 2)
        half = 0.5 * (grid[1, 1] - grid[0, 0])
        across = grid[:, :-1][above[:, 1:] != above[:, :-1]]
        along = grid[:-1][above[1:] != above[:-1]]
        upright = np.stack([across + half * [1, -1], across + half], axis=1)
        level = np.stack([along + half * [-1, 1], along + half], axis=1)
        chart.edges(np.concatenate([upright, level]), "edge of the region above the threshold")
    _add_trials(chart, context, 0, 1)
    _add_marks(chart, context, [context.worst_first[0]], (0, 1), "worst", "worst executed task")
    return chart.render(colour_scale(0.0, top, label))


def _predicted(context: ReportContext, model: DistanceModel) -> Chart:
    """Return predicted against executed distances, each predicted without its own execution."""
    band, label = model.left_out, context.distance_label
    replayed = {k: replay.distance for k, replay in context.replays.items() if np.isfinite(replay.distance)}
    # A wide interval would hide everything else.
    shown = np.minimum(band.median, 2 * float(context.distances.max()))
    axis = Axis.over(label, context.distances, shown, list(replayed.values()), zero=True)
    x, y = (Axis(f"{which} {label}", axis.low, axis.high) for which in ("executed", "predicted"))
    chart = Chart("Predicted against executed distance, each predicted without its own execution", x, y)
    chart.line(axis.ends, axis.ends, "identity", "predicted = executed")
    chart.whiskers(model.values, band.low, band.high, "mean")
    chart.marks(model.values, band.median, "mean", "by a Gaussian process of the distance, with its 95 % band")
    if replayed:
        distances = [context.recordings[k].distance for k in replayed]
        chart.marks(distances, list(replayed.values()), "corrected", "by the corrected model")
    beforehand = stored_predictions(context)
    if beforehand:
        executed, expected = zip(*((distance_of(trial), stored.median) for trial, stored in beforehand), strict=True)
        chart.marks(executed, expected, "covering", "stored before the execution")
    return chart


def _region(context: ReportContext) -> list[Markup]:
    """Return where the threshold is kept; nothing if the certificate is of another kind or S is not known.

    A task keeps it if its prediction from the trials before the independent draws, plus the margin of the certificate
    ``region``, is at most the threshold.
    """
    certificate, learned, tau = context.certificate, context.provenance.learned, context.threshold
    if certificate is None or certificate.kind != "region" or learned is None or tau is None:
        return []
    margin, before = float(certificate.details["margin"]), int(certificate.details["learned_before"])
    space, d, model = context.space, context.space.dimension, context.distance_model
    if d == 1:
        unit = np.linspace(0, 1, _CURVE)[:, None]
    else:
        unit = _grid_of_tasks() if d == 2 else np.random.default_rng(0).random((400, d))
    bounds = learned.expected(unit, before) + margin
    inside, points, label = bounds <= tau, space.from_unit(unit), f"predicted {context.distance_label} + margin"
    text = paragraph(
        f"A task keeps the threshold {number(tau)} if its predicted distance plus the margin {number(margin)} of the "
        f"certificate is at most the threshold. This holds for {percent(float(inside.mean()))} of the tasks that are "
        f"drawn here. {certificate.statement}"
    )
    title = "Tasks that keep the threshold by the prediction plus its margin"
    drawn: object
    if d == 2:
        drawn = _map(context, title, np.nan_to_num(bounds, nan=np.nanmax(bounds)), label)
    elif d == 1:
        axes = _parameter_axis(context, 0), Axis.over(label, bounds, tau, zero=True)
        chart = Chart("Predicted distance plus margin, and the threshold", *axes)
        drawn = chart.line(points[:, 0], bounds, "mean", label).limit(tau, "threshold", "threshold")
    else:  # the chart shows the two parameters to which the distance is most sensitive
        i, j = (0, 1) if model is None else model.influence[:2]
        drawn = chart = Chart(title, _parameter_axis(context, i), _parameter_axis(context, j), height=360)
        if not inside.all():
            chart.marks(points[~inside, i], points[~inside, j], "weak", "above the threshold or not predicted")
        if inside.any():
            chart.marks(points[inside, i], points[inside, j], "sample", "keeps the threshold")
    return [heading("Where the threshold is kept"), text, element("div", drawn, class_="charts wide")]


def convergence(context: ReportContext) -> Markup:
    """Return the distances in the order of the executions with the bound, and how long the executions took."""
    chart = distances_in_order(context)
    if chart is None:
        return paragraph("No distance is known yet.")
    timed = [trial.seconds for trial in context.trials if trial.seconds is not None]
    attempts, sentences = sum(trial.attempts for trial in context.trials), list[str]()
    if attempts > len(context.trials):
        sentences.append(f"{attempts} attempts were made in {len(context.trials)} trials.")
    if timed:
        total, median = number(float(np.sum(timed))), number(float(np.median(timed)))
        sentences.append(f"The executions took {total} s, {median} s in the median.")
    spent = paragraph(" ".join(sentences)) if sentences else Markup("")
    return joined([element("div", chart, class_="charts"), spent])


def distances_in_order(context: ReportContext) -> Chart | None:
    """Return the distance of each trial and the largest one so far, with the limits; None if no distance is known."""
    if not context.completed:
        return None
    numbers = np.array([trial.number for trial in context.completed], dtype=np.float64)
    so_far = np.maximum.accumulate(context.distances)
    last = float(max(trial.number for trial in context.trials))
    limits = [limit for limit in (context.threshold, context.bound) if limit is not None]
    x = Axis("trial", -0.02 * max(last, 1.0), 1.02 * max(last, 1.0), whole=True)
    y = Axis.over(context.distance_label, context.distances, limits, zero=True)
    chart = Chart("Distance of each trial, and the largest one so far", x, y)
    risen = np.flatnonzero(np.diff(so_far, prepend=-1.0) > 0)  # the line is the same without all other points
    steps = np.repeat(numbers[risen], 2)[1:], np.repeat(so_far[risen], 2)[:-1]
    chart.line(np.append(steps[0], last), np.append(steps[1], so_far[-1]), "best", "largest so far")
    chart.limit(context.threshold, "threshold", "threshold").limit(context.bound, "bound", "bound on d*")
    beforehand = stored_predictions(context)
    if beforehand:
        at, expected = zip(*((trial.number, stored.median) for trial, stored in beforehand), strict=True)
        chart.marks(at, expected, "covering", "predicted before the execution")
    names = [f"trial {trial.number}: {number(trial.distance)}" for trial in context.completed]
    chart.marks(numbers, context.distances, "sample", "executed", names)
    if context.failed:
        bottom = np.full(len(context.failed), 0.03 * chart.y.ends[1])
        chart.marks([trial.number for trial in context.failed], bottom, "failed", "no distance is known")
    return chart
