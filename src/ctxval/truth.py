"""The true maximum d*, for systems that are simulated and so may be executed as often as one likes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval.arrays import Array
from ctxval.errors import InputError
from ctxval.space import Parameters
from ctxval.validation import Validation


@dataclass(frozen=True, eq=False)
class Truth:
    """The largest distance over the task space, as well as a method can find it.

    Attributes:
        distance: d*.
        parameters: a task that attains it.
        method: how it was found.
    """

    distance: float
    parameters: Parameters
    method: str


def grid_truth(validation: Validation, per_axis: int = 2001, refinements: int = 6) -> Truth:
    """Return the maximum on a dense grid, refined around its best points. Executes S for each grid point.

    Args:
        validation: the map p -> d(p).
        per_axis: grid points on each axis.
        refinements: how often a finer grid is laid around the best points.

    Raises:
        InputError: every execution failed.
    """
    space = validation.space
    points = space.grid(per_axis)
    values = validation.distances(points)
    if np.isnan(values).all():
        raise InputError("the truth is unknown: every execution on the grid failed.")
    cell = (space.high - space.low) / (per_axis - 1)
    best, best_value = points[np.nanargmax(values)], float(np.nanmax(values))
    centres = points[np.argsort(-np.nan_to_num(values, nan=-np.inf))[:8]]
    for _ in range(refinements):
        points = _around(centres, cell, space.low, space.high)
        values = validation.distances(points)
        cell = cell / 4
        centres = points[np.argsort(-np.nan_to_num(values, nan=-np.inf))[:8]]
        if np.nanmax(values) > best_value:
            best, best_value = points[np.nanargmax(values)], float(np.nanmax(values))
    count = f"{per_axis:,} points" + (" an axis" if space.dimension > 1 else "")
    return Truth(best_value, space.parameters(best), f"dense grid of {count}, refined {refinements} times")


def _around(centres: Array, cell: Array, low: Array, high: Array) -> Array:
    """Return a grid of a quarter of the cell around each centre, inside the box."""
    offsets = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * len(cell), indexing="ij"), axis=-1)
    points = centres[:, None, :] + offsets.reshape(-1, len(cell)) * cell
    return np.clip(points.reshape(-1, len(cell)), low, high)
