"""Parallel coordinates: all executed tasks at once, one axis for each parameter and one for the distance."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from ctxval.report.charts import legend
from ctxval.report.context import ReportContext
from ctxval.report.markup import element, number, paragraph

_HEIGHT, _TOP, _BOTTOM = 300, 26, 250
_LINES = 300
"""Largest number of tasks that are drawn: those with the largest distances, and others evenly from the rest."""


def parallel_coordinates(context: ReportContext) -> Markup:
    """Return one line for each executed task, the worst ones in another style and on top."""
    labels = [*context.space.labels, context.distance_label]
    trials = context.worst_first
    rows = np.arange(len(trials))
    if len(trials) > _LINES:
        rows = np.unique(
            np.concatenate([rows[: _LINES // 2], np.linspace(0, len(trials) - 1, _LINES // 2).astype(int)])
        )
    top = max(float(context.distances.max()), 1e-300)
    shares = np.array([[*trials[k].unit_point, (trials[k].distance or 0.0) / top] for k in rows])
    # Share of the tasks that counts as the worst ones.
    limit = max(1, round(0.2 * len(rows)))
    # Least distance between two axes.
    width = max(480, 70 * (len(labels) - 1) + 60)
    at = 30 + (width - 60) * np.arange(len(labels)) / (len(labels) - 1)
    drawn = []
    for k, share in reversed(list(enumerate(shares))):
        up = _BOTTOM - np.clip(share, 0, 1) * (_BOTTOM - _TOP)
        path = "L".join(f"{x:.0f},{y:.0f}" for x, y in zip(at, up, strict=True))
        drawn.append(element("path", d=f"M{path}", class_=f"line {'weak' if k < limit else 'rest'}"))
    low, high = [*context.space.low, 0.0], [*context.space.high, top]
    axes = [_axis(x, j, label, low[j], high[j]) for j, (x, label) in enumerate(zip(at, labels, strict=True))]
    title = "Parallel coordinates: one line for each executed task, through its parameters and its distance"
    drawing = element(
        "svg", element("title", title), *drawn, *axes, viewBox=f"0 0 {width} {_HEIGHT}", role="img",
        class_="chart parallel", width=width,
    )  # fmt: skip
    names = paragraph("; ".join(f"{j} = {label}" for j, label in enumerate(labels)), class_="note")
    swatches = legend({f"the {limit} worst tasks": ("weak", "line"), "the other tasks": ("rest", "line")})
    scroll = element("div", drawing, class_="scroll", tabindex="0", role="region", aria_label="Parallel coordinates")
    return element("figure", scroll, swatches, names, element("figcaption", title), class_="wide")


def _axis(x: float, j: int, label: str, low: float, high: float) -> Markup:
    ends = (
        element("text", number(float(high), 3), x=f"{x:.0f}", y=_TOP - 8, class_="tick across"),
        element("text", number(float(low), 3), x=f"{x:.0f}", y=_BOTTOM + 16, class_="tick across"),
        element("text", str(j), element("title", label), x=f"{x:.0f}", y=_BOTTOM + 36, class_="axis-label"),
    )
    return element("g", element("path", d=f"M{x:.0f},{_TOP}V{_BOTTOM}", class_="axis"), *ends)
