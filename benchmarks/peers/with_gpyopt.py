"""GPyOpt, which the paper used, with the paper's kernel and acquisition."""

from __future__ import annotations

import warnings

import GPy
import numpy as np
from GPyOpt.methods import BayesianOptimization

from ctxval._util.arrays import Array
from peers.recorder import Recorder

NEVER = -1.0
"""No step is shorter, so it does not stop where it has converged."""


def gpyopt(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise with its own first design of five points and its own weight of the bound, 2."""
    np.random.seed(seed)  # noqa: NPY002 - GPyOpt draws from there
    domain = [{"name": f"p{i}", "type": "continuous", "domain": (0.0, 1.0)} for i in range(dimension)]

    def losses(points: Array) -> Array:
        return np.array([[-values(point)] for point in points])

    known = {"X": np.array(values.points), "Y": -np.array(values.values)[:, None]} if values.points else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # overflows in its line searches
        search = BayesianOptimization(
            losses,
            domain,
            acquisition_type="LCB",
            kernel=GPy.kern.Matern32(dimension),
            exact_feval=True,
            **known,
        )
        search.run_optimization(budget, eps=NEVER)
