"""The largest boxes and half-spaces inside a set of tasks, in the units of the task parameters.

The sides of a box are limits on parameters and, of two parameters with the same unit, on their sum and difference. A
box without a task outside of the set grows from a task inside it until each side meets such a task. The best one of
many is shrunk where further tasks in it lie outside of the set.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.texts import parted
from ctxval.core.space import TaskSpace

REGIONS = 3  # largest number of regions
LEAST = 0.02  # least share of the tasks that a region holds and no larger one
_SEEDS, _BEST = 100, 10  # tasks from which boxes grow, and those from which they grow again
_CHECKED = 2000  # tasks in a box that must all lie inside the set
_ROUNDS = 30  # times that boxes may grow again, each time to a smaller share of the way to tasks outside
_DIGITS = 3


@dataclass(frozen=True)
class Region:
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
) -> tuple[Region, ...]:
    """Return the largest regions inside a set, the largest first, each without most of the tasks of those before.

    Args:
        unit: tasks, points of the unit cube ``(N, d)``, with the distribution of the tasks.
        inside: which of them lie inside the set, ``(N,)``.
        contains: tells which points ``(n, d)`` of the unit cube lie inside it, ``(n,)``.
    """
    if not inside.any():
        return ()
    labels, sides = _sides(space)
    rng = np.random.default_rng(0)
    values = space.from_unit(unit) @ sides.T
    corners = np.sort([sides * space.low, sides * space.high], axis=0)
    ends = corners.sum(axis=2)  # the smallest and the largest value of each side in the task space, (2, m)
    outside, left, regions = values[~inside], inside.copy(), []
    for _ in range(REGIONS):
        seeds = np.flatnonzero(left)
        if len(seeds) < LEAST * len(unit):
            break
        seeds = rng.permutation(seeds)[:_SEEDS]
        speeds = np.exp(rng.normal(scale=1.5, size=(len(seeds), len(labels))))
        for k in range(_ROUNDS):
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
        if (held & left).sum() < LEAST * len(unit):
            break
        limits = {}
        for label, (low, high), (first, last) in zip(labels, box.T, ends.T, strict=True):
            if low > first or high < last:  # the limits that are not those of the task space
                below = float(f"{low:.9g}") if low > first else None
                limits[label] = (below, float(f"{high:.9g}") if high < last else None)
        regions.append(Region(limits, float(held.mean())))
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
    shares = rng.random((4 * _CHECKED, d))
    on_sides = rng.random(shares.shape) < rng.random((len(shares), 1))
    on_sides[::2] = False
    points = low + np.where(on_sides, np.round(shares), shares) * (high - low)
    kept = points[_within(points @ sides.T, box)][:_CHECKED]
    return np.clip(space.to_unit(kept), 0, 1)
