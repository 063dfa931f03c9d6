"""Charts as inline SVG: axes with ticks, lines, bands, marks, limits, and maps.

Colours are those of the style sheet, by the kind of what is drawn, so that a chart is legible on a light and on a dark
page. Each kind also differs in its line style or in the shape of its marks, for grey print and for colour blindness.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from markupsafe import Markup

from ctxval._util.arrays import Array, ArrayLike
from ctxval._util.representation import ShortRepr
from ctxval.certificates.bounds import at_most
from ctxval.report.markup import element, joined, number

SMALL = {"width": 340, "height": 220}  #: size of a chart of which several stand side by side

_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 14, 12, 46

Kind = Literal[
    "mean", "model", "system", "corrected", "reference", "best", "threshold", "bound", "sample", "initial", "covering",
    "failed", "worst", "weak", "identity",
]  # fmt: skip
"""What is drawn, which decides its colour, its line style and its mark."""

_DOT = "M-3.6,0a3.6,3.6 0 1,0 7.2,0a3.6,3.6 0 1,0 -7.2,0z"
_CROSS = "M-4,-4L4,4M-4,4L4,-4"
_MARKS: dict[str, str] = {
    "sample": _DOT,
    "mean": _DOT,
    "failed": _CROSS,
    "weak": _CROSS,
    "initial": "M-3.4,-3.4h6.8v6.8h-6.8z",
    "covering": "M0,-4.6L4.2,3.2H-4.2z",
    "worst": "M0,-8L2.1,-2.6L7.6,-2.4L3.3,1.1L4.7,6.6L0,3.5L-4.7,6.6L-3.3,1.1L-7.6,-2.4L-2.1,-2.6z",
    "corrected": "M0,-4.6L4.6,0L0,4.6L-4.6,0z",
}


@dataclass(frozen=True)
class Axis(ShortRepr):
    """One axis of a chart."""

    label: str  #: its name with the unit
    low: float  #: its ends; if they are equal or not finite, it is widened to a range around them
    high: float
    whole: bool = False  #: whether its ticks are whole numbers

    @classmethod
    def over(cls, label: str, *values: ArrayLike, zero: bool = False, room: float = 0.06) -> Axis:
        """Return an axis that holds all finite values ``(...)``, with room: a share of the range at each end.

        With ``zero`` it starts at 0; values are then expected to be at least 0.
        """
        flat = np.concatenate([np.ravel(np.asarray(array, dtype=np.float64)) for array in values] or [np.zeros(1)])
        finite = flat[np.isfinite(flat) & (np.abs(flat) < 1e300)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        low = 0.0 if zero else low - room * (high - low)
        return cls(label, low, high + room * (high - low))

    @property
    def ends(self) -> tuple[float, float]:
        """Its ends, which are different."""
        if self.high - self.low > max(1e-12 * max(abs(self.low), abs(self.high)), 1e-300):
            return self.low, self.high
        width = 0.5 * abs(self.low) or 0.5
        return self.low - width, self.low + width

    def shares(self, values: ArrayLike) -> Array:
        """Return how far along the axis values ``(...)`` are, from 0 to 1; a little more for those beyond its ends."""
        low, high = self.ends
        return np.clip((np.asarray(values, dtype=np.float64) - low) / (high - low), -0.02, 1.02)

    def ticks(self) -> list[float]:
        """Return about five round numbers within the axis."""
        low, high = self.ends
        raw = (high - low) / 5
        power = 10.0 ** np.floor(np.log10(raw))
        step = power * next(factor for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if factor * power >= raw * (1 - 1e-9))
        step = max(step, 1.0) if self.whole else step
        first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
        return [float(k * step) for k in np.arange(first, last + 1)][:20]


@dataclass(eq=False)
class Chart(ShortRepr):
    """A chart with two axes, to which lines, bands and marks, arrays ``(N,)``, are added in the order of drawing."""

    title: str  #: what it shows; screen readers read it, and it stands below the chart
    x: Axis  #: the axes
    y: Axis
    width: int = 480  #: its size in its own units
    height: int = 280
    _parts: list[Markup] = field(default_factory=list, init=False, repr=False)
    _legend: dict[str, Markup] = field(default_factory=dict, init=False, repr=False)

    def across(self, values: ArrayLike) -> Array:
        """Return the horizontal positions of values of x; NaN stays NaN."""
        return np.asarray(_LEFT + self.x.shares(values) * (self.width - _LEFT - _RIGHT))

    def up(self, values: ArrayLike) -> Array:
        """Return the vertical positions of values of y; NaN stays NaN."""
        return np.asarray(self.height - _BOTTOM - self.y.shares(values) * (self.height - _TOP - _BOTTOM))

    def _at(self, x: ArrayLike, y: ArrayLike) -> Array:
        return np.stack([self.across(x), self.up(y)], axis=-1)

    def line(self, x: ArrayLike, y: ArrayLike, kind: Kind, label: str = "") -> Chart:
        """Add a line; it is interrupted at values that are not finite."""
        at = self._at(x, y)
        self._named(label, element("path", d="M1,8H25", class_=f"line {kind}"))
        finite = np.isfinite(at).all(axis=-1)
        for run in np.split(at, np.flatnonzero(np.diff(finite)) + 1):
            if len(run) > 1 and np.isfinite(run[0]).all():
                self._parts.append(_path(run, f"line {kind}"))
        return self

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, label: str = "") -> Chart:
        """Add a band between two lines."""
        outline = np.concatenate([self._at(x, low), self._at(x, high)[::-1]])
        self._named(label, element("path", d="M1,3H25V13H1z", class_="band"))
        if np.isfinite(outline).all():
            self._parts.append(_path(outline, "band", closed=True))
        return self

    def marks(
        self, x: ArrayLike, y: ArrayLike, kind: Kind, label: str = "", names: Sequence[str] | None = None
    ) -> Chart:
        """Add marks; their names appear if the pointer rests on them."""
        at = self._at(x, y).reshape(-1, 2)
        self._named(label, element("path", d=_MARKS[kind], transform="translate(13 8)", class_=f"mark {kind}"))
        drawn = np.flatnonzero(np.isfinite(at).all(axis=-1)).tolist()
        if len(at) > 600:  # dots have no names, and are smaller in the file
            dots = "".join(f"M{at[k, 0]:.0f},{at[k, 1]:.0f}h0" for k in drawn)
            self._parts.append(element("path", d=dots, class_=f"dots {kind}"))
            return self
        for k in drawn:
            name = None if names is None else element("title", names[k])
            where = f"translate({at[k, 0]:.1f} {at[k, 1]:.1f})"
            self._parts.append(element("path", name, d=_MARKS[kind], transform=where, class_=f"mark {kind}"))
        return self

    def whiskers(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, kind: Kind) -> Chart:
        """Add vertical intervals."""
        for interval in np.stack([self._at(x, low), self._at(x, high)], axis=-2):
            if np.isfinite(interval).all():
                self._parts.append(_path(interval, f"whisker {kind}"))
        return self

    def limit(self, value: float | None, kind: Kind, label: str) -> Chart:
        """Add a horizontal line across the chart; nothing if the value is None, only its name if it is outside."""
        if value is None or not np.isfinite(value):
            return self
        low, high = self.y.ends
        name = f"{label} {at_most(value) if kind == 'bound' else number(value)}"
        if low <= value <= high:
            return self.line(self.x.ends, [value, value], kind, name)
        return self.line([], [], kind, f"{name}, {'above' if value > high else 'below'} this chart")

    def image(self, values: Array, low: float, high: float) -> Chart:
        """Add a map of values ``(rows, columns)``, the first row at the bottom, in a colour scale from low to high."""
        left, right = (float(self.across(end)) for end in self.x.ends)
        bottom, top = (float(self.up(end)) for end in self.y.ends)
        self._parts.append(
            element(
                "image", href=data_uri(values, low, high), preserveAspectRatio="none", class_="map",
                x=f"{left:.1f}", y=f"{top:.1f}", width=f"{right - left:.1f}", height=f"{bottom - top:.1f}",
            )
        )  # fmt: skip
        return self

    def edges(self, segments: Array, label: str) -> Chart:
        """Add line segments on a map ``(k, 2, 2)``: black under dashed white, which is visible on every colour."""
        at = self._at(np.clip(segments[..., 0], *self.x.ends), np.clip(segments[..., 1], *self.y.ends))
        path = "".join(f"M{a:.1f},{b:.1f}L{c:.1f},{d:.1f}" for (a, b), (c, d) in at.tolist())
        kinds = ("edge-under", "edge")
        self._named(label, *(element("path", d="M1,8H25", class_=f"line {kind}") for kind in kinds))
        self._parts += [element("path", d=path, class_=f"line {kind}") for kind in kinds]
        return self

    def _named(self, label: str, *shapes: Markup) -> None:
        if label:
            self._legend[label] = joined(shapes)

    def __html__(self) -> str:
        """Return the chart with its legend, as templates and elements insert it."""
        return str(self.render())

    def render(self, *below: Markup, with_legend: bool = True) -> Markup:
        """Return the chart as a figure with a legend and its title; elements ``below`` follow the legend."""
        left, right, top, bottom = _LEFT, self.width - _RIGHT, _TOP, self.height - _BOTTOM
        upright = f"translate(13 {0.5 * (top + bottom)}) rotate(-90)"
        frame = []
        for value in self.x.ticks():
            at = round(float(self.across(value)), 1)
            frame.append(element("path", d=f"M{at},{bottom}v4", class_="axis"))
            frame.append(element("text", number(value), x=at, y=bottom + 18, class_="tick across"))
        for value in self.y.ticks():
            at = round(float(self.up(value)), 1)
            frame.append(element("path", d=f"M{left},{at}H{right}", class_="grid"))
            frame.append(element("text", number(value), x=left - 6, y=at + 4, class_="tick up"))
        frame += [
            element("path", d=f"M{left},{top}V{bottom}H{right}", class_="axis"),
            element("text", self.x.label, x=0.5 * (left + right), y=self.height - 8, class_="axis-label"),
            element("text", self.y.label, transform=upright, class_="axis-label"),
        ]
        inside = element("title", self.title), element("g", *frame), element("g", *self._parts)
        shape = {"viewBox": f"0 0 {self.width} {self.height}", "role": "img", "class_": "chart", "width": self.width}
        names = _legend(self._legend) if with_legend else None
        return element("figure", element("svg", *inside, **shape), names, *below, element("figcaption", self.title))


def small_charts(charts: Sequence[Chart]) -> Markup:
    """Return charts side by side, with one legend for all of them."""
    named = {label: swatch for chart in charts for label, swatch in chart._legend.items()}
    figures = (chart.render(with_legend=False) for chart in charts)
    return element("div", _legend(named), element("div", *figures, class_="charts small"))


def _legend(named: dict[str, Markup]) -> Markup | None:
    items = []
    for label, shapes in named.items():
        swatch = element("svg", shapes, viewBox="0 0 26 16", aria_hidden="true", class_="swatch")
        items.append(element("li", swatch, element("span", label)))
    return element("ul", *items, class_="legend") if items else None


def data_uri(values: Array, low: float, high: float) -> str:
    """Return a picture of values ``(rows, columns)``, the first row at the bottom, as a data URI."""
    from matplotlib.image import imsave  # imported here: loading it takes longer than a short campaign

    buffer = io.BytesIO()
    # Cividis is the same for people with and without colour blindness.
    imsave(buffer, values, vmin=low, vmax=high, cmap="cividis", origin="lower", format="png")
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def colour_scale(low: float, high: float, label: str) -> Markup:
    """Return the scale of a map."""
    shades = element(
        "image", href=data_uri(np.linspace(0, 1, 64)[None], 0, 1), width=200, height=10, x=140, y=6,
        preserveAspectRatio="none",
    )  # fmt: skip
    ends = element("text", number(low), x=134, y=16, class_="tick up"), element("text", number(high), x=346, y=16)
    name = element("text", label, x=240, y=34, class_="axis-label")
    return element("svg", shades, *ends, name, viewBox="0 0 480 40", class_="chart scale", aria_hidden="true")


def _path(at: Array, class_: str, *, closed: bool = False) -> Markup:
    """Return a path through points ``(k, 2)``, in relative coordinates, which are shorter."""
    tenths = np.rint(10 * at).astype(int)
    start = f"M{tenths[0, 0] / 10:g},{tenths[0, 1] / 10:g}"
    steps = "".join(f"l{dx / 10:g},{dy / 10:g}" for dx, dy in np.diff(tenths, axis=0).tolist())
    return element("path", d=start + steps + ("z" if closed else ""), class_=class_)
