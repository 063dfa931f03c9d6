"""The map of the certificate ``region``: the tasks whose predicted distance with its margin keeps the threshold."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array
from ctxval.report.charts import Axis, Chart, colour_scale
from ctxval.report.context import ReportContext
from ctxval.report.markup import element, joined, number, paragraph, percent

_SIDE = 31
"""Number of predicted tasks on each side of a map, and a third of those of a curve."""


def region_map(context: ReportContext) -> Markup | None:
    """Return where the threshold is kept; None if the certificate is of another kind or the experiment is not loaded.

    A task is inside if its prediction from the trials before the independent draws, plus the margin of the
    certificate, is at most the threshold.
    """
    certificate, learned, tau = context.certificate, context.provenance.learned, context.threshold
    if certificate is None or certificate.kind != "region" or learned is None or tau is None:
        return None
    margin, before = float(certificate.details["margin"]), int(certificate.details["learned_before"])
    unit = _tasks(context.space.dimension)
    bounds = learned.expected(unit, before) + margin
    charts = element("div", _drawn(context, unit, bounds, tau), class_="charts wide")
    sentence = (
        f"A task keeps the threshold {number(tau)} if its predicted distance plus the margin {number(margin)} of the "
        f"certificate is at most the threshold. This holds for {percent(float((bounds <= tau).mean()))} of the tasks "
        f"that are drawn here. {certificate.statement}"
    )
    return joined([paragraph(sentence), charts])


def _tasks(dimension: int) -> Array:
    if dimension == 1:
        return np.linspace(0, 1, 3 * _SIDE)[:, None]
    if dimension == 2:
        side = np.linspace(0, 1, _SIDE)
        return np.stack(np.meshgrid(side, side, indexing="xy"), axis=-1).reshape(-1, 2)
    # Number of random tasks that are predicted if there are more than two parameters.
    return np.random.default_rng(0).random((400, dimension))


def _drawn(context: ReportContext, unit: Array, bounds: Array, tau: float) -> Markup:
    """Return a curve of the bound for one parameter, a map for two, and marks over two parameters for more."""
    space, points = context.space, context.space.from_unit(unit)
    label = f"predicted {context.distance_label} + margin"
    inside = bounds <= tau
    if space.dimension == 1:
        x = Axis(space.labels[0], float(space.low[0]), float(space.high[0]))
        chart = Chart("Predicted distance plus margin, and the threshold", x, Axis.over(label, bounds, tau, zero=True))
        return chart.line(points[:, 0], bounds, "mean", label).limit(tau, "threshold", "threshold").render()
    # Of many parameters, the map shows the two to which the distance is most sensitive.
    model = context.distance_model
    order = np.argsort(-model.sensitivity, kind="stable") if model is not None else np.arange(space.dimension)
    i, j = (0, 1) if space.dimension == 2 else (int(order[0]), int(order[1]))
    x, y = (Axis(space.labels[k], float(space.low[k]), float(space.high[k])) for k in (i, j))
    chart = Chart("Tasks that keep the threshold by the prediction plus its margin", x, y, height=360)
    below: tuple[Markup, ...] = ()
    if space.dimension == 2:
        finite = np.nan_to_num(bounds, nan=float(np.nanmax(bounds)))
        chart.image(finite.reshape(_SIDE, _SIDE), 0.0, float(finite.max()))
        below = (colour_scale(0.0, float(finite.max()), label),)
    if not inside.all():
        chart.marks(points[~inside, i], points[~inside, j], "weak", "above the threshold or not predicted")
    if space.dimension > 2 and inside.any():
        chart.marks(points[inside, i], points[inside, j], "sample", "keeps the threshold")
    return chart.render(*below)
