"""Residual dynamics learned from executions.

An execution shows a whole trajectory of transitions (x, u, x'). From them ``r(x, u) = x' - M(x, u)`` is learned, and
``M_hat = M + r`` is a model again.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.representation import call
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.gp import kernels
from ctxval.gp.regression import log_likelihood_of_outputs
from ctxval.models.scaling import spread, standardised_pairs

_CENTRES = 450
"""Transitions that the residual is conditioned on at most."""
_LEARNED_FROM = 120
"""Transitions that its hyperparameters are learned from."""
_MUCH_BETTER = 0.7
"""What is learned without M must have this share of the error, at most, to be preferred."""
_NEGLIGIBLE = 1e-7
"""A residual below this share of the state's typical change is rounding."""
_ABSURD = 1e100
"""What is larger has diverged, and squares of it would not be finite."""
_REACH = 5.0
"""No residual is believed beyond this many times the largest one recorded."""
_LOOKS = 12
"""Moments of a predicted trajectory at which its familiarity is judged."""
_NOISE = (1e-9, 0.1)
"""Bounds of the noise variance, as a share of the residual's mean square; the least keeps the Cholesky factor safe."""
_KERNEL = kernels.Sum(
    kernels.Matern(2.5, ard=True, length_scale=(0.2, 200.0), variance=(1e-6, 1e4)),
    kernels.Linear(centre=0.0, variance=(1e-6, 1e4)),
)


@dataclass(frozen=True, eq=False)
class Residual:
    """The posterior mean of a Gaussian process for each state's ``r(x, u)``; they share a covariance.

    Attributes:
        theta: logarithms of the hyperparameters of a Matern 5/2 kernel, a length-scale for each column, and a linear
            kernel.
        noise: variance of the outputs' noise.
        centres: standardised state-input pairs that it is conditioned on, shape ``(M, n + m)``.
        outputs: standardised residuals there, shape ``(M, n)``.
        sources: which execution each is of; -1 for data that the model came with, shape ``(M,)``.
        shift_in, scale_in: of the state-input pair, shapes ``(n + m,)``.
        scale_out: of the residual, shape ``(n,)``.
        limit: the largest standardised residual believed, shape ``(n,)``.
        unit: a standardised residual of 1 as a share of a typical step of the system.
        spare: more pairs, outputs and sources, which stand in where an execution is left out; None where one is.
    """

    theta: Array
    noise: float
    centres: Array
    outputs: Array
    sources: Rows
    shift_in: Array
    scale_in: Array
    scale_out: Array
    limit: Array
    unit: float
    spare: tuple[Array, Array, Rows] | None = None

    @functools.cached_property
    def _factor(self) -> Array:
        covariance = _KERNEL(self.theta, self.centres, self.centres)
        noise = self.noise
        while True:
            try:
                return np.asarray(cho_factor(covariance + noise * np.eye(len(covariance)), lower=True)[0])
            except LinAlgError:  # centres too much alike for so little noise
                noise *= 10

    @functools.cached_property
    def _inverse_factor(self) -> Array:
        return np.asarray(solve_triangular(self._factor, np.eye(len(self.centres)), lower=True))

    @functools.cached_property
    def _weights(self) -> Array:
        return np.asarray(cho_solve((self._factor, True), self.outputs))

    @functools.cached_property
    def _scaled(self) -> tuple[Array, Array, Array]:
        """What every evaluation needs: centres over length-scales, weights of the Matern and of the linear part."""
        variance, scales, constant, slope = _parts(self.theta)
        linear = np.vstack([constant * self._weights.sum(axis=0), slope * (self.centres.T @ self._weights)])
        return self.centres / scales, variance * self._weights, linear

    def inputs(self, x: Array, u: Array) -> Array:
        """Return standardised pairs ``(..., n + m)``."""
        return standardised_pairs(x, u, self.shift_in, self.scale_in)

    def __call__(self, x: Array, u: Array) -> Array:
        """Return r, shapes ``(..., n), (..., m) -> (..., n)``."""
        z = self.inputs(x, u)
        rows = z.reshape(-1, z.shape[-1])
        centres, weights, linear = self._scaled
        scales = np.exp(self.theta[1:-2])
        output = _matern(cdist(rows / scales, centres)) @ weights + linear[0] + rows @ linear[1:]
        bounded = np.clip(output, -self.limit, self.limit)
        return np.asarray((self.scale_out * bounded).reshape(x.shape))

    def variance(self, x: Array, u: Array) -> Array:
        """Return the posterior variance of the standardised residual, ``(...)``."""
        z = self.inputs(x, u)
        rows = z.reshape(-1, z.shape[-1])
        half = self._inverse_factor @ _KERNEL(self.theta, self.centres, rows)
        variance = _KERNEL.diagonal(self.theta, rows) - np.einsum("ij,ij->j", half, half)
        return np.asarray(np.maximum(variance, 0.0).reshape(z.shape[:-1]))

    def unfamiliarity(self, trajectory: Trajectory) -> Array:
        """Return how uncertain a step along trajectories is, as a share of a typical step, ``(...)``."""
        at = np.linspace(0, trajectory.horizon - 1, min(_LOOKS, trajectory.horizon)).astype(int)
        variance = self.variance(trajectory.states[..., at, :], trajectory.inputs[..., at, :])
        return np.asarray(self.unit * np.sqrt(variance.mean(axis=-1)))

    def typical_error(self) -> float:
        """Return the error of a step, median over the centres, each left out: a share of a typical step.

        Rasmussen and Williams 2006, eq. 5.12.
        """
        left_out = self._weights / (self._inverse_factor**2).sum(axis=0)[:, None]
        return self.unit * float(np.median(np.sqrt((left_out**2).mean(axis=1))))

    def without(self, sources: Collection[int]) -> Residual:
        """Return the residual as it is without some executions."""
        spare = () if self.spare is None else (self.spare,)
        parts = zip((self.centres, self.outputs, self.sources), *spare, strict=True)
        centres, outputs, of = (np.concatenate(part) for part in parts)
        kept = ~np.isin(of, list(sources))
        return replace(self, centres=centres[kept], outputs=outputs[kept], sources=of[kept], spare=None)

    def __repr__(self) -> str:
        return call(self, centres=self.centres, outputs=self.outputs, noise=self.noise)


