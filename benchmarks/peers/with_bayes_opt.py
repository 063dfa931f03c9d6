"""The package bayesian-optimization (Nogueira 2014), with its defaults: an upper confidence bound, Matern 5/2."""

from __future__ import annotations

import warnings

import numpy as np
from bayes_opt import BayesianOptimization

from ctxval._util.arrays import Array
from peers.recorder import Suggest, Suggesting

INITIAL = 5
"""Random points before the first suggestion, as in its ``maximize``."""


def start(dimension: int, seed: int) -> Suggest:
    """Return the suggestions of an optimiser, which is told what it does not know yet."""
    names = [f"p{i:02d}" for i in range(dimension)]  # it orders parameters as they are given
    bounds = dict.fromkeys(names, (0.0, 1.0))
    search = BayesianOptimization(None, bounds, random_state=seed, verbose=0, allow_duplicate_points=True)
    first = np.random.default_rng(seed).random((INITIAL, dimension))
    told = 0

    def suggest(points: Array, values: Array) -> Array:
        nonlocal told
        for point, value in zip(points[told:], values[told:], strict=True):
            search.register(dict(zip(names, point.tolist(), strict=True)), float(value))
        told = len(points)
        if told < INITIAL:
            return np.asarray(first[told])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # length scales at their bounds
            found = search.suggest()
        return np.array([found[name] for name in names], dtype=np.float64)

    return suggest


bayesian = Suggesting(start)
