"""The distance over the tasks, as a curve, a map or slices, and in the order of execution; and the envelope."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array, Mask
from ctxval._util.progress import stage
from ctxval.certificates.envelope import Envelope
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial
from ctxval.report.charts import SMALL, Axis, Chart, Kind, colour_scale, small_charts
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import Band, DistanceModel, distance_of
from ctxval.report.findings import stored_predictions
from ctxval.report.markup import UNCUT, bar, element, heading, joined, number, paragraph, percent, table, text

_CURVE, _GRID, _CELLS = 121, 32, 41  # points of a curve, of each side of a map, and of each side of an envelope

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
    predicted, d = _predicted(context, model), context.space.dimension
    if context.axes <= 1:  # the distance over one parameter is on the first screen
        return joined([element("div", predicted, class_="charts")])
    parts = [paragraph("Lines, bands and maps are pictures of what the trials suggest, and no certificate.")]
    if d == 2:  # the map is on the first screen
        parts.append(element("div", *(distance_along(context, axis) for axis in range(2)), class_="charts"))
    else:
        axes = model.influence[:12]
        if d > len(axes):
            parts.append(paragraph(f"{d - len(axes)} parameters with less influence have no slice here."))
        slices = filter(None, (distance_along(context, axis, small=True) for axis in axes))
        parts += [heading("Slices through the worst task"), small_charts(list(slices))]
    meaning = "the share of each parameter in the variance of the predicted distance, alone and together with others"
    shares = ((context.space.labels[j], float(model.sensitivity[j])) for j in model.influence)
    rows = ((label, percent(share), bar(share)) for label, share in shares)
    caption = f"Sensitivity of the distance: {meaning} (total Sobol index)"
    sensitivity = table(caption, ("Parameter", "Share", "Bar"), rows)
    return joined([*parts, element("div", sensitivity, predicted, class_="charts")])


def _estimated(context: ReportContext, unit: Array) -> Band | None:
    """Return the distances at points of the unit cube by the learned dynamics, or by a Gaussian process with a band.

    That is the one which predicts the executed distances better, each from the other trials.
    """
    model, dynamics = context.distance_model, context.dynamics
    if dynamics is None or not (context.batched or context.space.dimension == 1):
        return None if model is None else model.predict(unit)
    errors = np.array([replay.distance - context.recordings[k].distance for k, replay in context.replays.items()])
    if model is None or (errors**2).mean() <= ((model.left_out.median - model.values) ** 2).mean():
        # The user's parts, at states that no execution has reached, must not end a report.
        with suppress(Exception), stage("predicting distances", len(unit), "tasks"), context.thinks():
            if dynamics.affords(context.trials, len(unit)):
                values = dynamics.expected(context.trials, unit, len(context.trials))
                if np.isfinite(values).any():
                    return Band(values, values, values)
    return None if model is None else model.predict(unit)


def over_tasks(context: ReportContext) -> Markup | Chart | None:
    """Return the picture of the first screen: the distance over the task space; None if no distance is known.

    It is a curve over one parameter, a map over two, or a map over the two to which the distance is most sensitive.
    A suite has no tasks between its own, so its distances are in the order of execution.
    """
    picture: Markup | Chart | None = None
    if context.axes and context.completed:
        picture = distance_along(context, 0) if context.axes == 1 else _map(context)
    return picture or distances_in_order(context)


def distance_along(context: ReportContext, axis: int, *, small: bool = False) -> Chart | None:
    """Return the distance along one parameter, through the worst executed task; None if it cannot be estimated."""
    if not context.worst_first:
        return None
    space, worst = context.space, context.worst_first[0]
    # Designs that cannot be made in a batch take long.
    count = _CURVE if context.batched or context.validation is None else 31
    unit = np.tile(worst.unit_point, (count, 1))
    unit[:, axis] = np.linspace(0, 1, count)
    x, band = space.from_unit(unit)[:, axis], _estimated(context, unit)
    if band is None:
        return None
    title = f"Distance over {space.labels[axis]}"
    title += "" if space.dimension == 1 else ", through the worst executed task"
    # A threshold far above all distances would flatten the curve, so it may lie outside.
    top = 3 * max(float(context.distances.max()), float(np.nanmax(band.median)))
    shown = [value for value in context.limits if value <= top or top == 0]
    high = np.minimum(band.high, max(top, *shown, 1e-300))
    y = Axis.over(context.distance_label, context.distances, high, shown, zero=True)
    chart = Chart(title, _parameter_axis(space, axis), y, **(SMALL if small else {}))
    if band.low is band.high:
        chart.line(x, band.median, "mean", "predicted by the learned dynamics")
    else:
        chart.band(x, band.low, band.high, "95 % band").line(x, band.median, "mean", "Gaussian process of the distance")
    chart.limit(context.threshold, "threshold", "threshold").limit(context.bound, "bound", "bound on d*")
    if space.dimension == 1:
        _add_trials(chart, context, 0)
        _add_next(chart, context, 0)
    _add_marks(chart, context, [worst], (axis, None), "worst", "worst executed task")
    return chart


def _parameter_axis(space: TaskSpace, axis: int) -> Axis:
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


def _map(context: ReportContext) -> Markup | None:
    """Return a map of the distance with the executed tasks and the edge of the threshold; None if it cannot be fitted.

    The parameters that it does not show are those of the worst executed task.
    """
    model, space, worst = context.distance_model, context.space, context.worst_first[0]
    if model is None:
        return None
    i, j = axes = sorted(model.influence[:2]) if space.dimension > 2 else [0, 1]
    side, unit = np.linspace(0, 1, _GRID), np.tile(worst.unit_point, (_GRID**2, 1))
    unit[:, axes] = np.stack(np.meshgrid(side, side, indexing="xy"), axis=-1).reshape(-1, 2)
    values = (_estimated(context, unit) or model.predict(unit)).median
    values = np.nan_to_num(values, nan=float(context.distances.max()))
    tau, top = context.threshold, max(float(values.max()), float(context.distances.max()))
    title = f"Distance over {space.labels[i]} and {space.labels[j]}, with the executed tasks"
    title += "" if space.dimension == 2 else "; other parameters as in the worst executed task"
    chart = Chart(title, _parameter_axis(space, i), _parameter_axis(space, j), height=330)
    chart.image(values.reshape(_GRID, _GRID), 0.0, top)
    if tau is not None and (values > tau).any() and (values <= tau).any():
        # The edge of the region above the threshold lies between the cells of the map.
        above = (values > tau).reshape(_GRID, _GRID)
        grid = space.from_unit(unit)[:, axes].reshape(_GRID, _GRID, 2)
        half = 0.5 * (grid[1, 1] - grid[0, 0])
        across = grid[:, :-1][above[:, 1:] != above[:, :-1]]
        along = grid[:-1][above[1:] != above[:-1]]
        upright = np.stack([across + half * [1, -1], across + half], axis=1)
        level = np.stack([along + half * [-1, 1], along + half], axis=1)
        chart.edges(np.concatenate([upright, level]), "edge of the region above the threshold")
    _add_trials(chart, context, i, j)
    _add_marks(chart, context, [worst], (i, j), "worst", "worst executed task")
    _add_next(chart, context, i, j)
    return chart.render(colour_scale(0.0, top, context.distance_label))


def _add_next(chart: Chart, context: ReportContext, x: int, y: int | None = None) -> None:
    """Add the next tasks: the open trials, or the one that the verdict advises."""
    points = [trial.unit_point for trial in context.trials if trial.state == "open"]
    task = None if context.verdict is None else context.verdict.next_task
    at = context.space.from_unit(np.array(points)) if points else None
    if at is None and task is not None:
        at = np.asarray(context.space.point(task)).reshape(1, -1)
    if at is not None:
        height = np.full(len(at), 0.03 * chart.y.ends[1]) if y is None else at[:, y]
        chart.marks(at[:, x], height, "corrected", "next task", ["next task"] * len(at))


def _predicted(context: ReportContext, model: DistanceModel) -> Chart:
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
    if beforehand := stored_predictions(context):
        executed, expected = zip(*((distance_of(trial), stored.median) for trial, stored in beforehand), strict=True)
        chart.marks(executed, expected, "covering", "stored before the execution")
    return chart


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
    numbers = np.array(context.completed.numbers, dtype=np.float64)
    so_far = np.maximum.accumulate(context.distances)
    last = float(max(trial.number for trial in context.trials))
    x = Axis("trial", -0.02 * max(last, 1.0), 1.02 * max(last, 1.0), whole=True)
    y = Axis.over(context.distance_label, context.distances, context.limits, zero=True)
    chart = Chart("Distance of each trial, and the largest one so far", x, y)
    risen = np.flatnonzero(np.diff(so_far, prepend=-1.0) > 0)  # the line is the same without all other points
    steps = np.repeat(numbers[risen], 2)[1:], np.repeat(so_far[risen], 2)[:-1]
    chart.line(np.append(steps[0], last), np.append(steps[1], so_far[-1]), "best", "largest so far")
    chart.limit(context.threshold, "threshold", "threshold").limit(context.bound, "bound", "bound on d*")
    if beforehand := stored_predictions(context):
        at, expected = zip(*((trial.number, stored.median) for trial, stored in beforehand), strict=True)
        chart.marks(at, expected, "covering", "predicted before the execution")
    names = [f"trial {trial.number}: {number(trial.distance)}" for trial in context.completed]
    chart.marks(numbers, context.distances, "sample", "executed", names)
    if context.failed:
        bottom = np.full(len(context.failed), 0.03 * chart.y.ends[1])
        chart.marks(context.failed.numbers, bottom, "failed", "no distance is known")
    return chart


# The envelope, on the first screen


def envelope(context: ReportContext) -> Markup:
    """Return where the model can be trusted; empty if no envelope was computed."""
    known = context.envelope
    if known is None:
        return Markup()
    stated = None if known.doubt is not None else paragraph(text(known.statement, UNCUT))
    has_picture = known.doubt is None and bool(context.axes) and known.share > 0
    drawn, words = _trusted_tasks(context, known) if has_picture else None, paragraph(text(known.words, UNCUT))
    return element("div", heading("Where the model can be trusted"), stated, words, drawn, class_="envelope")


def _trusted_tasks(context: ReportContext, known: Envelope) -> Chart:
    """Return the trusted tasks over one or two parameters; the others are those of a task in the largest region."""
    space = context.space
    if space.dimension == 1:
        unit = np.linspace(0, 1, 401)[:, None]
        points, bounds = space.from_unit(unit)[:, 0], known.bound_at(unit)
        trusted = np.isfinite(bounds)
        y = Axis.over(context.distance_label, bounds[trusted], context.distances, known.threshold, zero=True)
        chart = Chart("Trusted tasks, and a bound on their distance", _parameter_axis(space, 0), y)
        for run in _runs(trusted):
            chart.band(points[run], np.zeros_like(points[run]), bounds[run], "trusted")
        chart.limit(known.threshold, "threshold", "threshold")
        chart.line(points, np.where(trusted, bounds, np.nan), "bound", "bound on the distance there")
        return chart.marks(context.coordinates(context.completed)[:, 0], context.distances, "sample", "executed")
    # The two parameters of the picture, and a trusted task whose other parameters it shows.
    limited = [] if not known.regions else [space.labels.index(x) for x in known.regions[0].limits if x in space.labels]
    i, j = sorted([*limited, *(k for k in range(space.dimension) if k not in limited)][:2])
    tasks = np.random.default_rng(0).random((1000, space.dimension))
    centre = tasks[known.bound_at(tasks).argmin()]
    side = (np.arange(_CELLS) + 0.5) / _CELLS
    unit = np.broadcast_to(centre, (_CELLS, _CELLS, space.dimension)).copy()
    unit[..., i], unit[..., j] = np.meshgrid(side, side, indexing="xy")
    trusted = np.isfinite(known.bound_at(unit))
    title = "Trusted tasks (shaded)"
    if space.dimension > 2:
        values = space.from_unit(centre)
        others = [k for k in range(space.dimension) if k not in (i, j)]
        title += f", at {', '.join(f'{space.names[k]} {values[k]:.3g}' for k in others[:4])}"
        title += "" if len(others) <= 4 else " and so on"
    chart = Chart(title, _parameter_axis(space, i), _parameter_axis(space, j), height=330)
    low, width = space.low[[i, j]], (space.high - space.low)[[i, j]] / _CELLS
    for row in range(_CELLS):
        bottom, top = low[1] + width[1] * np.array([row, row + 1])
        for run in _runs(trusted[row]):
            chart.band(low[0] + width[0] * np.array([run.start, run.stop]), [bottom] * 2, [top] * 2, "trusted")
    if space.dimension == 2:
        points = context.coordinates(context.completed)
        above = context.distances > known.threshold
        for chosen, kind, label in ((~above, "sample", "executed below the threshold"), (above, "failed", "above it")):
            if chosen.any():
                chart.marks(points[chosen, 0], points[chosen, 1], kind, label)  # type: ignore[arg-type]
    return chart


def _runs(mask: Mask) -> list[slice]:
    ends = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return [slice(*pair) for pair in zip(ends[::2], ends[1::2], strict=True)]
