"""The shape of an envelope: numbers that are known at some tasks, interpolated to all others, and boxes inside a set.

The interpolant is the smoothest one in the sense of Duchon (1977): a sum of ``|p - p_j|^3`` and a linear function. Its
errors are known without any further task: what each task would be if it were interpolated from the others follows from
one inverse matrix (Rippa 1999). By these errors, the scale of each parameter is chosen.

The sides of a box are limits on parameters and, of two parameters with the same unit, on their sum and difference. A
box without a task outside of the set grows from a task inside it until each side meets such a task. The best one of
many is shrunk where further tasks in it lie outside of the set.
"""

from __future__ import annotations

import base64
import inspect
import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask
from ctxval._util.files import MADE_BY
from ctxval._util.texts import parted
from ctxval.core.space import TaskSpace

_SEEDS, _BEST = 100, 10  # tasks from which boxes grow, and those from which they grow again


@dataclass(frozen=True)
class ShapeSettings:
    """How the set of tasks is interpolated, and how boxes in it are found."""

    enough: float = 1.2  #: multiple of the limit up to which an error of what exceeds it matters
    false: float = 0.005  #: share of the checked points that may be below the limit falsely
    #: checked points from which on errors may also turn out to be too large: then multiples are below 1
    many: int = 256
    #: of the errors
    multiples: tuple[float, ...] = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
    scaled: int = 500  #: tasks by which scales are chosen
    scales: tuple[float, ...] = (0.02, 50.0)  #: smallest and largest one
    nugget: float = 1e-9  #: added to the matrix, so that two tasks that are nearly the same do not make it singular
    regions: int = 3  #: largest number of regions
    least: float = 0.02  #: least share of the tasks that a region holds and no larger one
    checked: int = 2000  #: tasks in a box that must all lie inside the set
    rounds: int = 30  #: times that boxes may grow again, each time to a smaller share of the way to tasks outside


SHAPE = ShapeSettings()
"""The settings in use."""


_DIGITS = 3


