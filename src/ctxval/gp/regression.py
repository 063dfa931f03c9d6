"""Exact Gaussian-process regression (the paper's Sec. IV-B; Rasmussen and Williams 2006, algorithm 2.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs
from scipy.optimize import minimize

from ctxval._util.arrays import Array
from ctxval._util.representation import call
from ctxval.errors import InputError, ShapeError
from ctxval.gp.kernels import Kernel

Mean = Callable[[Array], Array]
"""A prior mean: points ``(n, d)`` -> values ``(n,)``."""

LogPrior = Callable[[Array], tuple[float, Array]]
"""A prior of the hyperparameters: theta -> (log density, its gradient)."""

NOISE = 1e-6
"""The least noise variance, for values of unit variance: it keeps the Cholesky factor safe."""

_IMPOSSIBLE = 1e25
_MANY = 30
"""Beyond so many observations the likelihood has one clear mode, and one climb finds it."""
_SMOOTHNESS = np.array([0.25, 0.5, 0.75])


def zero_mean(X: Array) -> Array:
    """Return the paper's prior mean, zero everywhere."""
    return np.zeros(len(X))


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """A Gaussian process conditioned on observations; make one with :func:`condition` or :func:`fit`.

    Attributes:
        kernel, theta: the covariance and the logarithms of its hyperparameters.
        noise: variance of the observations' noise.
        mean: prior mean function.
        X, y: observations, shapes ``(n, d)`` and ``(n,)``.
        L: lower Cholesky factor of ``K + noise I``.
        alpha: ``(K + noise I)^-1 (y - mean(X))``.
    """

    kernel: Kernel
    theta: Array
    noise: float
    mean: Mean
    X: Array
    y: Array
    L: Array
    alpha: Array

    def predict(self, X: Array) -> tuple[Array, Array]:
        """Return the posterior mean and variance of the noise-free function at ``(m, d)``, shapes ``(m,)``."""
        k = self.kernel(self.theta, X, self.X)
        half = dtrtrs(self.L, k.T, lower=1)[0]
        variance = self.kernel.diagonal(self.theta, X) - (half**2).sum(axis=0)
        return self.mean(X) + k @ self.alpha, np.maximum(variance, 0.0)

    def predict_gradient(self, X: Array) -> tuple[Array, Array]:
        """Return the gradients of posterior mean and variance with respect to the points, shapes ``(m, d)``."""
        return self.predict_with_gradient(X)[2:]

    def predict_with_gradient(self, X: Array) -> tuple[Array, Array, Array, Array]:
        """Return mean and variance ``(m,)`` and their gradients ``(m, d)``, for less than the two one by one."""
        k = self.kernel(self.theta, X, self.X)
        dk = self.kernel.input_gradient(self.theta, X, self.X)
        weights = _solve(self.L, k.T).T
        variance = np.maximum(self.kernel.diagonal(self.theta, X) - (k * weights).sum(axis=1), 0.0)
        d_mean = (dk.transpose(0, 2, 1) @ self.alpha) + _mean_gradient(self.mean, X)
        pull = (dk.transpose(0, 2, 1) @ weights[:, :, None])[:, :, 0]
        d_variance = self.kernel.diagonal_input_gradient(self.theta, X) - 2 * pull
        return self.mean(X) + k @ self.alpha, variance, d_mean, d_variance

    def left_out(self) -> tuple[Array, Array]:
        """Return mean and variance ``(n,)`` of each observation given all others.

        Rasmussen and Williams 2006, eq. 5.12.
        """
        precision = np.diag(_inverse(self.L))
        return self.y - self.alpha / precision, 1 / precision

    def log_marginal_likelihood(self) -> float:
        """Return log p(y | X, theta)."""
        return _log_likelihood(self.L, self.alpha, self.y - self.mean(self.X))

    def __repr__(self) -> str:
        return call(self, self.kernel, points=len(self.X), dimension=self.X.shape[1], noise=self.noise)


def _mean_gradient(mean: Mean, X: Array) -> Array:
    """Return the gradient of a prior mean by central differences: it is a plain function."""
    if mean is zero_mean:
        return np.zeros_like(X)
    n, d = X.shape
    moves = 1e-6 * np.eye(d)
    up = mean((X[:, None, :] + moves).reshape(-1, d)).reshape(n, d)
    return (up - mean((X[:, None, :] - moves).reshape(-1, d)).reshape(n, d)) / 2e-6


def condition(
    kernel: Kernel, theta: Array, X: Array, y: Array, *, noise: float = NOISE, mean: Mean = zero_mean
) -> GaussianProcess:
    """Return the process with these hyperparameters, conditioned on observations ``(n, d)``, ``(n,)``.

    Raises:
        ShapeError: X and y do not fit together.
        InputError: the covariance matrix is not positive definite.
    """
    if X.ndim != 2 or y.shape != (len(X),):
        raise ShapeError(f"observations need X (n, d) and y (n,), got {X.shape} and {y.shape}.")
    L = _factor(kernel, theta, noise, X)
    alpha = _solve(L, y - mean(X))
    return GaussianProcess(kernel, np.asarray(theta, dtype=np.float64), noise, mean, X, y, L, alpha)