def _parts(theta: Array) -> tuple[float, Array, float, float]:
    """Return Matern variance, length-scales, and the linear kernel's constant and slope variances."""
    values = np.exp(theta)
    return float(values[0]), values[1:-2], float(values[-2]), float(values[-1])


def _matern(r: Array) -> Array:
    """Return the Matern 5/2 covariance of distances, which are overwritten."""
    r *= np.sqrt(5.0)
    decay = np.exp(-r)
    decay *= 1 + r * (1 + r / 3)
    return decay


def learn_residual(model: Model, transitions: Transitions, sources: Rows, centres: int = _CENTRES) -> Residual | None:
    """Learn ``r(x, u) = x' - M(x, u)`` from recorded transitions; None where there is nothing to be learned.

    Args:
        model: M.
        transitions: of the system, N of them.
        sources: which execution each is of, shape ``(N,)``.
        centres: how many transitions it is conditioned on at most.
    """
    with np.errstate(all="ignore"):
        residuals = transitions.x_next - model.step(transitions.x, transitions.u)
        steps = transitions.x_next - transitions.x
    pairs = np.concatenate([transitions.x, transitions.u], axis=1)
    usable = (np.abs(np.concatenate([pairs, residuals, steps], axis=1)) < _ABSURD).all(axis=1)
    if usable.sum() < 2:
        return None
    pairs, residuals, sources, steps = pairs[usable], residuals[usable], sources[usable], spread(steps[usable])
    sizes = np.sqrt((residuals**2).mean(axis=0))
    learned = sizes > _NEGLIGIBLE * steps
    if not learned.any():
        return None
    shift, scale = pairs.mean(axis=0), spread(pairs)
    Z, Y = (pairs - shift) / scale, residuals / np.where(learned, sizes, np.inf)
    with single_threaded():
        theta, noise = _most_likely(Z, Y[:, learned])
        chosen = _well_spread(theta, noise, Z, centres)
        others = np.setdiff1d(np.arange(len(Z)), chosen)
        spare = others[_well_spread(theta, noise, Z[others], centres // 3)]
    return Residual(
        *(theta, noise, Z[chosen], Y[chosen], sources[chosen], shift, scale),
        scale_out=np.where(learned, sizes, 0.0),
        limit=_REACH * np.abs(Y).max(axis=0),
        unit=float(np.sqrt(((sizes / steps)[learned] ** 2).mean())),
        spare=(Z[spare], Y[spare], sources[spare]),
    )


def _most_likely(Z: Array, Y: Array) -> tuple[Array, float]:
    """Return the hyperparameters and the noise that make outputs ``(N, n)`` of well-spread inputs most likely."""
    start = np.log([1.0, *[3.0] * Z.shape[1], 0.1, 0.1, 1e-6])
    rows = _well_spread(start[:-1], _NOISE[0], Z, _LEARNED_FROM)
    Z, Y = Z[rows], Y[rows]

    def negative(theta: Array) -> tuple[float, Array]:
        try:
            value, gradient = log_likelihood(theta, Z, Y)
        except LinAlgError:
            return 1e25, np.zeros_like(theta)
        return -value, -gradient

    bounds = [*_KERNEL.bounds(Z.shape[1]), (float(np.log(_NOISE[0])), float(np.log(_NOISE[1])))]
    found = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60})
    return np.asarray(found.x[:-1]), float(np.exp(found.x[-1]))