def upper_at(points: Array, centres: Array, weights: Array, errors: Array) -> Array:
    """Return interpolated numbers ``(n, c)`` plus local errors at points ``(n, d)`` of the unit cube."""
    blocks = [np.zeros((0, weights.shape[1]))]
    nearest = min(2 * (centres.shape[1] + 1), len(centres))
    for first in range(0, len(points), 1000):
        some = points[first : first + 1000]
        squares = (some**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2 * some @ centres.T
        squares = np.maximum(squares, 0)
        tail = np.concatenate([np.ones((len(some), 1)), some], axis=1)
        smooth = np.concatenate([squares * np.sqrt(squares), tail], axis=1) @ weights
        near = np.argpartition(squares, nearest - 1, axis=1)[:, :nearest]
        blocks.append(smooth + errors[near].max(axis=1))
    return np.concatenate(blocks)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Upper bounds of c numbers over the unit cube: interpolated, plus the largest local error."""

    scales: Array  #: what parameters are multiplied by, shape ``(d,)``
    centres: Array  #: the tasks at which the numbers are known, scaled, shape ``(K, d)``
    weights: Array  #: shape ``(K + 1 + d, c)``
    left_out: Array  #: what each number would be if its task were left out, shape ``(K, c)``
    #: by how much that is wrong, shape ``(K, c)``; the largest of the nearest is the local error. Its sign does not
    #: count: what is too large at a task is too small between others.
    errors: Array

    @classmethod
    def through(cls, points: Array, values: Array, scales: Array | None = None) -> Surfaces:
        """Return the surfaces of values ``(K, c)`` at different points ``(K, d)``, K at least d + 2.

        The values are shares of a limit. How far they exceed it does not matter: errors count up to ``SHAPE.enough``.
        If no scales are given, they are chosen.
        """
        K, d = points.shape
        if scales is None:
            scales = _scales(points, values)
        points = points * scales
        tail = np.concatenate([np.ones((K, 1)), points], axis=1)
        matrix = np.zeros((K + 1 + d, K + 1 + d))
        matrix[:K, :K] = scipy.spatial.distance.cdist(points, points) ** 3 + SHAPE.nugget * np.eye(K)
        matrix[:K, K:], matrix[K:, :K] = tail, tail.T
        inverse = np.linalg.inv(matrix)
        weights = inverse[:, :K] @ values
        left_out = values - weights[:K] / np.diag(inverse)[:K, None]
        errors = np.abs(np.minimum(values, SHAPE.enough) - np.minimum(left_out, SHAPE.enough))
        return cls(scales, points, weights, left_out, errors)

    def without(self, outside: Array, checked: int) -> Surfaces:
        """Return these surfaces with the least errors with which hardly any of the points ``(n, d)`` outside is inside.

        The points are those of ``checked`` ones that lie outside of the set.
        """
        for multiple in SHAPE.multiples if checked >= SHAPE.many else SHAPE.multiples[SHAPE.multiples.index(1.0) :]:
            raised = self.with_errors(multiple)
            if (raised(outside) <= 1).all(axis=-1).sum() <= SHAPE.false * checked:
                break
        return raised

    def with_errors(self, multiple: float) -> Surfaces:
        """Return these surfaces with errors that are multiplied."""
        return replace(self, errors=multiple * self.errors)

    def __call__(self, points: Array) -> Array:
        """Return the upper bounds ``(..., c)`` at points ``(..., d)``."""
        scaled = points.reshape(-1, points.shape[-1]) * self.scales
        upper = upper_at(scaled, self.centres, self.weights, self.errors)
        return np.asarray(upper.reshape(*points.shape[:-1], self.weights.shape[1]))


def _scales(points: Array, values: Array) -> Array:
    """Return scales ``(d,)`` with small errors: one after the other is doubled or halved while these fall."""
    rows = np.random.default_rng(0).permutation(len(points))[: SHAPE.scaled]
    points, values = points[rows], values[rows]

    def error(scales: Array) -> float:
        return float(np.sqrt((Surfaces.through(points, values, scales).errors ** 2).mean(axis=0)).sum())

    scales = np.ones(points.shape[1])
    least = error(scales)
    for j, factor in [*product(range(len(scales)), (0.5, 2.0))] * 2:
        while True:
            tried = scales.copy()
            tried[j] *= factor
            if not SHAPE.scales[0] < tried[j] < SHAPE.scales[1] or (smaller := error(tried)) > 0.995 * least:
                break
            scales, least = tried, smaller
    return scales


_EXPORTED = '''# {made_by}. This file needs NumPy alone.
"""The tasks that are trusted: see STATEMENT."""

from __future__ import annotations

import base64
import io

import numpy as np

STATEMENT = {title!r}
NAMES = {names!r}  # the parameters of a task, in this order
LABELS = {labels!r}  # with their units
LOW = np.array({low!r})
HIGH = np.array({high!r})
SCALES = np.array({scales!r})
THRESHOLD = {threshold!r}
CONFIDENCE = {confidence!r}


def _array(text):
    return np.load(io.BytesIO(base64.b64decode(text)), allow_pickle=False)


{source}

def trusted(task):
    """Return whether tasks ``(..., d)`` are trusted ``(...)``, and bounds on their distances ``(...)``.

    A bound is infinity if its task is not trusted.
    """
    task = np.asarray(task, dtype=np.float64)
    if task.ndim == 0 or task.shape[-1] != len(NAMES):
        raise ValueError("a task has the parameters " + ", ".join(NAMES))
    unit = (task - LOW) / (HIGH - LOW)
    inside = ((unit >= 0) & (unit <= 1)).all(axis=-1)
    rows = np.where(inside[..., None], unit, 0.5).reshape(-1, len(NAMES))
    upper = upper_at(rows * SCALES, CENTRES, WEIGHTS, ERRORS).reshape(*inside.shape, -1)
    kept = inside & (upper <= 1).all(axis=-1)
    bound = np.where(kept, THRESHOLD * np.maximum(upper[..., 0], 0), np.inf)
    return kept[()], bound[()]


CENTRES = _array(
    {centres}
)
WEIGHTS = _array(
    {weights}
)
ERRORS = _array(
    {errors}
)
'''


def exported(surfaces: Surfaces, space: TaskSpace, statement: str, threshold: float, confidence: float) -> str:
    """Return the source of a Python module with a function ``trusted``, which needs NumPy alone."""

    def literal(array: Array) -> str:
        buffer = io.BytesIO()
        np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
        text = base64.b64encode(buffer.getvalue()).decode("ascii")
        return "\n    ".join(repr(text[first : first + 100]) for first in range(0, len(text), 100))

    return _EXPORTED.format(
        made_by=MADE_BY,
        source=inspect.getsource(upper_at),
        title=statement,
        labels=list(space.labels),
        names=list(space.names),
        low=space.low.tolist(),
        high=space.high.tolist(),
        scales=surfaces.scales.tolist(),
        threshold=threshold,
        confidence=confidence,
        centres=literal(surfaces.centres),
        weights=literal(surfaces.weights),
        errors=literal(surfaces.errors),
    )


# The largest boxes inside a set of tasks


@dataclass(frozen=True)
class TrustedRegion:
    """A box of tasks, or a half-space if it has one limit."""

    #: the lower and the upper limit of parameters, or of a sum or a difference such as ``goal - start``, by their
    #: labels; None if there is no limit on that side
    limits: dict[str, tuple[float | None, float | None]]
    share: float  #: the share of the tasks that it holds

    @property
    def text(self) -> str:
        """The limits in words."""
        texts = []
        for label, (low, high) in self.limits.items():
            name, unit = parted(label)
            if low is None:
                text = f"{name} below {high:g} {unit}"
            elif high is None:
                text = f"{name} above {low:g} {unit}"
            elif low == -high:
                text = f"|{name}| below {high:g} {unit}"
            else:
                text = f"{name} from {low:g} to {high:g} {unit}"
            texts.append(text.rstrip())
        return " and ".join(texts) or "all tasks"

    def to_json(self) -> dict[str, Any]:
        """Return the limits and the share, ready for JSON."""
        return {"limits": {label: list(ends) for label, ends in self.limits.items()}, "share": self.share}


def regions_inside(
    space: TaskSpace, unit: Array, inside: Mask, contains: Callable[[Array], Mask]
) -> tuple[TrustedRegion, ...]:
    """Return the largest regions inside a set, the largest first, each without most of the tasks of those before.

    The points ``unit`` ``(N, d)`` have the distribution of the tasks; ``inside`` ``(N,)`` and ``contains`` say which
    points lie inside the set.
    """
    if not inside.any():
        return ()
    labels, sides = _sides(space)
    rng = np.random.default_rng(0)
    values = space.from_unit(unit) @ sides.T
    corners = np.sort([sides * space.low, sides * space.high], axis=0)
    ends = corners.sum(axis=2)  # the smallest and the largest value of each side in the task space, (2, m)
    outside, left, regions = values[~inside], inside.copy(), []
    for _ in range(SHAPE.regions):
        seeds = np.flatnonzero(left)
        if len(seeds) < SHAPE.least * len(unit):
            break
        seeds = rng.permutation(seeds)[:_SEEDS]
        speeds = np.exp(rng.normal(scale=1.5, size=(len(seeds), len(labels))))
        for k in range(SHAPE.rounds):
            reach = 0.98 - 0.02 * k
            grown = [_grown(values[s], outside, ends, v, reach) for s, v in zip(seeds, speeds, strict=True)]
            counts = np.array([(left & _within(values, box)).sum() for box in grown])
            best = np.argsort(-counts, kind="stable")[:_BEST]
            seeds, speeds = seeds[best], speeds[best]
            box = _rounded(grown[int(counts.argmax())], ends)
            tried = _tasks_within(space, sides, box, rng)
            wrong = tried[~contains(tried)]
            if not len(wrong):
                break
            outside = np.concatenate([outside, space.from_unit(wrong) @ sides.T])
        else:
            break
        held = _within(values, box)
        if (held & left).sum() < SHAPE.least * len(unit):
            break
        limits = {}
        for label, (low, high), (first, last) in zip(labels, box.T, ends.T, strict=True):
            if low > first or high < last:  # the limits that are not those of the task space
                below = float(f"{low:.9g}") if low > first else None
                limits[label] = (below, float(f"{high:.9g}") if high < last else None)
        regions.append(TrustedRegion(limits, float(held.mean())))
        left &= ~held
    return tuple(sorted(regions, key=lambda region: -region.share))


def _sides(space: TaskSpace) -> tuple[list[str], Array]:
    """Return the labels of what is limited, and its coefficients of the parameters ``(m, d)``."""
    d = space.dimension
    labels, rows = list(space.labels), list(np.eye(d))
    for i, j in combinations(range(d), 2):
        (first, unit), (second, other) = parted(space.labels[i]), parted(space.labels[j])
        if unit and unit == other:
            for sign in (-1.0, 1.0):
                labels.append(f"{second} {'-' if sign < 0 else '+'} {first} [{unit}]")
                rows.append(np.eye(d)[j] + sign * np.eye(d)[i])
    return labels, np.array(rows)


def _grown(start: Array, outside: Array, ends: Array, speeds: Array, reach: float) -> Array:
    """Return the limits ``(2, m)`` of a box around values; each side grows at its speed until tasks outside stop it."""
    away = (outside - start) / ((ends[1] - ends[0]) * speeds)  # times at which a side meets each task
    box = ends.copy()
    blocked = np.ones(len(outside), dtype=bool)  # tasks that no side keeps out yet
    while blocked.any():
        # The task that is met first, and the side that meets it last and so can keep it out.
        rows = np.flatnonzero(blocked)
        first = rows[np.abs(away[rows]).max(axis=1).argmin()]
        side = int(np.abs(away[first]).argmax())
        limit = start[side] + reach * (outside[first, side] - start[side])
        if away[first, side] >= 0:
            box[1, side] = min(box[1, side], limit)
            blocked &= outside[:, side] < box[1, side]
        else:
            box[0, side] = max(box[0, side], limit)
            blocked &= outside[:, side] > box[0, side]
    return box


def _within(values: Array, box: Array) -> Mask:
    return np.asarray(((values >= box[0]) & (values <= box[1])).all(axis=1))


def _rounded(box: Array, ends: Array) -> Array:
    step = 10.0 ** np.floor(np.log10(ends[1] - ends[0]) - _DIGITS + 1)
    low = np.where(box[0] > ends[0], np.ceil(box[0] / step) * step, ends[0])
    high = np.where(box[1] < ends[1], np.floor(box[1] / step) * step, ends[1])
    return np.stack([low, high])


def _tasks_within(space: TaskSpace, sides: Array, box: Array, rng: np.random.Generator) -> Array:
    """Return tasks in a box, points of the unit cube ``(n, d)``, of which many lie on its sides."""
    d = space.dimension
    low, high = np.maximum(box[0, :d], space.low), np.minimum(box[1, :d], space.high)
    shares = rng.random((4 * SHAPE.checked, d))
    on_sides = rng.random(shares.shape) < rng.random((len(shares), 1))
    on_sides[::2] = False
    points = low + np.where(on_sides, np.round(shares), shares) * (high - low)
    kept = points[_within(points @ sides.T, box)][: SHAPE.checked]
    return np.clip(space.to_unit(kept), 0, 1)
