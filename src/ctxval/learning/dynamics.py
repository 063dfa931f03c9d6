"""Residual dynamics learned from executions.

An execution records a trajectory of transitions (x, u, x'). The residual ``r(x, u) = x' - M(x, u)`` is learned from
them, and ``M_hat = M + r`` is a corrected model.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.representation import call
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.gp import kernels
from ctxval.gp.cholesky import tenfold
from ctxval.gp.regression import MultiOutputProcess, log_likelihood_of_outputs, most_likely
from ctxval.gp.subset import pivoted_rows
from ctxval.learning.residual_data import residual_data
from ctxval.models.scaling import standardised_pairs

_CENTRES = 450
"""Largest number of transitions that the residual is conditioned on."""
_LEARNED_FROM = 120
"""Largest number of transitions from which its hyperparameters are learned."""
_START = 3.0
"""Length-scale, in standard deviations of the inputs, at which the search for the hyperparameters starts."""
_MUCH_BETTER = 0.7
"""Dynamics learned without M are preferred if their error is below this share of the error with M."""
_REACH = 5.0
"""Predicted residuals are limited to this many times the largest one recorded."""
_STEPS_SAMPLED = 12
"""Number of steps of a predicted trajectory from which its unfamiliarity is computed."""
_NOISE = (1e-9, 0.1)
"""Bounds of the noise variance, as a share of the residual's mean square; the lower one keeps the covariance matrix
positive definite."""
_PIVOT = 0.1
"""Variance, as a share of the noise, below which a transition adds nothing to those chosen before it."""
_KERNEL = kernels.Sum(
    kernels.Matern(2.5, ard=True, length_scale=(0.2, 200.0), variance=(1e-6, 1e4)),
    kernels.Linear(centre=0.0, variance=(1e-6, 1e4)),
)


@dataclass(frozen=True, eq=False)
class Residual:
    """The residual ``r(x, u)`` as posterior means of Gaussian processes, one for each state; they share a covariance.

    Attributes:
        theta: logarithms of the hyperparameters of a Matern 5/2 kernel with a length-scale for each column, and of a
            linear kernel.
        noise: variance of the outputs' noise.
        centres: standardised state-input pairs that it is conditioned on, shape ``(M, n + m)``.
        outputs: standardised residuals at the centres, shape ``(M, n)``.
        sources: the execution of each pair; -1 for data that the model was made from, shape ``(M,)``.
        shift_in, scale_in: constants that standardise a state-input pair, shapes ``(n + m,)``.
        scale_out: unit of the standardised residual, shape ``(n,)``; 0 if the residual of a state is negligible.
        limit: the largest standardised residual that is returned, in magnitude, shape ``(n,)``.
        unit: a standardised residual of 1, as a share of a typical step of the system.
        spare: further pairs, outputs and sources, which replace those of executions that are left out; None if they
            are in use already.
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
    def process(self) -> MultiOutputProcess:
        """The Gaussian processes of the standardised residuals."""
        # If centres are too similar for this noise, more noise keeps the covariance matrix positive definite.
        return MultiOutputProcess(_KERNEL, self.theta, self.centres, self.outputs, tuple(tenfold(self.noise)))

    @functools.cached_property
    def _scaled(self) -> tuple[Array, Array, Array]:
        """Constants of every evaluation: centres over length-scales, weights of the Matern and of the linear part."""
        variance, scales, constant, slope = _parts(self.theta)
        weights = self.process.weights
        linear = np.vstack([constant * weights.sum(axis=0), slope * (self.centres.T @ weights)])
        return self.centres / scales, variance * weights, linear

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
        # For many rows, a product with the inverse factor is several times as fast as substitution.
        half = self.process.factor.inverse_factor @ _KERNEL(self.theta, self.centres, rows)
        variance = _KERNEL.diagonal(self.theta, rows) - np.einsum("ij,ij->j", half, half)
        return np.asarray(np.maximum(variance, 0.0).reshape(z.shape[:-1]))

    def unfamiliarity(self, trajectory: Trajectory) -> Array:
        """Return the standard deviation of r along trajectories, as a share of a typical step, ``(...)``."""
        at = np.linspace(0, trajectory.horizon - 1, min(_STEPS_SAMPLED, trajectory.horizon)).astype(int)
        variance = self.variance(trajectory.states[..., at, :], trajectory.inputs[..., at, :])
        return np.asarray(self.unit * np.sqrt(variance.mean(axis=-1)))

    def typical_error(self) -> float:
        """Return the median leave-one-out error of a step over the centres, as a share of a typical step."""
        errors = self.process.factor.left_out_errors(self.process.weights)
        return self.unit * float(np.median(np.sqrt((errors**2).mean(axis=1))))

    def without(self, sources: Collection[int]) -> Residual:
        """Return the residual conditioned without some executions; its hyperparameters do not change."""
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
    """Return the Matern 5/2 covariance of distances; the argument is overwritten."""
    r *= np.sqrt(5.0)
    decay = np.exp(-r)
    decay *= 1 + r * (1 + r / 3)
    return decay


