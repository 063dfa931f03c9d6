"""The envelope on the first screen: on which tasks the threshold is kept, in words and as a picture."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array, Mask
from ctxval.certificates.envelope import Envelope
from ctxval.report.charts import Axis, Chart
from ctxval.report.context import ReportContext
from ctxval.report.markup import UNCUT, element, heading, joined, paragraph, text

_GRID = 41  # cells of a map along each axis
_CURVE = 401


def envelope(context: ReportContext) -> Markup:
    """Return where the model can be trusted; empty if no envelope was computed."""
    known = context.envelope
    if known is None:
        return Markup()
    stated = [] if known.doubt is not None else [paragraph(text(known.statement, UNCUT))]
    has_picture = known.doubt is None and context.suite is None and known.share > 0
    drawn = [_picture(context, known)] if has_picture else []
    words = paragraph(text(known.words, UNCUT))
    return element("div", heading("Where the model can be trusted"), *stated, words, joined(drawn), class_="envelope")


def _picture(context: ReportContext, known: Envelope) -> Chart:
    """Return the trusted tasks over one or two parameters; the others are those of a task in the largest region."""
    space = context.space
    if space.dimension == 1:
        unit = np.linspace(0, 1, _CURVE)[:, None]
        points, bounds = space.from_unit(unit)[:, 0], known.bound_at(unit)
        axes = Axis(space.labels[0], float(space.low[0]), float(space.high[0])), _axis_of(context, known, bounds)
        chart = Chart("Trusted tasks, and a bound on their distance", *axes)
        trusted = np.isfinite(bounds)
        for run in _runs(trusted):
            chart.band(points[run], np.zeros_like(points[run]), bounds[run], "trusted")
        chart.limit(known.threshold, "threshold", "threshold")
        chart.line(points, np.where(trusted, bounds, np.nan), "bound", "bound on the distance there")
        return chart.marks(context.coordinates(context.completed)[:, 0], context.distances, "sample", "executed")
    i, j, centre = _shown(context, known)
    side = (np.arange(_GRID) + 0.5) / _GRID
    unit = np.broadcast_to(centre, (_GRID, _GRID, space.dimension)).copy()
    unit[..., i], unit[..., j] = np.meshgrid(side, side, indexing="xy")
    trusted = np.isfinite(known.bound_at(unit))
    title = "Trusted tasks (shaded)"
    if space.dimension > 2:
        values = space.from_unit(centre)
        others = [k for k in range(space.dimension) if k not in (i, j)]
        title += f", at {', '.join(f'{space.names[k]} {values[k]:.3g}' for k in others[:4])}"
        title += "" if len(others) <= 4 else " and so on"
    x, y = (Axis(space.labels[k], float(space.low[k]), float(space.high[k])) for k in (i, j))
    chart = Chart(title, x, y, height=330)
    low, width = space.low[[i, j]], (space.high - space.low)[[i, j]] / _GRID
    for row in range(_GRID):
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
    """Return the runs of trusted points."""
    ends = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return [slice(*pair) for pair in zip(ends[::2], ends[1::2], strict=True)]


def _axis_of(context: ReportContext, known: Envelope, bounds: Array) -> Axis:
    return Axis.over(context.distance_label, bounds[np.isfinite(bounds)], context.distances, known.threshold, zero=True)


def _shown(context: ReportContext, known: Envelope) -> tuple[int, int, Array]:
    """Return the two parameters of a picture, and a trusted task whose other parameters it shows."""
    space = context.space
    limited = [] if not known.regions else [space.labels.index(x) for x in known.regions[0].limits if x in space.labels]
    i, j = sorted([*limited, *(k for k in range(space.dimension) if k not in limited)][:2])
    tasks = np.random.default_rng(0).random((1000, space.dimension))
    bounds = known.bound_at(tasks)
    return i, j, np.asarray(tasks[bounds.argmin()])
