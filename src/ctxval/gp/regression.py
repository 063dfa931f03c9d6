"""Exact Gaussian-process regression (the paper's Sec. IV-B; Rasmussen and Williams 2006, algorithm 2.1)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows
from ctxval.errors import InputError
from ctxval.gp.cholesky import CholeskyFactor, factorise
from ctxval.gp.kernels import Bounds, Matern

Mean = Callable[[Array], Array]  # a prior mean: points (n, d) -> values (n,)
LogDensity = Callable[[Array], tuple[float, Array]]  # hyperparameters -> the logarithm of their density, its gradient
NOISE = 1e-6  # the least noise variance, for values of unit variance: it keeps the covariance positive definite


def zero_mean(X: Array) -> Array:
    """Return the paper's prior mean, zero everywhere."""
    return np.zeros(len(X))


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """A Gaussian process conditioned on observations; make one with :func:`condition` or :func:`fit`."""

    kernel: Matern
    theta: Array
    noise: float
    mean: Mean
    X: Array  # observed points (n, d)
    y: Array  # observations (n,)
    factor: CholeskyFactor  # of K + noise I
    alpha: Array  # (K + noise I)^-1 (y - mean(X))

    def predict(self, X: Array) -> tuple[Array, Array]:
        """Return the posterior mean and variance of the noise-free function at ``(m, d)``, shapes ``(m,)``."""
        k, variance = _covariances_and_variance(self, X)
        return self.mean(X) + k @ self.alpha, variance

    def predict_with_gradient(self, X: Array) -> tuple[Array, Array, Array, Array]:
        """Return mean and variance ``(m,)`` and their gradients ``(m, d)``; cheaper than two separate calls."""
        k = self.kernel(self.theta, X, self.X)
        dk = self.kernel.input_gradient(self.theta, X, self.X)
        weights = self.factor.solve(k.T).T
        variance = np.maximum(self.kernel.diagonal(self.theta, X) - (k * weights).sum(axis=1), 0.0)
        d_mean = dk.transpose(0, 2, 1) @ self.alpha
        if self.mean is not zero_mean:  # by central differences, since a mean is a function without derivatives
            moves, shape = 1e-6 * np.eye(X.shape[1]), X.shape
            up, down = (self.mean((X[:, None, :] + m).reshape(-1, shape[1])).reshape(shape) for m in (moves, -moves))
            d_mean = d_mean + (up - down) / 2e-6
        pull = (dk.transpose(0, 2, 1) @ weights[:, :, None])[:, :, 0]
        d_variance = self.kernel.diagonal_input_gradient(self.theta, X) - 2 * pull
        return self.mean(X) + k @ self.alpha, variance, d_mean, d_variance

    def left_out(self) -> tuple[Array, Array]:
        """Return mean and variance ``(n,)`` of each observation given all others (Rasmussen and Williams, eq. 5.12)."""
        precisions = (self.factor.inverse_factor**2).sum(axis=0)  # the diagonal of (K + noise I)^-1
        return self.y - self.alpha / precisions, 1 / precisions


@dataclass(frozen=True, eq=False)
class MultiOutputProcess:
    """Gaussian processes of zero mean for several outputs that share a covariance, conditioned on observations."""

    kernel: Matern
    theta: Array
    X: Array  # (n, d)
    Y: Array  # (n, k)
    noise: float = NOISE  # the least noise variance; points that are too similar need more

    @functools.cached_property
    def factor(self) -> CholeskyFactor:
        """The Cholesky factor of ``K + noise I``."""
        return factorise(self.kernel(self.theta, self.X, self.X), self.noise, insist=True)

    @functools.cached_property
    def weights(self) -> Array:
        """``(K + noise I)^-1 Y``, shape ``(n, k)``."""
        return self.factor.solve(self.Y)

    def predict(self, X: Array) -> tuple[Array, Array]:
        """Return the posterior means ``(m, k)`` at ``(m, d)``, and the variance ``(m,)``, which all outputs share."""
        k, variance = _covariances_and_variance(self, X)
        return k @ self.weights, variance

    def left_out(self, rows: Rows) -> Array:
        """Return the means ``(m, k)`` of some observations, each given all others (Rasmussen and Williams, 5.12)."""
        return np.asarray(self.Y[rows] - self.weights[rows] / self.factor.precisions_of(rows)[:, None])


def _covariances_and_variance(process: GaussianProcess | MultiOutputProcess, X: Array) -> tuple[Array, Array]:
    """Return the covariances ``(m, n)`` of points ``(m, d)`` with the observations, and the posterior variance."""
    k = process.kernel(process.theta, X, process.X)
    half = process.factor.whiten(k.T)
    return k, np.maximum(process.kernel.diagonal(process.theta, X) - (half**2).sum(axis=0), 0.0)


