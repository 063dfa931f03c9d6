"""The distance over the tasks: as a curve, as a map, or as slices and parallel coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import call
from ctxval.core.trial import Trial
from ctxval.report.charts import SMALL, Axis, Chart, Kind, colour_scale, small_charts
from ctxval.report.context import ReportContext
from ctxval.report.diagnostics import stored_predictions
from ctxval.report.distance_model import Band, DistanceModel
from ctxval.report.markup import bar, element, heading, joined, number, paragraph, percent, table
from ctxval.report.parallel import parallel_coordinates
from ctxval.report.region import region_map

_CURVE, _GRID = 121, 32
"""Number of points of a curve, and of each side of a map."""

_ORIGINS: tuple[tuple[Kind, str, tuple[str, ...]], ...] = (
    ("initial", "initial or chosen by a person", ("iid", "initial", "manual")),
    ("covering", "chosen to decide the verdict", ("covering",)),
    ("sample", "chosen by the search", ("acquisition",)),
)


class TasksSection:
    """Where in the task space the distance is large, and how well that is known."""

    title = "Distance over the tasks"

    def render(self, context: ReportContext) -> Markup:
        """Return the charts that suit the number of parameters, the sensitivity and the predictions."""
        model = context.distance_model
        if model is None:
            return paragraph("Fewer than two distances are known, so no picture of the distance can be drawn.")
        if context.space.dimension == 1:  # the distance over the tasks is on the first screen
            parts = [element("div", _predicted(context, model), class_="charts")]
        else:
            second = element("div", _sensitivity(context, model), _predicted(context, model), class_="charts")
            parts = [_space_charts(context, model), second]
        mapped = region_map(context)
        if mapped is not None:
            parts += [heading("Where the threshold is kept"), mapped]
        return joined(parts)

    __repr__ = call


def _space_charts(context: ReportContext, model: DistanceModel) -> Markup:
    d = context.space.dimension
    said = paragraph("Lines, bands and maps are pictures of what the trials suggest, and no certificate.")
    if d == 2:
        both = (_slice(context, axis) for axis in range(2))
        return joined([said, element("div", _map(context, model), *both, class_="charts")])
    # Largest number of slices: of the parameters to which the distance is most sensitive.
    axes = [int(j) for j in np.argsort(-model.sensitivity, kind="stable")[:12]]
    if d > len(axes):
        said += paragraph(f"{d - len(axes)} parameters with less influence have no slice here.")
    slices = filter(None, (_slice(context, axis, small=True) for axis in axes))
    return joined(
        [
            said,
            heading("Slices through the worst task"),
            small_charts(list(slices)),
            heading("All tasks at once"),
            parallel_coordinates(context),
        ]
    )


def distance_over_task(context: ReportContext) -> Chart | None:
    """Return the distance over the only parameter with the executed tasks; None if too few distances are known."""
    return _slice(context, 0) if context.worst_first else None


def _estimated(context: ReportContext, unit: Array) -> Band | None:
    """Return the distances at points of the unit cube by the learned dynamics, or by a Gaussian process with a band."""
    values = context.predicted(unit) if context.batched or context.space.dimension == 1 else None
    if values is not None:
        return Band(values, values, values)
    return None if context.distance_model is None else context.distance_model.predict(unit)


def _slice(context: ReportContext, axis: int, *, small: bool = False) -> Chart | None:
    """Return the distance along one parameter, through the worst executed task; None if it cannot be estimated."""
    space, worst = context.space, context.worst_first[0]
    # Number of points of a curve, if each needs the design of a controller that cannot be made in a batch.
    count = _CURVE if context.batched or context.validation is None else 31
    unit = np.tile(worst.unit_point, (count, 1))
    unit[:, axis] = np.linspace(0, 1, count)
    x, band = space.from_unit(unit)[:, axis], _estimated(context, unit)
    if band is None:
        return None
    label = space.labels[axis]
    title = f"Distance over {label}" + ("" if space.dimension == 1 else ", through the worst executed task")
    ends = Axis(label, float(space.low[axis]), float(space.high[axis]))
    chart = Chart(title, ends, _distance_axis(context, band), **(SMALL if small else {}))
    if band.low is band.high:
        chart.line(x, band.median, "mean", "predicted by the learned dynamics")
    else:
        chart.band(x, band.low, band.high, "95 % band").line(x, band.median, "mean", "Gaussian process of the distance")
    chart.limit(context.threshold, "threshold", "threshold").limit(context.bound, "bound", "bound on d*")
    if space.dimension == 1:
        _add_samples(chart, context, lambda trials: (context.coordinates(trials)[:, axis], _distances(trials)))
        if context.failed:
            x = context.coordinates(context.failed)[:, axis]
            y = np.full(len(x), 0.03 * chart.y.ends[1])
            chart.marks(x, y, "failed", "no distance is known", list(map(_named, context.failed)))
    at = context.coordinates([worst])[:, axis]
    return chart.marks(at, _distances([worst]), "worst", "worst executed task", [_named(worst)])


def _distance_axis(context: ReportContext, band: Band) -> Axis:
    limits = [value for value in (context.threshold, context.bound) if value is not None]
    # A threshold far above all distances would flatten the curve, so it may lie outside.
    top = 3 * max(float(context.distances.max()), float(np.nanmax(band.median)))
    shown = [value for value in limits if value <= top or top == 0]
    high = np.minimum(band.high, max(top, *shown, 1e-300))
    return Axis.over(context.distance_label, context.distances, high, shown, zero=True)


def _map(context: ReportContext, model: DistanceModel) -> Markup:
    """Return the map of two parameters, with the executed tasks."""
    space = context.space
    side = np.linspace(0, 1, _GRID)
    unit = np.stack(np.meshgrid(side, side, indexing="xy"), axis=-1).reshape(-1, 2)
    found = _estimated(context, unit) or model.predict(unit)
    values = np.nan_to_num(found.median, nan=float(context.distances.max())).reshape(_GRID, _GRID)
    low, high = 0.0, max(float(values.max()), float(context.distances.max()))
    x, y = (Axis(space.labels[i], float(space.low[i]), float(space.high[i])) for i in range(2))
    chart = Chart("Map of the distance over the two parameters, with the executed tasks", x, y, height=360)
    chart.image(values, low, high)
    tau = context.threshold
    if tau is not None and (values > tau).any() and (values <= tau).any():
        _add_contour(chart, space.from_unit(unit), values.ravel() > tau)

    def place(trials: Sequence[Trial]) -> tuple[Array, Array]:
        at = context.coordinates(trials)
        return at[:, 0], at[:, 1]

    _add_samples(chart, context, place)
    if context.failed:
        _mark(chart, place, context.failed, "failed", "no distance is known")
    _mark(chart, place, context.worst_first[:1], "worst", "worst executed task")
    return chart.render(colour_scale(low, high, context.distance_label))


def _add_contour(chart: Chart, points: Array, above: Mask) -> None:
    """Draw the edge of the region above the threshold, between the cells of the map."""
    inside, grid = above.reshape(_GRID, _GRID), points.reshape(_GRID, _GRID, 2)
    half = 0.5 * (grid[1, 1] - grid[0, 0])
    across = grid[:, :-1][inside[:, 1:] != inside[:, :-1]]
    along = grid[:-1][inside[1:] != inside[:-1]]
    upright = np.stack([across + half * [1, -1], across + half], axis=1)
    level = np.stack([along + half * [-1, 1], along + half], axis=1)
    chart.edges(np.concatenate([upright, level]), "edge of the region above the threshold")


Place = Callable[[Sequence[Trial]], tuple[Array, Array]]
"""A function from trials to the positions of their marks in a chart."""


def _mark(chart: Chart, place: Place, trials: Sequence[Trial], kind: Kind, label: str) -> None:
    x, y = place(trials)
    chart.marks(x, y, kind, label, list(map(_named, trials)))


def _add_samples(chart: Chart, context: ReportContext, place: Place) -> None:
    """Add the executed tasks, with a mark for each origin."""
    for kind, label, origins in _ORIGINS:
        trials = [trial for trial in context.completed if trial.origin in origins]
        if trials:
            _mark(chart, place, trials, kind, label)


def _distances(trials: Sequence[Trial]) -> Array:
    return np.array([trial.distance for trial in trials], dtype=np.float64)


def _named(trial: Trial) -> str:
    return f"trial {trial.number}: {'no distance' if trial.distance is None else number(trial.distance)}"


def _sensitivity(context: ReportContext, model: DistanceModel) -> Markup:
    """Return the shares of the parameters in the variance of the predicted distance, the largest first."""
    labels, shares = context.space.labels, model.sensitivity
    order = np.argsort(-shares, kind="stable").tolist()
    rows = [(labels[j], percent(float(shares[j])), bar(float(shares[j]))) for j in order]
    caption = (
        "Sensitivity of the distance: the share of each parameter in the variance of the predicted distance, alone and "
        "together with others (total Sobol index)"
    )
    return table(caption, ("Parameter", "Share", "Bar"), rows)


def _predicted(context: ReportContext, model: DistanceModel) -> Chart:
    """Return predicted against executed distances, each predicted without its own execution."""
    band = model.left_out
    replayed = {k: replay.distance for k, replay in context.replays.items() if np.isfinite(replay.distance)}
    by_number = {trial.number: trial.distance or 0.0 for trial in context.completed}
    # A wide interval would hide everything else.
    top = 2 * float(context.distances.max())
    axis = Axis.over(
        context.distance_label, context.distances, np.minimum(band.median, top), list(replayed.values()), zero=True
    )
    y = Axis(f"predicted {context.distance_label}", axis.low, axis.high)
    chart = Chart("Predicted against executed distance, each predicted without its own execution",
                  Axis(f"executed {context.distance_label}", axis.low, axis.high), y)  # fmt: skip
    chart.line(axis.ends, axis.ends, "identity", "predicted = executed")
    chart.whiskers(model.values, band.low, band.high, "mean")
    chart.marks(model.values, band.median, "mean", "by a Gaussian process of the distance, with its 95 % band")
    if replayed:
        executed = [by_number[k] for k in replayed]
        chart.marks(executed, list(replayed.values()), "corrected", "by the corrected model")
    beforehand = stored_predictions(context)
    if beforehand:
        x = [trial.distance or 0.0 for trial, _ in beforehand]
        chart.marks(x, [prediction.median for _, prediction in beforehand], "covering", "stored before the execution")
    return chart
