"""EGObox, efficient global optimisation in Rust (Lafage 2022), with its defaults: log expected improvement."""

from __future__ import annotations

import os

import numpy as np

# Read when the library starts its threads; all methods have one.
os.environ.setdefault("RAYON_NUM_THREADS", "1")

import egobox

from ctxval._util.arrays import Array
from peers.recorder import Suggest, Suggesting

INITIAL = 5
"""Points of the first design, if there are not more dimensions; otherwise one more than those, as the library does."""


def start(dimension: int, seed: int) -> Suggest:
    """Return the suggestions, after a Latin hypercube of the library."""
    cube = np.tile([0.0, 1.0], (dimension, 1))
    first = np.asarray(egobox.lhs(cube.tolist(), max(INITIAL, dimension + 1), seed=seed))
    search = egobox.Egor(cube.tolist(), seed=seed)

    def suggest(points: Array, values: Array) -> Array:
        if len(points) < len(first):
            return np.asarray(first[len(points)])
        # A seed of its own for each suggestion: a suggestion depends on nothing but its arguments.
        draw = int(np.random.SeedSequence([seed, len(points)]).generate_state(1)[0])
        return np.asarray(search.suggest(points, -values[:, None], seed=draw)[0])

    return suggest


egor = Suggesting(start)
