"""What the tests of several searches share: a function, and a loop that asks and tells."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval.searches import Search

Function = Callable[[np.ndarray], float]


def hill(x: np.ndarray) -> float:
    """Return a function whose maximum, 0, is at 0.3 on every axis."""
    return -float(((x - 0.3) ** 2).sum())


def run(search: Search, function: Function, budget: int, dimension: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    search.reset(dimension, seed)
    points, values = np.empty((0, dimension)), np.empty(0)
    for _ in range(budget):
        point = search.ask(1)
        value = function(point[0])
        search.tell(point, [value])
        points, values = np.concatenate([points, point]), np.append(values, value)
    return points, values
