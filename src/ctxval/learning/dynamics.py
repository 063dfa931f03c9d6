"""Residual dynamics learned from executions.

An execution records a trajectory of transitions (x, u, x'). The residual ``r(x, u) = x' - M(x, u)`` is learned from
them, and ``M_hat = M + r`` is a corrected model.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.representation import call
from ctxval.core.model import Model, Step
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.gp import kernels
from ctxval.gp.cholesky import tenfold
from ctxval.gp.regression import MultiOutputProcess, log_likelihood_of_outputs, most_likely
from ctxval.gp.subset import pivoted_rows
from ctxval.learning.residual_data import ResidualData, residual_data
from ctxval.learning.residual_expansion import ResidualExpansion, weights_without
from ctxval.models.scaling import standardised_pairs

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
_TOLERANCE = 1e-6
"""Relative change of the log likelihood at which the search for the hyperparameters ends."""
_REPLACING = (600, 100)
"""Number of unused transitions from which replacements of those that are left out are chosen, and of replacements."""
_ROUGHLY = 0.03
"""Largest error of a rough residual, as a share of the residuals that it predicts."""
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
        centres: standardised state-input pairs that it is conditioned on, shape ``(M, n + m)``; each is the one with
            the largest variance given those before it.
        outputs: standardised residuals at the centres, shape ``(M, n)``.
        sources: the execution of each pair; -1 for data that the model was made from, shape ``(M,)``.
        shift_in, scale_in: constants that standardise a state-input pair, shapes ``(n + m,)``.
        scale_out: unit of the standardised residual, shape ``(n,)``; 0 if the residual of a state is negligible.
        limit: the largest standardised residual that is returned, in magnitude, shape ``(n,)``.
        unit: a standardised residual of 1, as a share of a typical step of the system.
        unused: further pairs, outputs and sources, some of which replace those of executions that are left out.
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
    unused: tuple[Array, Array, Rows]

    @functools.cached_property
    def process(self) -> MultiOutputProcess:
        """The Gaussian processes of the standardised residuals."""
        # If centres are too similar for this noise, more noise keeps the covariance matrix positive definite.
        return MultiOutputProcess(_KERNEL, self.theta, self.centres, self.outputs, tuple(tenfold(self.noise)))

    @functools.cached_property
    def _expansion(self) -> ResidualExpansion:
        return ResidualExpansion.of(self.theta, self.centres, self.process.weights)

    def inputs(self, x: Array, u: Array) -> Array:
        """Return standardised pairs ``(..., n + m)``."""
        return standardised_pairs(x, u, self.shift_in, self.scale_in)

    def __call__(self, x: Array, u: Array) -> Array:
        """Return r, shapes ``(..., n), (..., m) -> (..., n)``."""
        return self.in_units(self._expansion, x, u)

    def in_units(self, function: Callable[[Array], Array], x: Array, u: Array) -> Array:
        """Return a function of standardised pairs as a function of states and inputs, in the units of the states."""
        z = self.inputs(x, u)
        found = function(z.reshape(-1, z.shape[-1]))
        np.maximum(found, -self.limit, out=found)
        np.minimum(found, self.limit, out=found)
        found *= self.scale_out
        return found.reshape(x.shape)

    def variance(self, x: Array, u: Array) -> Array:
        """Return the posterior variance of the standardised residual, ``(...)``."""
        z = self.inputs(x, u)
        rows = z.reshape(-1, z.shape[-1])
        # For many rows, a product with the inverse factor is several times as fast as substitution.
        half = self.process.factor.whiten_many(_KERNEL(self.theta, rows, self.centres).T)
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

    def rough(self, centres: int, error: float = _ROUGHLY) -> Residual:
        """Return the residual conditioned on the first centres only, which is cheaper to evaluate.

        If so many centres do not predict the residuals at the others well, twice as many are tried, and so on.

        Args:
            centres: number of centres that are tried first.
            error: largest error, as a share of the residuals at the other centres.
        """
        first = slice(0, centres)
        fewer = replace(self, centres=self.centres[first], outputs=self.outputs[first], sources=self.sources[first])
        others = self.outputs[centres:]
        if not len(others):
            return self
        errors = fewer.process.predict(self.centres[centres:])[0] - others
        return fewer if (errors**2).mean() <= error**2 * (others**2).mean() else self.rough(2 * centres, error)

    def without(self, left_out: Sequence[Collection[int]]) -> ResidualsWithout:
        """Return residuals without some executions, all together; the hyperparameters do not change.

        Args:
            left_out: for each of the residuals, the executions that it does not know.
        """
        some = np.linspace(0, max(0, len(self.unused[0]) - 1), min(_REPLACING[0], len(self.unused[0]))).astype(int)
        least = _PIVOT * self.noise
        spare = some[pivoted_rows(_KERNEL, self.theta, self.unused[0][some], _REPLACING[1], least=least)]
        centres, outputs, sources = (
            np.concatenate([used, unused[spare]])
            for used, unused in zip((self.centres, self.outputs, self.sources), self.unused, strict=True)
        )
        gone = np.array([np.isin(sources, list(without)) for without in left_out])
        covariance = _KERNEL(self.theta, centres, centres)
        weights = weights_without(covariance, self.noise, outputs, gone)
        return ResidualsWithout(self, ResidualExpansion.of(self.theta, centres, weights))

    def __repr__(self) -> str:
        return call(self, centres=self.centres, outputs=self.outputs, noise=self.noise)


@dataclass(frozen=True, eq=False)
class ResidualsWithout:
    """Residuals of which each is conditioned without some executions; the k-th one is for the k-th state of a batch.

    Attributes:
        residual: the residual that knows all executions.
        expansion: the residuals as functions of standardised pairs.
    """

    residual: Residual
    expansion: ResidualExpansion

    def __call__(self, x: Array, u: Array) -> Array:
        """Return the value of each residual at a state of its own, shapes ``(k, n), (k, m) -> (k, n)``."""
        return self.residual.in_units(self.expansion, x, u)

    def __getitem__(self, rows: Rows) -> ResidualsWithout:
        """Return some of the residuals."""
        parts = {name: getattr(self.expansion, name)[rows] for name in ("weights", "linear")}
        return ResidualsWithout(self.residual, replace(self.expansion, **parts))

    def __repr__(self) -> str:
        return call(self, self.residual, len(self.expansion.weights))


@dataclass(frozen=True, eq=False)
class LearnedCovariance:
    """The most likely covariance of the residual of a model, which may be M or none.

    Attributes:
        model: the model to which the residual is added.
        scale: the units of the standardised pairs to which the hyperparameters belong, shape ``(n + m,)``.
        residual: the residual, given the transitions from which the covariance was learned.
    """

    model: Model
    scale: Array
    residual: Residual

    def __repr__(self) -> str:
        return call(self, self.model, error=self.residual.typical_error())


def learn_covariance(
    model: Model, transitions: Transitions, sources: Rows, centres: int, *, of_steps: bool = True
) -> LearnedCovariance | None:
    """Return the most likely covariance of the residual of M or, if this predicts much better, of the system's steps.

    If M is rougher than the system, such as a small network, then its residual has all of its kinks and is harder to
    learn than the steps.

    Returns None if fewer than two transitions are usable, or if M explains all of them.

    Args:
        model: the model M.
        transitions: N transitions of the system.
        sources: the execution of each transition; -1 for data that the model was made from, shape ``(N,)``.
        centres: largest number of transitions that the residuals are conditioned on, whose errors are compared.
        of_steps: whether the system's steps may be learned without M.
    """
    of_model = _learned(model, transitions, sources, centres)
    without = _learned(Identity(), transitions, sources, centres) if of_model is not None and of_steps else None
    if of_model is None or without is None:
        return of_model
    # The few transitions from which hyperparameters are learned could not tell which model errs less.
    with single_threaded():
        better = without.residual.typical_error() < _MUCH_BETTER * of_model.residual.typical_error()
    return without if better else of_model


def _learned(model: Model, transitions: Transitions, sources: Rows, centres: int) -> LearnedCovariance | None:
    data = residual_data(model, transitions, sources)
    if data is None:
        return None
    with single_threaded():
        theta, noise = _most_likely(data.pairs, data.outputs[:, data.learned])
        return LearnedCovariance(model, data.scale, _conditioned(data, theta, noise, centres))


def learn_residual(
    learned: LearnedCovariance, transitions: Transitions, sources: Rows, centres: int
) -> Residual | None:
    """Return the residual of the learned covariance's model, given recorded transitions.

    Returns None if fewer than two transitions are usable, or if the model explains all of them.

    Args:
        learned: the model and the covariance of its residual.
        transitions: N transitions of the system.
        sources: the execution of each transition; -1 for data that the model was made from, shape ``(N,)``.
        centres: largest number of transitions that the residual is conditioned on.
    """
    data = residual_data(learned.model, transitions, sources)
    if data is None:
        return None
    theta = learned.residual.theta.copy()
    theta[1:-2] += np.log(learned.scale / data.scale)
    with single_threaded():
        return _conditioned(data, theta, learned.residual.noise, centres)


def _conditioned(data: ResidualData, theta: Array, noise: float, centres: int) -> Residual:
    """Return the residual, given the transitions that represent all others."""
    Z, Y = data.pairs, data.outputs
    chosen = pivoted_rows(_KERNEL, theta, Z, centres, least=_PIVOT * noise)
    others = np.setdiff1d(np.arange(len(Z)), chosen)
    return Residual(
        *(theta, noise, Z[chosen], Y[chosen], data.sources[chosen], data.shift, data.scale),
        scale_out=data.units,
        limit=_REACH * np.abs(Y).max(axis=0),
        unit=_unit(data),
        unused=(Z[others], Y[others], data.sources[others]),
    )


def _unit(data: ResidualData) -> float:
    """Return a standardised residual of 1 as a share of a typical step."""
    return float(np.sqrt(((data.sizes / data.steps)[data.learned] ** 2).mean()))


def _most_likely(Z: Array, Y: Array) -> tuple[Array, float]:
    """Return the hyperparameters and the noise that make outputs ``(N, n)`` of well-spread inputs most likely."""
    start = np.log([1.0, *[_START] * Z.shape[1], 0.1, 0.1, 1e-6])
    rows = pivoted_rows(_KERNEL, start[:-1], Z, _LEARNED_FROM, least=_PIVOT * _NOISE[0])
    bounds = [*_KERNEL.bounds(Z.shape[1]), (float(np.log(_NOISE[0])), float(np.log(_NOISE[1])))]
    Z, Y = Z[rows], Y[rows]
    found = most_likely(lambda theta: log_likelihood(theta, Z, Y), start[None], bounds, tolerance=_TOLERANCE)
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

    def __init__(self, model: Model, residual: Step) -> None:
        self.model = model
        self.residual = residual

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return self.model.step(x, u) + self.residual(x, u)

    def __repr__(self) -> str:
        return call(self, self.model, self.residual)
