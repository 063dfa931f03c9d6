"""A Gaussian process of the increment of the state, learned from data."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, single_threaded
from ctxval._util.checked import NonNegativeInt, PositiveInt, checked
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Transitions
from ctxval.errors import ShapeError
from ctxval.gp.cholesky import factorise
from ctxval.gp.regression import log_likelihood_of_outputs, most_likely
from ctxval.models.scaling import IncrementModel, IncrementScaling
from ctxval.models.smooth_maps import Slopes, SmoothMap, kernel_sum


@dataclass(frozen=True, eq=False)
class SquaredExponential(ShortRepr):
    """``v exp(-1/2 sum_j ((z_j - z'_j) / l_j)^2)``, with length-scales l ``(k,)``: rigid bodies move smoothly."""

    variance: float
    length_scales: Array

    def __call__(self, z: Array, centres: Array) -> Array:
        a, b = z / self.length_scales, centres / self.length_scales
        exponent = a @ b.T
        exponent -= 0.5 * (a**2).sum(axis=1)[:, None]
        exponent -= 0.5 * (b**2).sum(axis=1)
        np.minimum(exponent, 0.0, out=exponent)  # rounding may leave a point at a distance from itself
        return np.asarray(self.variance * np.exp(exponent, out=exponent))


@part()
class GaussianProcessModel(IncrementModel):
    """The posterior mean of Gaussian processes, one for each state's increment, that share a covariance.

    Sharing it lets one Cholesky factor and one matrix of covariances serve all states.

    Args:
        covariance: of standardised state-input pairs.
        centres: the standardised pairs that it was conditioned on, shape ``(M, n + m)``.
        weights: ``(K + noise I)^-1 Y``, shape ``(M, n)``.
        scaling: of the state-input pair and of the increment.
        data: the transitions that it was learned from, if any.
    """

    def __init__(
        self,
        covariance: SquaredExponential,
        centres: ArrayLike,
        weights: ArrayLike,
        scaling: IncrementScaling,
        data: Transitions | None = None,
    ) -> None:
        self.covariance = covariance
        self.centres: Array = as_finite("centres", centres)
        self.weights: Array = as_finite("weights", weights)
        self.scaling = scaling
        self.data = data
        pair, states = len(scaling.shift_in), len(scaling.shift_out)
        fits = self.centres.ndim == 2 and self.weights.shape == (len(self.centres), states)
        if not fits or self.centres.shape[1] != pair or covariance.length_scales.shape != (pair,):
            wanted = f"centres (M, {pair}), weights (M, {states}) and length-scales ({pair},)"
            got = f"{self.centres.shape}, {self.weights.shape} and {covariance.length_scales.shape}"
            raise ShapeError(f"a model of {states} states needs {wanted}, got {got}.")

    @classmethod
    @checked
    def fit(
        cls, data: Transitions, points: PositiveInt = 400, *, seed: NonNegativeInt = 0, iterations: PositiveInt = 100
    ) -> GaussianProcessModel:
        """Condition on recorded transitions, with the most likely hyperparameters (eq. 5.8, summed over the states).

        So many points are drawn at random; the effort grows with their cube.
        """
        scaling = IncrementScaling.of(data)
        rows = np.random.default_rng(seed).permutation(len(data))[:points]
        Z, Y = scaling.inputs(data.x, data.u)[rows], scaling.targets(data)[rows]
        with single_threaded():
            # Bounds of the variance, the noise variance and the length-scales, of standardised pairs and increments.
            boxes = [(1e-2, 1e4), (1e-6, 1.0), *[(0.1, 100.0)] * Z.shape[1]]
            bounds = [(float(np.log(low)), float(np.log(high))) for low, high in boxes]
            start = np.log([1.0, 1e-3, *[3.0] * Z.shape[1]])
            theta = most_likely(lambda t: log_likelihood(t, Z, Y), start[None], bounds, iterations=iterations)
            variance, noise, *length_scales = np.exp(theta).tolist()
            covariance = SquaredExponential(variance, np.array(length_scales))
            return cls.conditioned(covariance, noise, Z, Y, scaling, data)

    @classmethod
    def conditioned(
        cls,
        covariance: SquaredExponential,
        noise: float,
        Z: Array,
        Y: Array,
        scaling: IncrementScaling,
        data: Transitions | None = None,
    ) -> GaussianProcessModel:
        """Return the model of standardised pairs ``(M, n + m)`` and increments ``(M, n)`` with a known covariance."""
        return cls(covariance, Z, factorise(covariance(Z, Z), noise).solve(Y), scaling, data)

    @functools.cached_property
    def _map(self) -> SmoothMap:
        def kernel(Z: Array, centres: Array) -> tuple[Array, Slopes]:
            K = self.covariance(Z, centres)
            return K, lambda: [(K, 1.0, self.covariance.length_scales**-2.0)]

        return kernel_sum(kernel, self.centres, self.weights, block=2048)


def log_likelihood(theta: Array, Z: Array, Y: Array) -> tuple[float, Array]:
    """Return ``sum_o log p(Y[:, o] | Z, theta)`` up to a constant, and its gradient (eqs. 5.8 and 5.9).

    The pairs Z are ``(M, k)``, the outputs Y ``(M, n)``; theta has the logarithms of (variance, noise, length-scales).
    """
    variance, noise, *length_scales = np.exp(theta)
    covariance = SquaredExponential(float(variance), np.array(length_scales))
    K = covariance(Z, Z)
    value, W = log_likelihood_of_outputs(K, float(noise), Y)
    G = W * K
    S = Z / covariance.length_scales
    by_scales = 2 * ((G.sum(axis=1)[:, None] * S**2).sum(axis=0) - (S * (G @ S)).sum(axis=0))
    return value, np.concatenate([[G.sum(), noise * np.trace(W)], by_scales])