def _factor(kernel: Kernel, theta: Array, noise: float, X: Array) -> Array:
    covariance = kernel(theta, X, X)
    covariance[np.diag_indices_from(covariance)] += noise
    L, info = dpotrf(covariance, lower=1, clean=1)
    if info or np.isnan(np.trace(L)):  # some LAPACKs let NaN pass
        raise InputError(f"the covariance of {len(X)} observations is not positive definite; raise the noise.")
    return np.asarray(L)


def _solve(L: Array, right: Array) -> Array:
    """Return ``(L L')^-1 right``; LAPACK is called without the checks that cost more than a small solve."""
    return np.asarray(dpotrs(L, right, lower=1)[0])


def _inverse(L: Array) -> Array:
    """Return ``(L L')^-1``."""
    lower = dpotri(L, lower=1)[0]  # L is zero above its diagonal, and stays so
    inverse = lower + lower.T
    inverse[np.diag_indices_from(inverse)] *= 0.5
    return np.asarray(inverse)


def _log_likelihood(L: Array, alpha: Array, residual: Array) -> float:
    fit = -0.5 * residual @ alpha
    return float(fit - np.log(np.diag(L)).sum() - 0.5 * len(L) * np.log(2 * np.pi))


def log_likelihood_of_outputs(K: Array, Y: Array) -> tuple[float, Array]:
    """Return ``sum_o log p(Y[:, o])``, but for a constant, and W, with which ``sum(W * dK)`` is how it changes with K.

    Args:
        K: covariance of the observations, their noise included, ``(n, n)``.
        Y: outputs that share it, ``(n, k)``.

    Raises:
        LinAlgError: the covariance is not positive definite.

    Source:
        Rasmussen and Williams 2006, eqs. 5.8 and 5.9.
    """
    factor = cho_factor(K, lower=True)
    alpha = cho_solve(factor, Y)
    value = -0.5 * (Y * alpha).sum() - Y.shape[1] * np.log(np.diag(factor[0])).sum()
    return float(value), 0.5 * (alpha @ alpha.T - Y.shape[1] * cho_solve(factor, np.eye(len(K))))


def log_marginal_likelihood(
    kernel: Kernel, theta: Array, noise: float, X: Array, residual: Array
) -> tuple[float, Array]:
    """Return log p(residual | X, theta, noise) and its gradient with respect to (theta, log noise).

    ``residual`` is the observations less the prior mean (Rasmussen and Williams 2006, eq. 5.9).
    """
    L = _factor(kernel, theta, noise, X)
    alpha = _solve(L, residual)
    W = _inverse(L)
    W -= np.outer(alpha, alpha)
    W *= -0.5
    gradient = kernel.weighted_gradient(theta, X, W)
    return _log_likelihood(L, alpha, residual), np.append(gradient, noise * np.trace(W))


def fit(
    kernel: Kernel,
    X: Array,
    y: Array,
    *,
    noise: tuple[float, float] = (NOISE, NOISE),
    mean: Mean = zero_mean,
    log_prior: LogPrior | None = None,
    starts: Array | None = None,
) -> GaussianProcess:
    """Return the process with the most likely hyperparameters within the kernel's bounds.

    The prior of the hyperparameters is uniform on the box of the kernel's bounds (line 2 of the paper's algorithm)
    unless ``log_prior`` is given; then its mode is sought.

    Args:
        kernel: the covariance.
        X: observed points ``(n, d)``.
        y: observed values ``(n,)``, about unit variance.
        noise: bounds of the noise variance; equal bounds fix it.
        mean: prior mean function.
        log_prior: density of (theta, log noise).
        starts: where to start the climbs, shape ``(s, len(theta) + 1)``; the default spreads over length-scales.
    """
    bounds = [*kernel.bounds(X.shape[1]), (float(np.log(noise[0])), float(np.log(noise[1])))]
    residual = y - mean(X)

    def negative(parameters: Array) -> tuple[float, Array]:
        theta, variance = parameters[:-1], float(np.exp(parameters[-1]))
        try:
            value, gradient = log_marginal_likelihood(kernel, theta, variance, X, residual)
        except InputError:
            return _IMPOSSIBLE, np.zeros_like(parameters)
        if log_prior is not None:
            prior, prior_gradient = log_prior(parameters)
            value, gradient = value + prior, gradient + prior_gradient
        return -value, -gradient

    starts = _default_starts(bounds) if starts is None else starts
    if len(X) > _MANY:
        starts = starts[[np.argmin([negative(start)[0] for start in starts])]]
    options: Any = {"maxiter": 50, "ftol": 1e-7}
    climbs = [
        minimize(negative, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options) for start in starts
    ]
    best = min(climbs, key=lambda climb: float(climb.fun)).x
    return condition(kernel, best[:-1], X, y, noise=float(np.exp(best[-1])), mean=mean)


def _default_starts(bounds: list[tuple[float, float]]) -> Array:
    """Return starts for rough, middling and smooth functions of middling variance."""
    low, high = np.array(bounds).T
    starts = np.tile(0.5 * (low + high), (len(_SMOOTHNESS), 1))
    starts[:, 1:-1] = low[1:-1] + _SMOOTHNESS[:, None] * (high - low)[1:-1]
    return starts
