"""Draws of the hyperparameters of residual dynamics from their posterior.

The residual of each state is ``sigma_i g_i``: all g_i have one covariance, and the prior is flat in each log sigma_i,
so the amplitudes integrate out in closed form (Rasmussen and Williams 2006, Sec. 2.7). The posterior of the other
hyperparameters is approximated around its mode (Laplace), for each family of covariances. Draws from a t distribution
there are weighted by the ratio of the densities, with weights truncated as by Ionides (2008), and resampled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows
from ctxval.errors import InputError
from ctxval.gp.cholesky import CholeskyFactor, factorise, pivoted_rows
from ctxval.gp.kernels import Covariance, Matern, Towards
from ctxval.gp.regression import most_likely

FAMILIES = ((2.5, 0.0), (2.5, 1.0), (1.5, 0.0))  # smoothness and growth of the covariances, equally likely a priori
Climbs = list[tuple[float, Array]]  # log posteriors at the ends of climbs, and the (theta, log noise) there
SMOOTHER_FAMILIES = ((4.5, 0.0), *FAMILIES)  # those of the system itself, without a learned model, which may be rough


@dataclass(frozen=True)
class HyperparameterPrior:
    """Medians of the hyperparameters with the deviations of their logarithms, and their bounds.

    Length-scales are in standard deviations of the data, and variances relative to that of the Matern part.
    """

    length: tuple[float, float] = (3.0, 1.0)
    linear: tuple[float, float] = (1.0, 5.0)  # the variances of the constant and of the linear part
    noise: tuple[float, float] = (1e-6, 4.0)
    length_bounds: tuple[float, float] = (0.05, 100.0)  # no column is irrelevant beyond 100 standard deviations
    linear_bounds: tuple[float, float] = (1e-4, 1e6)
    noise_bounds: tuple[float, float] = (1e-7, 1.0)

    def moments(self, count: int) -> tuple[Array, Array]:
        """Return means and standard deviations of the ``count`` parameters (theta, log noise)."""
        medians, deviations = np.transpose([*[self.length] * (count - 3), self.linear, self.linear, self.noise])
        return np.log(medians), deviations

    def log_density(self, parameters: Array) -> tuple[float, Array]:
        """Return the log density of (theta, log noise) up to a constant, and its gradient."""
        centres, deviations = self.moments(len(parameters))
        scaled = (parameters - centres) / deviations
        return float(-0.5 * (scaled**2).sum()), -scaled / deviations


@dataclass(frozen=True)
class ResidualKernel(Covariance):
    """``k(z, w) = matern(z, w) (1 + growth u.u') + constant + slope z.w`` for standardised pairs z = (x, u).

    theta = log of (length-scales, one for each column; constant; slope). The Matern part has unit variance. If M has
    the wrong gain from the input to the states, then the residual grows with the input; a stationary covariance would
    return to its mean outside the data.
    """

    nu: float  # smoothness of the Matern part, 1.5, 2.5 or 4.5
    growth: float  # factor of the product of the inputs; 0 for a stationary Matern part
    inputs: int  # the number m of inputs of the system, which are the last columns
    prior: HyperparameterPrior = HyperparameterPrior()

    def box(self, dimension: int) -> tuple[Array, Array]:
        """Return the bounds of (theta, log noise)."""
        prior = self.prior
        low, high = np.log([*[prior.length_bounds] * dimension, *[prior.linear_bounds] * 2, prior.noise_bounds]).T
        return low, high

    def within(self, parameters: Array) -> tuple[Array, float]:
        """Return theta and the noise variance, within their bounds, for (theta, log noise)."""
        within = np.clip(parameters, *self.box(len(parameters) - 3))
        return within[:-1], float(np.exp(within[-1]))

    def towards(self, theta: Array, Z: Array) -> Towards:
        """Return the covariances with points ``(m, k)`` as a function of other points."""
        matern = Matern(self.nu, ard=True).towards(np.concatenate([[0.0], theta[:-2]]), Z)
        constant, slope = np.exp(theta[-2:])

        def covariances(X: Array) -> Array:
            linear = (slope * X) @ Z.T
            linear += constant
            total = self._grow(matern(X), X, Z)
            total += linear
            return total

        return covariances

    def diagonal(self, theta: Array, X: Array) -> Array:
        """Return the variances k(z, z), shape ``(n,)``."""
        (constant, slope), inputs = np.exp(theta[-2:]), X[:, X.shape[1] - self.inputs :]
        grown = 1 + self.growth * (inputs**2).sum(axis=1)
        return np.asarray(grown + (constant + slope * (X**2).sum(axis=1)))

    def with_gradient(self, theta: Array, Z: Array) -> tuple[Array, Callable[[Array], Array]]:
        """Return K = k(Z, Z), and the function ``W -> sum_ij W_ij dK_ij/dtheta`` of a symmetric W."""
        constant, slope = np.exp(theta[-2:])
        scaled = Z / np.exp(theta[:-2])
        profile, fall = Matern(self.nu).profile_and_slope(scipy.spatial.distance.cdist(scaled, scaled))
        linear = slope * (Z @ Z.T)
        K = self._grow(profile, Z, Z)
        K += linear
        K += constant

        def gradient(W: Array) -> Array:
            G = self._grow(W * fall, Z, Z)
            # As in Matern.weighted_gradient, the sum over pairs is a quadratic form.
            of_scales = 2 * (G.sum(axis=1) @ scaled**2 - (scaled * (G @ scaled)).sum(axis=0))
            return np.array([*of_scales, constant * W.sum(), np.vdot(W, linear)])

        return K, gradient

    def _grow(self, covariances: Array, X: Array, Z: Array) -> Array:
        """Multiply covariances ``(n, m)`` by the growth with the inputs, and return them."""
        if self.growth:
            first = Z.shape[1] - self.inputs  # a system may have none
            factors = X[:, first:] @ Z[:, first:].T
            factors *= self.growth
            factors += 1
            covariances *= factors
        return covariances


@dataclass(frozen=True, eq=False)
class ResidualHyperparameters:
    """One draw of the hyperparameters."""

    kernel: ResidualKernel
    theta: Array  # logarithms of the kernel's hyperparameters
    noise: float  # noise variance, relative to that of the Matern part


@dataclass(frozen=True, eq=False)
class Mode:
    """The posterior of one family, given pairs and residuals, around one of its modes."""

    kernel: ResidualKernel
    height: float  # the log posterior at the mode
    place: Array  # the (theta, log noise) of the mode
    Z: Array
    Y: Array

    @functools.cached_property
    def scale(self) -> Array:
        """A root ``(D, D)`` of the inverse of the curvature of the log posterior, by differences of its gradient."""
        low, high = self.kernel.box(self.Z.shape[1])
        curvature = np.empty((len(self.place), len(self.place)))
        for i, step in enumerate(np.eye(len(self.place)) * 0.05):
            ends, slopes = (np.minimum(self.place + step, high), np.maximum(self.place - step, low)), []
            for end in ends:
                try:
                    slopes.append(log_posterior(self.kernel, end, self.Z, self.Y)[1])
                except InputError:  # the covariance is not positive definite
                    slopes.append(np.zeros_like(end))
            curvature[i] = (slopes[1] - slopes[0]) / (ends[0] - ends[1])[i]
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        # No direction is less certain than a standard deviation of 2 in the logarithm.
        return np.asarray(vectors / np.sqrt(np.maximum(values, 0.25)))


@dataclass(frozen=True, eq=False)
class HyperparameterPosterior:
    """The posterior of the hyperparameters, given standardised residuals."""

    # the modes of each family of covariances, the highest first: with little noise, with much, or one that is both
    families: tuple[tuple[Mode, ...], ...]

    @classmethod
    def given(
        cls, Z: Array, Y: Array, inputs: int, families: Sequence[tuple[float, float]],
        climb: Callable[[ResidualKernel], Climbs] | None = None,
    ) -> HyperparameterPosterior:  # fmt: skip
        """Return the posterior given standardised pairs ``(N, k)`` and residuals ``(N, n)``.

        By default, each family is climbed; ``climb`` may know the climbs of some.
        """
        climb, modes = climb or (lambda kernel: climbed(kernel, Z, Y)), []
        for nu, growth in families:
            kernel = ResidualKernel(nu, growth, inputs)
            (height, place), (lower, other) = ends = climb(kernel)
            relevant = height - lower < 12.0 and np.abs(place - other).max() > 0.5  # else negligible, or the same mode
            modes.append(tuple(Mode(kernel, *end, Z, Y) for end in (ends if relevant else ends[:1])))
        return cls(tuple(modes))

    @functools.cached_property
    def highest(self) -> Mode:
        """The highest mode of all families."""
        return max((mode for family in self.families for mode in family), key=lambda mode: mode.height)

    @functools.cached_property
    def mode(self) -> ResidualHyperparameters:
        """The most probable hyperparameters."""
        return ResidualHyperparameters(self.highest.kernel, *self.highest.kernel.within(self.highest.place))

    def draw(self, count: int, rng: np.random.Generator) -> list[ResidualHyperparameters]:
        """Return ``count`` draws; hyperparameters that are drawn again are the same object, and follow each other."""
        places, weights = [], []
        for family in self.families:
            kernel, Z, Y, D = family[0].kernel, family[0].Z, family[0].Y, len(family[0].place)
            proposals, heights, densities = [], [], []
            freedom = 6.0  # degrees of freedom of the t distributions of the proposals
            for mode in family:  # draws around the modes
                normal = rng.standard_normal((48 // len(family), D))
                deviations = normal / np.sqrt(rng.chisquare(freedom, (len(normal), 1)) / freedom)
                proposals.append(mode.place + deviations @ mode.scale.T)
            drawn = np.concatenate(proposals)
            # All modes of a family make one proposal distribution: the mixture of theirs in equal parts.
            constant = (
                scipy.special.gammaln((freedom + D) / 2)
                - scipy.special.gammaln(freedom / 2)
                - 0.5 * D * np.log(freedom * np.pi)
            )
            for mode in family:
                squares = (np.linalg.solve(mode.scale, (drawn - mode.place).T) ** 2).sum(axis=0)
                log_volume = np.linalg.slogdet(mode.scale)[1]
                densities.append(constant - log_volume - 0.5 * (freedom + D) * np.log1p(squares / freedom))
            density = scipy.special.logsumexp(densities, axis=0) - np.log(len(family))
            for place in drawn:
                theta, noise = kernel.within(place)
                try:
                    likelihood = _log_likelihood(kernel(theta, Z, Z), noise, Y)[0]
                    heights.append(likelihood + kernel.prior.log_density(place)[0])
                except InputError:  # the covariance is not positive definite
                    heights.append(-np.inf)
            places += [(kernel, place) for place in drawn]
            weights.append(np.array(heights) - density)
        chosen = _resampled(np.concatenate(weights), count, rng).tolist()
        # What follows from the same object is computed once.
        draws = {row: ResidualHyperparameters(places[row][0], *places[row][0].within(places[row][1])) for row in chosen}
        return [draws[row] for row in chosen]


def draw_prior(dimension: int, inputs: int, rng: np.random.Generator) -> ResidualHyperparameters:
    """Return hyperparameters from the prior, such as those of a system on which a posterior is tested."""
    nu, growth = FAMILIES[rng.integers(len(FAMILIES))]
    kernel = ResidualKernel(nu, growth, inputs)
    centres, deviations = kernel.prior.moments(dimension + 3)
    return ResidualHyperparameters(kernel, *kernel.within(centres + deviations * rng.standard_normal(dimension + 3)))


def learning_rows(Z: Array, inputs: int, count: int) -> Rows:
    """Return rows of well-spread pairs, from which the hyperparameters are learned."""
    kernel = ResidualKernel(2.5, 0.0, inputs)
    theta = np.log([*[kernel.prior.length[0]] * Z.shape[1], 1.0, 1.0])
    return pivoted_rows(kernel, theta, Z, count, least=1e-8)


def log_posterior(kernel: ResidualKernel, parameters: Array, Z: Array, Y: Array) -> tuple[float, Array]:
    """Return the log density of (theta, log noise) up to a constant, and its gradient.

    The likelihood is ``-n log det(K) / 2 - N / 2 sum_i log(y_i' K^-1 y_i)``, in which the amplitudes are integrated
    out. It does not change beyond the bounds of the hyperparameters, where only the prior does.
    """
    theta, noise = kernel.within(parameters)
    K, gradient = kernel.with_gradient(theta, Z)
    value, factor, scaled = _log_likelihood(K, noise, Y)
    W = scaled @ scaled.T
    W -= Y.shape[1] * factor.inverse()
    W *= 0.5
    prior, slope = kernel.prior.log_density(parameters)
    return value + prior, np.append(gradient(W), noise * np.trace(W)) + slope


def _log_likelihood(K: Array, noise: float, Y: Array) -> tuple[float, CholeskyFactor, Array]:
    """Return the log likelihood, the factor of the covariance, and ``K^-1 y_i`` over the amplitudes, ``(N, n)``."""
    N, n = Y.shape
    factor = factorise(K, noise)
    weights = factor.solve(Y)
    squares = np.maximum((Y * weights).sum(axis=0) / N, 1e-300)
    value = -0.5 * N * np.log(squares).sum() - n * factor.half_log_determinant()
    return float(value), factor, weights / np.sqrt(squares)


def climbed(kernel: ResidualKernel, Z: Array, Y: Array) -> Climbs:
    """Return the log posterior and its place where climbs from little and from much noise end, the highest first."""
    density = functools.partial(log_posterior, kernel, Z=Z, Y=Y)
    bounds = list(zip(*kernel.box(Z.shape[1]), strict=True))
    # The data can look like a rough function, or like a smooth one with noise.
    length = kernel.prior.length[0]
    starts = [np.log([*[length] * Z.shape[1], 1.0, 1.0, noise]) for noise in (1e-5, 0.1)]
    modes = [most_likely(density, start[None], bounds, tolerance=1e-7) for start in starts]
    return sorted(((density(mode)[0], mode) for mode in modes), key=lambda mode: -mode[0])


def _resampled(log_weights: Array, count: int, rng: np.random.Generator) -> Rows:
    """Return rows drawn in proportion to truncated weights, by systematic resampling."""
    weights = np.exp(log_weights - log_weights.max())
    weights = np.minimum(weights, weights.mean() * np.sqrt(len(weights)))
    edges = np.cumsum(weights) / weights.sum()
    places = (np.arange(count) + rng.random()) / count
    return np.asarray(np.minimum(np.searchsorted(edges, places), len(weights) - 1), dtype=np.intp)
