"""Models of the increment of the state, learned from data: a scaling around a network or a Gaussian process."""

from __future__ import annotations

import functools
import itertools
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, rows_of, single_threaded
from ctxval._util.checked import NonNegativeInt, PositiveInt, checked
from ctxval._util.refusals import require_extra
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError
from ctxval.gp.cholesky import factorise
from ctxval.gp.regression import log_likelihood_of_outputs, most_likely
from ctxval.models.smooth_maps import SmoothMap, kernel_sum, relu_network


@dataclass(frozen=True, eq=False)
class IncrementScaling(ShortRepr):
    """The model ``x_next = x + shift_out + scale_out * f(((x, u) - shift_in) / scale_in)`` around a regressor f."""

    shift_in: Array  # of the state-input pair (n + m,)
    scale_in: Array
    shift_out: Array  # of the increment (n,)
    scale_out: Array

    @classmethod
    def of(cls, data: Transitions) -> IncrementScaling:
        """Return the scaling that gives recorded transitions zero mean and unit variance."""
        require_finite(data)
        pairs, increments = np.concatenate([data.x, data.u], axis=1), data.x_next - data.x
        shift_in, shift_out = pairs.mean(axis=0), increments.mean(axis=0)
        return cls(shift_in, standard_deviations(pairs), shift_out, standard_deviations(increments))

    def inputs(self, x: Array, u: Array) -> Array:
        """Return the inputs of f, shape ``(..., n + m)``, for states ``(..., n)`` and inputs ``(..., m)``."""
        return standardised_pairs(x, u, self.shift_in, self.scale_in)

    def targets(self, data: Transitions) -> Array:
        """Return the target outputs of f for recorded transitions, shape ``(N, n)``."""
        return (data.x_next - data.x - self.shift_out) / self.scale_out


class IncrementModel(ShortRepr, ABC):
    """A model with a Jacobian, from a scaling and a differentiable map of standardised pairs."""

    scaling: IncrementScaling

    @property
    @abstractmethod
    def _map(self) -> SmoothMap:
        """The map from standardised pairs ``(N, n + m)`` to standardised increments ``(N, n)``."""

    def step(self, x: Array, u: Array) -> Array:
        z = self.scaling.inputs(x, u)
        outputs = self._map.value(rows_of(z)).reshape(*z.shape[:-1], len(self.scaling.shift_out))
        return x + self.scaling.shift_out + self.scaling.scale_out * outputs

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        z, n = self.scaling.inputs(x, u), len(self.scaling.shift_out)
        gradient = self._map.expanded(rows_of(z))[1].reshape(*z.shape[:-1], n, z.shape[-1])
        whole = self.scaling.scale_out[:, None] * gradient / self.scaling.scale_in
        whole[..., :n] += np.eye(n)
        return whole[..., :n], whole[..., n:]

    def __getstate__(self) -> dict[str, Any]:
        # The map has functions that cannot be pickled; another process makes its own.
        return {name: value for name, value in vars(self).items() if name != "_map"}


def require_finite(data: Transitions) -> None:
    """Refuse transitions from which nothing can be learned."""
    if not len(data) or not all(np.isfinite(part).all() for part in (data.x, data.u, data.x_next)):
        raise InputError("a model needs finite transitions to be learned from, got none, NaN or infinity.")


def standardised_pairs(x: Array, u: Array, shift: Array, scale: Array) -> Array:
    """Return ``((x, u) - shift) / scale``, shape ``(..., n + m)``, for states ``(..., n)`` and inputs ``(..., m)``."""
    batch = x.shape[:-1] if x.shape[:-1] == u.shape[:-1] else np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
    n = x.shape[-1]
    z = np.empty((*batch, n + u.shape[-1]))
    z[..., :n], z[..., n:] = x, u
    if z.shape[-1:] != shift.shape:
        got = f"{n} states and {u.shape[-1]} inputs"
        raise ShapeError(f"the model has {len(shift)} states and inputs together, got {got}.")
    z -= shift
    z /= scale
    return z


def standard_deviations(columns: Array) -> Array:
    """Return the standard deviations, and 1 for a column that does not vary."""
    deviations = columns.std(axis=0)
    return np.where(deviations > 1e-12 * np.maximum(1.0, np.abs(columns).max(axis=0)), deviations, 1.0)