def log_likelihood(theta: Array, Z: Array, Y: Array) -> tuple[float, Array]:
    """Return ``sum_o log p(Y[:, o] | Z, theta)``, but for a constant, and its gradient (Rasmussen and Williams, 5.9).

    The last of theta is the logarithm of the noise variance.
    """
    K = _KERNEL(theta[:-1], Z, Z)
    noise = float(np.exp(theta[-1]))
    K[np.diag_indices_from(K)] += noise
    value, W = log_likelihood_of_outputs(K, Y)
    return value, np.append(_KERNEL.weighted_gradient(theta[:-1], Z, W), noise * np.trace(W))


def _well_spread(theta: Array, noise: float, Z: Array, count: int) -> Rows:
    """Return the rows that tell most of all others: those of pivoted Cholesky, each the least certain of what is left.

    Fewer than ``count`` where the rest adds nothing.
    """
    left = _KERNEL.diagonal(theta, Z)
    columns = np.zeros((min(count, len(Z)), len(Z)))
    chosen: list[int] = []
    for k in range(len(columns)):
        pivot = int(np.argmax(left))
        if left[pivot] <= 0.1 * noise:
            break
        row = _KERNEL(theta, Z[pivot : pivot + 1], Z)[0] - columns[:k, pivot] @ columns[:k]
        columns[k] = row / np.sqrt(left[pivot])
        left = left - columns[k] ** 2
        left[pivot] = 0.0
        chosen.append(pivot)
    return np.array(chosen, dtype=np.intp)


class Staying:
    """The model ``x_next = x``: what is left to be learned are the system's own steps."""

    def step(self, x: Array, u: Array) -> Array:
        """Return the state itself."""
        return x


class CorrectedModel:
    """The model ``M_hat(x, u) = M(x, u) + r(x, u)``.

    Args:
        model: M.
        residual: r.
    """

    def __init__(self, model: Model, residual: Residual) -> None:
        self.model = model
        self.residual = residual

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return self.model.step(x, u) + self.residual(x, u)

    def __repr__(self) -> str:
        return call(self, self.model, self.residual)


def learn_corrected(model: Model, transitions: Transitions, sources: Rows, centres: int) -> CorrectedModel | None:
    """Return the corrected model, learned around M or, where that predicts much better, from nothing; None without any.

    Around a model that is rougher than the system, such as a small network, all its kinks would have to be learned.
    """
    of_model = learn_residual(model, transitions, sources, centres)
    if of_model is None:
        return None
    of_steps = learn_residual(Staying(), transitions, sources, centres)
    with single_threaded():
        if of_steps is not None and of_steps.typical_error() < _MUCH_BETTER * of_model.typical_error():
            return CorrectedModel(Staying(), of_steps)
    return CorrectedModel(model, of_model)
