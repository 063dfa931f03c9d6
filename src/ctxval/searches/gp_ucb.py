"""The paper's search: GP-UCB."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.checked import NonNegativeFloat, PositiveFloat, PositiveInt
from ctxval._util.registry import part
from ctxval.gp.acquisition import Uncertainty, UpperConfidenceBound, maximise
from ctxval.gp.kernels import Matern
from ctxval.gp.regression import NOISE, Mean
from ctxval.gp.surrogate import Surrogate, fit_surrogate, kept_rows
from ctxval.searches.base import SequentialSearch, best_first


@part("gp-ucb")
class GPUCB(SequentialSearch):
    """Bayesian optimisation with the GP upper confidence bound (Algorithm 1, eqs. 9 and 10).

    From 1,000 points on, the surrogate is fitted to 500 of them: the largest values, the latest, and well-spread ones.

    Args:
        beta: confidence parameter of eq. 10.
        initial: number of random points at the start.
        kernel: covariance of the surrogate; Matern 3/2 with one length-scale by default.
        noise: bounds of the noise variance relative to that of the values; equal bounds fix it. Widen them for a
            stochastic system.
        prior_mean: prior mean of the distance as a function of unit-cube points ``(n, d) -> (n,)``; see
            :meth:`ctxval.TaskSpace.unit_function`. The mean of the values by default.
    """

    def __init__(
        self,
        beta: NonNegativeFloat = 2.0,
        initial: PositiveInt = 5,
        *,
        kernel: Matern | None = None,
        noise: tuple[PositiveFloat, PositiveFloat] = (NOISE, NOISE),
        prior_mean: Mean | None = None,
    ) -> None:
        self.beta, self.initial, self.kernel = beta, initial, Matern(1.5) if kernel is None else kernel
        self.noise, self.prior_mean = noise, prior_mean

    def propose(self, rng: np.random.Generator) -> Array:
        """Return a random point at first, then the maximiser of the upper confidence bound."""
        values = self.values
        if len(values) < self.initial or np.isfinite(values).sum() < 2:
            return rng.random(self.dimension)
        with single_threaded():
            process, known = self.surrogate().process, best_first(self.points, values)
            bound = UpperConfidenceBound(process, self.beta)
            point = maximise(bound, self.dimension, known, rng)
            if bound(point[None])[0] - process.y.max() <= 1e-3:
                # The bound predicts no improvement worth an execution, so the rest of the budget explores.
                point = maximise(Uncertainty(process), self.dimension, known, rng)
            return point

    def surrogate(self) -> Surrogate:
        """Return the GP conditioned on the history."""
        points, values = self.points, self.values
        rows = kept_rows(points, values, 500)
        return fit_surrogate(points[rows], values[rows], self.kernel, noise=self.noise, prior_mean=self.prior_mean)