def learn_residual(model: Model, transitions: Transitions, sources: Rows, centres: int = _CENTRES) -> Residual | None:
    """Learn ``r(x, u) = x' - M(x, u)`` from recorded transitions.

    Returns None if fewer than two transitions are usable, or if M explains all of them.

    Args:
        model: the model M.
        transitions: N transitions of the system.
        sources: the execution of each transition; -1 for data that the model was made from, shape ``(N,)``.
        centres: largest number of transitions that the residual is conditioned on.
    """
    data = residual_data(model, transitions, sources)
    if data is None:
        return None
    Z, Y, learned = data.pairs, data.outputs, data.learned
    with single_threaded():
        theta, noise = _most_likely(Z, Y[:, learned])
        chosen = pivoted_rows(_KERNEL, theta, Z, centres, least=_PIVOT * noise)
        others = np.setdiff1d(np.arange(len(Z)), chosen)
        spare = others[pivoted_rows(_KERNEL, theta, Z[others], centres // 3, least=_PIVOT * noise)]
    return Residual(
        *(theta, noise, Z[chosen], Y[chosen], data.sources[chosen], data.shift, data.scale),
        scale_out=data.units,
        limit=_REACH * np.abs(Y).max(axis=0),
        unit=float(np.sqrt(((data.sizes / data.steps)[learned] ** 2).mean())),
        spare=(Z[spare], Y[spare], data.sources[spare]),
    )


def _most_likely(Z: Array, Y: Array) -> tuple[Array, float]:
    """Return the hyperparameters and the noise that make outputs ``(N, n)`` of well-spread inputs most likely."""
    start = np.log([1.0, *[_START] * Z.shape[1], 0.1, 0.1, 1e-6])
    rows = pivoted_rows(_KERNEL, start[:-1], Z, _LEARNED_FROM, least=_PIVOT * _NOISE[0])
    bounds = [*_KERNEL.bounds(Z.shape[1]), (float(np.log(_NOISE[0])), float(np.log(_NOISE[1])))]
    Z, Y = Z[rows], Y[rows]
    found = most_likely(lambda theta: log_likelihood(theta, Z, Y), start[None], bounds)
    return found[:-1], float(np.exp(found[-1]))


def log_likelihood(theta: Array, Z: Array, Y: Array) -> tuple[float, Array]:
    """Return ``sum_o log p(Y[:, o] | Z, theta)`` up to a constant, and its gradient (Rasmussen and Williams, 5.9).

    The last entry of theta is the logarithm of the noise variance.
    """
    noise = float(np.exp(theta[-1]))
    value, W = log_likelihood_of_outputs(_KERNEL(theta[:-1], Z, Z), noise, Y)
    return value, np.append(_KERNEL.weighted_gradient(theta[:-1], Z, W), noise * np.trace(W))


class Identity:
    """The model ``x_next = x``; its residual is the step of the system."""

    def step(self, x: Array, u: Array) -> Array:
        """Return the state itself."""
        return x

    def __repr__(self) -> str:
        return call(self)


class CorrectedModel:
    """The model ``M_hat(x, u) = M(x, u) + r(x, u)``.

    Args:
        model: the model M.
        residual: the residual r.
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
    """Return M plus its residual or, if this predicts much better, a model of the system's steps without M.

    If M is rougher than the system, such as a small network, then its residual has all of its kinks and is harder to
    learn than the steps.

    Returns None if no residual can be learned (see :func:`learn_residual`).

    Args:
        model: the model M.
        transitions: N transitions of the system.
        sources: the execution of each transition; -1 for data that the model was made from, shape ``(N,)``.
        centres: largest number of transitions that a residual is conditioned on.
    """
    of_model = learn_residual(model, transitions, sources, centres)
    if of_model is None:
        return None
    of_steps = learn_residual(Identity(), transitions, sources, centres)
    with single_threaded():
        if of_steps is not None and of_steps.typical_error() < _MUCH_BETTER * of_model.typical_error():
            return CorrectedModel(Identity(), of_steps)
    return CorrectedModel(model, of_model)