class FeedforwardReLU(IncrementModel):
    """A network with ReLU layers and a linear last layer that predicts the increment of the state.

    Layer i maps z to ``z @ weights[i] + biases[i]``, in the standardised units of the scaling.

    Args:
        weights: one matrix for each layer, shapes ``(n + m, h), (h, h'), ..., (h'', n)``.
        biases: one vector for each layer.
        scaling: the scaling of the state-input pair and of the increment.
        data: the transitions that the model was learned from, if any.

    Raises:
        ShapeError: if the layers do not fit together.
    """

    def __init__(
        self,
        weights: Sequence[ArrayLike],
        biases: Sequence[ArrayLike],
        scaling: IncrementScaling,
        data: Transitions | None = None,
    ) -> None:
        self.weights = [as_finite(f"weights[{i}]", value) for i, value in enumerate(weights)]
        self.biases = [as_finite(f"biases[{i}]", value) for i, value in enumerate(biases)]
        self.scaling, self.data = scaling, data
        pair, states = len(scaling.shift_in), len(scaling.shift_out)
        widths = [pair, *[bias.size for bias in self.biases]]
        shapes = [weight.shape for weight in self.weights]
        if len(widths) < 2 or widths[-1] != states or shapes != list(itertools.pairwise(widths)):
            what = f"a network from {pair} standardised states and inputs to {states} increments must have layers"
            raise ShapeError(f"{what} that fit together, got weights {shapes} and biases {widths[1:]}.")

    @classmethod
    @checked
    def fit(
        cls,
        data: Transitions,
        hidden: Sequence[int] = (8, 8),
        *,
        seed: NonNegativeInt = 0,
        restarts: PositiveInt = 4,
        iterations: PositiveInt = 1000,
    ) -> FeedforwardReLU:
        """Train networks on recorded transitions with scikit-learn's MLPRegressor and L-BFGS.

        So many networks with these hidden layers are trained; the one with the smallest loss on the data is returned.
        """
        scaling = IncrementScaling.of(data)
        seeds = np.random.SeedSequence(seed).generate_state(restarts)
        perceptron = require_extra("sklearn.neural_network", "cases", "learned networks need").MLPRegressor
        ignored = require_extra("sklearn.exceptions", "cases", "learned networks need").ConvergenceWarning
        trained, targets = [], scaling.targets(data)
        targets = targets.ravel() if targets.shape[1] == 1 else targets  # else it warns
        with single_threaded(), warnings.catch_warnings():
            warnings.simplefilter("ignore", ignored)  # stopping at the limit of iterations is intended
            for start in seeds:
                regressor = perceptron(
                    hidden_layer_sizes=tuple(hidden),
                    solver="lbfgs",
                    alpha=1e-6,  # almost no penalty, because so few weights do not overfit thousands of transitions
                    max_iter=iterations,
                    max_fun=2 * iterations,
                    random_state=int(start),
                )
                trained.append(regressor.fit(scaling.inputs(data.x, data.u), targets))
        best = min(trained, key=lambda regressor: regressor.loss_)
        return cls(best.coefs_, best.intercepts_, scaling, data)

    @functools.cached_property
    def _map(self) -> SmoothMap:
        return relu_network(self.weights, self.biases)


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

    Raises:
        ShapeError: if the arrays do not belong together.
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
        self.centres, self.weights = as_finite("centres", centres), as_finite("weights", weights)
        self.scaling, self.data = scaling, data
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
        def kernel(Z: Array, centres: Array) -> tuple[Array, Callable[[], Array]]:
            K = self.covariance(Z, centres)
            return K, lambda: K

        return kernel_sum(kernel, self.covariance.length_scales, self.centres, self.weights, block=2048)


def log_likelihood(theta: Array, Z: Array, Y: Array) -> tuple[float, Array]:
    """Return ``sum_o log p(Y[:, o] | Z, theta)`` up to a constant, and its gradient (eqs. 5.8 and 5.9)."""
    variance, noise, *length_scales = np.exp(theta)
    covariance = SquaredExponential(float(variance), np.array(length_scales))
    K = covariance(Z, Z)
    value, W = log_likelihood_of_outputs(K, float(noise), Y)
    G = W * K
    S = Z / covariance.length_scales
    by_scales = 2 * ((G.sum(axis=1)[:, None] * S**2).sum(axis=0) - (S * (G @ S)).sum(axis=0))
    return value, np.concatenate([[G.sum(), noise * np.trace(W)], by_scales])