def condition(
    kernel: Matern, theta: Array, X: Array, y: Array, *, noise: float = NOISE, mean: Mean = zero_mean
) -> GaussianProcess:
    """Return the process with these hyperparameters, conditioned on observations ``(n, d)``, ``(n,)``."""
    factor = factorise(kernel(theta, X, X), noise)
    alpha = factor.solve(y - mean(X))
    return GaussianProcess(kernel, np.asarray(theta, dtype=np.float64), noise, mean, X, y, factor, alpha)


def log_likelihood_of_outputs(K: Array, noise: float, Y: Array) -> tuple[float, Array]:
    """Return ``sum_o log p(Y[:, o])`` of outputs that share K, up to a constant, and its derivative by K (eq. 5.9)."""
    factor = factorise(K, noise)
    alpha = factor.solve(Y)
    value = -0.5 * (Y * alpha).sum() - Y.shape[1] * factor.half_log_determinant()
    return float(value), 0.5 * (alpha @ alpha.T - Y.shape[1] * factor.solve(np.eye(len(K))))


def log_marginal_likelihood(
    kernel: Matern, theta: Array, noise: float, X: Array, residual: Array
) -> tuple[float, Array]:
    """Return log p(residual | X, theta, noise) of y - mean(X), and its gradient by (theta, log noise), eq. 5.9."""
    factor = factorise(kernel(theta, X, X), noise)
    alpha = factor.solve(residual)
    W = factor.inverse()
    W -= np.outer(alpha, alpha)
    W *= -0.5
    gradient = kernel.weighted_gradient(theta, X, W)
    value = -0.5 * residual @ alpha - factor.half_log_determinant() - 0.5 * len(alpha) * np.log(2 * np.pi)
    return float(value), np.append(gradient, noise * np.trace(W))


def fit(
    kernel: Matern,
    X: Array,
    y: Array,
    *,
    noise: tuple[float, float] = (NOISE, NOISE),
    mean: Mean = zero_mean,
    log_prior: LogDensity | None = None,
    starts: Array | None = None,
) -> GaussianProcess:
    """Return the process with the most likely hyperparameters within the kernel's bounds.

    By default the prior of the hyperparameters is uniform within the kernel's bounds (line 2 of the paper's algorithm).
    With the log density of another prior of (theta, log noise), the result is the mode of the posterior. The values
    ``(n,)`` have about unit variance, and the noise variance has bounds. The climbs start at rows (theta, log noise),
    by default those of rough, middling and smooth functions.
    """
    bounds = [*kernel.bounds(X.shape[1]), (float(np.log(noise[0])), float(np.log(noise[1])))]
    residual = y - mean(X)

    def log_density(parameters: Array) -> tuple[float, Array]:
        noise_variance = float(np.exp(parameters[-1]))
        value, gradient = log_marginal_likelihood(kernel, parameters[:-1], noise_variance, X, residual)
        if log_prior is None:
            return value, gradient
        prior, prior_gradient = log_prior(parameters)
        return value + prior, gradient + prior_gradient

    if starts is None:
        low, high = np.array(bounds).T
        starts = np.tile(0.5 * (low + high), (3, 1))
        starts[:, 1:-1] = low[1:-1] + np.array([[0.25], [0.5], [0.75]]) * (high - low)[1:-1]
    many = len(X) > 30  # then the likelihood has one clear mode, and one climb finds it
    best = most_likely(log_density, starts, bounds, best_start=many, iterations=50, tolerance=1e-7)
    return condition(kernel, best[:-1], X, y, noise=float(np.exp(best[-1])), mean=mean)


def most_likely(
    log_density: LogDensity,
    starts: Array,
    bounds: Bounds,
    *,
    best_start: bool = False,
    iterations: int = 60,
    tolerance: float | None = None,
) -> Array:
    """Return the hyperparameters of largest density within bounds, by climbs with L-BFGS-B from starts ``(s, k)``.

    Hyperparameters for which the density raises an InputError, because the covariance matrix is not positive definite,
    are impossible. The tolerance is the relative change of the log density at which a climb ends. With ``best_start``,
    only the most likely start is climbed from.
    """

    def negative(parameters: Array) -> tuple[float, Array]:
        try:
            value, gradient = log_density(parameters)
        except InputError:
            return 1e25, np.zeros_like(parameters)
        return -value, -gradient

    if best_start:
        starts = starts[[np.argmin([negative(start)[0] for start in starts])]]
    limits: Any = {"maxiter": iterations, **({} if tolerance is None else {"ftol": tolerance})}
    settings: Any = {"jac": True, "method": "L-BFGS-B", "bounds": bounds, "options": limits}
    climbs = [scipy.optimize.minimize(negative, start, **settings) for start in starts]
    return np.asarray(min(climbs, key=lambda climb: float(climb.fun)).x)
