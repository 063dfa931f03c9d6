"""Draws of a Gaussian process's hyperparameters from their posterior, instead of one best guess.

The process is ``f = mu + sigma g``. Here g has unit variance and a Matern kernel with one length-scale for each
dimension, and f is the values or, if none is negative, possibly their logarithm. The prior is flat in mu and in
log sigma. So both integrate out in closed form (O'Hagan 1978; Rasmussen and Williams 2006, Sec. 2.7), and results do
not depend on the units of f. The other hyperparameters are drawn by slice sampling (Neal 2003), which has no step size
to tune: the scale of the values, the smoothness, the length-scales and the noise.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array, ArrayLike
from ctxval._util.boxes import climb, farthest_rows, polish
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError
from ctxval.gp.cholesky import CholeskyFactor, factorise
from ctxval.gp.kernels import Matern

EXACT = 1e-10  # noise variance, relative to sigma^2, of values without noise: it keeps the Cholesky factor safe


@dataclass(frozen=True)
class Warp:
    """A scale on which values are a Gaussian process; their unit makes likelihoods of two scales comparable."""

    offset: float = np.inf  # c of log(y + c); infinity for the values themselves
    unit: float = 1.0

    def forward(self, y: ArrayLike) -> Array:
        """Return values on the process's scale."""
        values = np.asarray(y, dtype=np.float64)
        return values if np.isinf(self.offset) else np.log(values + self.offset)

    def backward(self, z: ArrayLike) -> Array:
        """Return values on their own scale."""
        values = np.asarray(z, dtype=np.float64)
        return values if np.isinf(self.offset) else np.exp(np.minimum(values, 700.0)) - self.offset  # 710 overflows

    def log_slope(self, y: Array) -> float:
        """Return the sum of the logarithms of the warp's slopes at values ``(n,)``, including the flat prior of mu."""
        return -float(np.log(self.unit)) if np.isinf(self.offset) else -float(np.log(y + self.offset).sum())


@dataclass(frozen=True)
class Prior:
    """The prior of the hyperparameters.

    A search crowds its points where the values are smooth and high, and these points suggest smoothness everywhere. So
    each draw from all data is made as rough as one from a share of them that is well spread over the cube, if that one
    is rougher. If the share is 1, there is no second draw: then bounds are exact on draws of the prior, and too low on
    kinks, jumps and heavy tails (docs/calibration.md).
    """

    smoothness: tuple[float, ...] = (1.5, 2.5)  # values of nu of the Matern kernel, equally likely
    length_scale: float = 0.3  # median of the log-normal length-scales in the cube, times the root of the dimension
    deviation: float = 1.0  # standard deviation of their logarithms
    # bounds of the noise variance relative to sigma^2; it is log-uniform between them, and equal bounds fix it
    noise: tuple[float, float] = (EXACT, EXACT)
    # c of log(y + c), in means of the values. If no value is negative, the logarithm and the values themselves are
    # equally likely. None excludes the logarithm.
    offset: float | None = 0.1
    spread_share: float = 0.5  # share of the data from which hyperparameters are drawn a second time

    def centre(self, dimension: int) -> float:
        """Return the mean of each length-scale's logarithm."""
        return float(np.log(self.length_scale) + 0.5 * np.log(dimension))

    def draw(self, dimension: int, rng: np.random.Generator) -> Hyperparameters:
        """Return hyperparameters from the prior."""
        log_noise = rng.uniform(*np.log(self.noise))
        nu = float(rng.choice(self.smoothness))
        return Hyperparameters(nu, rng.normal(self.centre(dimension), self.deviation, dimension), log_noise)


@dataclass(frozen=True, eq=False)
class Hyperparameters(ShortRepr):
    """One draw of the hyperparameters."""

    nu: float  # the kernel's smoothness
    log_scales: Array  # logarithms of the length-scales (d,)
    log_noise: float  # logarithm of the noise variance relative to sigma^2

    def kernel(self, X: Array, Z: Array) -> Array:
        """Return the correlations ``(n, m)`` of g between points ``(n, d)`` and ``(m, d)``."""
        return Matern(self.nu, ard=True)(np.concatenate([[0.0], self.log_scales]), X, Z)


@dataclass(frozen=True, eq=False)
class Conditioned(ShortRepr):
    """A Gaussian process with one draw of hyperparameters, conditioned on data."""

    hyperparameters: Hyperparameters
    warp: Warp
    y: Array  # the values on the scale of the warp (n,)
    factor: CholeskyFactor  # of the observations' correlations
    mean: float  # the most likely mu
    mean_variance: float  # variance of mu relative to sigma^2
    scale2: float  # the most likely sigma^2, with n - 1 degrees of freedom
    log_likelihood: float  # of the data with mu and sigma integrated out, up to a constant


def condition(hyperparameters: Hyperparameters, X: Array, values: Array, warp: Warp | None = None) -> Conditioned:
    """Return the process of values ``(n,)`` at points ``(n, d)``, on their own scale if there is no warp."""
    scale = warp or Warp()
    n, y = len(values), scale.forward(values)
    factor = factorise(hyperparameters.kernel(X, X), float(np.exp(hyperparameters.log_noise)))
    pull = factor.solve(np.stack([np.ones(n), y], axis=1))
    precision = pull[:, 0].sum()
    mean = float(pull[:, 1].sum() / precision)
    scale2 = float((y - mean) @ (pull[:, 1] - mean * pull[:, 0])) / (n - 1)
    scale2 = max(scale2, np.finfo(np.float64).tiny)
    volume = scale.log_slope(values) - factor.half_log_determinant()
    log_likelihood = float(volume - 0.5 * np.log(precision) - 0.5 * (n - 1) * np.log(scale2))
    return Conditioned(hyperparameters, scale, y, factor, mean, float(1 / precision), scale2, log_likelihood)


def draw_hyperparameters(
    X: Array, y: Array, count: int, rng: np.random.Generator, prior: Prior | None = None
) -> list[Conditioned]:
    """Return draws from the posterior of the hyperparameters, given values ``(n,)`` at unit-cube points ``(n, d)``."""
    if len(y) < 3 or not np.isfinite(y).all() or np.ptp(y) == 0:
        raise InputError(f"hyperparameters need at least three finite values that differ, got {y.tolist()}.")
    prior = prior or Prior()
    drawn = _chain(X, y, prior, count, rng)
    apart = max(6, int(np.ceil(prior.spread_share * len(y))))
    if apart < len(y):
        # The row of the largest value, and those of points chosen farthest-first from it, in the data's order.
        first = int(y.argmax())
        gaps = np.linalg.norm(X - X[first], axis=1)
        gaps[first] = -np.inf
        rows = np.sort([first, *farthest_rows(X, gaps, apart - 1)])
        rougher = _chain(X[rows], y[rows], prior, count, rng)
        for k, ((draw, warp), (other, _)) in enumerate(zip(drawn, rougher, strict=True)):
            shrink = min(0.0, float((other.log_scales - draw.log_scales).mean()))
            as_rough = Hyperparameters(min(draw.nu, other.nu), draw.log_scales + shrink, draw.log_noise)
            drawn[k] = as_rough, warp
    return [condition(draw, X, y, warp) for draw, warp in drawn]


def _chain(
    X: Array, y: Array, prior: Prior, count: int, rng: np.random.Generator
) -> list[tuple[Hyperparameters, Warp]]:
    """Return draws of a Markov chain over (nu, log length-scales, log noise), two sweeps apart."""
    d, (low, high), warps = X.shape[1], np.log(prior.noise), [Warp()]
    if prior.offset is not None and y.min() >= 0:
        warps = [Warp(unit=float(y.mean())), Warp(prior.offset * float(y.mean()))]
    choices = [(nu, warp) for nu in prior.smoothness for warp in warps]
    choice, state = choices[0], np.append(np.full(d, prior.centre(d)), 0.5 * (low + high))
    # All length-scales together, each length-scale, and the noise.
    axes = np.eye(d + 1)
    directions = [np.append(np.ones(d), 0.0), *(axes[:d] if d > 1 else ()), *(axes[d:] if high > low else ())]

    def log_density(choice: tuple[float, Warp], state: Array) -> float:
        if not low <= state[-1] <= high or np.abs(state[:-1]).max() > 12.0:
            return -np.inf
        try:
            conditioned = condition(Hyperparameters(choice[0], state[:-1], float(state[-1])), X, y, choice[1])
        except InputError:
            return -np.inf
        away = (state[:-1] - prior.centre(d)) / prior.deviation
        return conditioned.log_likelihood + float(-0.5 * (away**2).sum())

    draws = []
    for sweep in range(20 + 2 * count):  # the first 20 are the burn-in
        for direction in directions:
            state = _slice(functools.partial(log_density, choice), state, direction, rng)
        if len(choices) > 1:
            densities = np.array([log_density(each, state) for each in choices])
            shares = np.exp(densities - densities.max())
            choice = choices[int(rng.choice(len(choices), p=shares / shares.sum()))]
        if sweep >= 20 and sweep % 2:
            draws.append((Hyperparameters(choice[0], state[:-1], float(state[-1])), choice[1]))
    return draws


def _slice(log_density: Callable[[Array], float], state: Array, direction: Array, rng: np.random.Generator) -> Array:
    """Return the next state of a slice sampler along a line, stepping out and shrinking (Neal 2003, Figs. 3 and 5)."""
    level = log_density(state) + np.log(rng.random())
    left = -rng.random()  # the first interval has width 1, and the interval grows to at most 8
    right = left + 1.0
    steps_left = int(rng.integers(8))
    for _ in range(steps_left):
        if log_density(state + left * direction) <= level:
            break
        left -= 1.0
    for _ in range(7 - steps_left):
        if log_density(state + right * direction) <= level:
            break
        right += 1.0
    for _ in range(60):
        move = rng.uniform(left, right)
        proposal = state + move * direction
        if log_density(proposal) > level:
            return np.asarray(proposal)
        left, right = (move, right) if move < 0 else (left, move)
    return state


# Sample paths. A path of the posterior is a path of the prior plus a correction of its errors at the data (Matheron's
# rule; Wilson, Borovitskiy, Terenin, Mostowsky and Deisenroth 2020). The prior's path is approximated by random waves;
# the correction is exact.


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths under one draw of hyperparameters, as functions on the unit cube."""

    conditioned: Conditioned
    X: Array  # the data's points (n, d)
    frequencies: Array  # of the waves (F, d)
    amplitudes: Array  # of cosines and sines (2 F, s)
    corrections: Array  # weights of the correlations with the data (n, s)
    means: Array  # mu of each path (s,)
    scales: Array  # sigma of each path (s,)

    def __call__(self, Z: Array, precision: type = np.float64) -> Array:
        """Return the values of all paths at the same points ``(m, d)``, shape ``(m, s)``.

        With waves in single precision they are ten times as fast, and good enough to choose candidates.
        """
        parts: list[Array] = [part.astype(precision, copy=False) for part in (Z, self.frequencies, self.amplitudes)]
        waves = _waves(*parts[:2]) @ parts[2]
        # The corrections are sums of large terms that cancel, so they need double precision.
        correlations = self.conditioned.hyperparameters.kernel(Z, self.X)
        return np.asarray(self.means + self.scales * (waves + correlations @ self.corrections))

    def own(self, Z: Array) -> Array:
        """Return the values of each path at its own points ``(s, q, d)``, shape ``(s, q)``."""
        return self.own_with_gradient(Z)[0]

    def own_with_gradient(self, Z: Array) -> tuple[Array, Array]:
        """Return values ``(s, q)`` and gradients ``(s, q, d)`` of each path at its own points ``(s, q, d)``."""
        s, q, d = Z.shape
        flat = Z.reshape(-1, d)
        waves = _waves(flat, self.frequencies).reshape(s, q, -1)
        known = self.conditioned.hyperparameters
        correlations = known.kernel(flat, self.X).reshape(s, q, -1)
        values = np.einsum("sqf,fs->sq", waves, self.amplitudes)
        values = values + np.einsum("sqn,ns->sq", correlations, self.corrections)
        # d cos = -sin, d sin = cos, each times its frequency
        half, amplitudes = len(self.frequencies), self.amplitudes.T[:, None]
        turned = waves[..., :half] * amplitudes[..., half:] - waves[..., half:] * amplitudes[..., :half]
        slopes = turned @ self.frequencies
        weights = np.repeat(self.corrections.T, q, axis=0)
        lengths = np.exp(known.log_scales)
        _, falls = Matern(known.nu).profile_and_slope(scipy.spatial.distance.cdist(flat / lengths, self.X / lengths))
        pulls = weights * falls
        slopes += ((pulls @ self.X - pulls.sum(axis=1)[:, None] * flat) / lengths**2).reshape(s, q, d)
        scales = self.scales[:, None]
        return self.means[:, None] + scales * values, scales[..., None] * slopes


def _waves(Z: Array, frequencies: Array) -> Array:
    """Return cosines and sines ``(m, 2 F)``, scaled so that unit amplitudes give unit variance."""
    phases = Z @ frequencies.T
    return np.asarray(np.concatenate([np.cos(phases), np.sin(phases)], axis=1) / np.sqrt(len(frequencies)))


def draw_paths(conditioned: Conditioned, X: Array, count: int, rng: np.random.Generator, waves: int = 512) -> Paths:
    """Return paths on the process's scale given points ``(n, d)``, with mu and sigma drawn from their posterior.

    The error of the covariance of a path is about ``1 / sqrt(2 waves)``, that of its maximum much smaller.
    """
    hyperparameters, (n, d) = conditioned.hyperparameters, X.shape
    # The spectrum of a Matern kernel is a multivariate t with 2 nu degrees of freedom.
    tails = np.sqrt(2 * hyperparameters.nu / rng.chisquare(2 * hyperparameters.nu, (waves, 1)))
    frequencies = rng.normal(size=(waves, d)) * tails / np.exp(hyperparameters.log_scales)
    amplitudes = rng.normal(size=(2 * waves, count))
    scales = np.sqrt(conditioned.scale2 * (n - 1) / rng.chisquare(n - 1, count))
    means = rng.normal(conditioned.mean, scales * np.sqrt(conditioned.mean_variance))
    noise = np.exp(hyperparameters.log_noise)
    errors = np.zeros((n, count)) if noise <= EXACT else np.sqrt(noise) * rng.normal(size=(n, count))
    gaps = (conditioned.y[:, None] - means) / scales - _waves(X, frequencies) @ amplitudes - errors
    corrections = conditioned.factor.solve(gaps)
    return Paths(conditioned, X, frequencies, amplitudes, corrections, means, scales)


def maxima(paths: Paths, known: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the largest value of each path over the unit cube, shape ``(s,)``, and where it is, ``(s, d)``.

    Candidates are uniform, near ``known`` points (best first) and at corners. They are divided into several groups, and
    each path is climbed from the best of each group. Beyond two dimensions there are more groups, only the highest
    climbs are completed, and in the end single coordinates are moved to their bounds while that increases the value.
    """
    d = paths.X.shape[1]
    near = np.repeat(known[:8], 16, axis=0)
    near = np.clip(near + rng.normal(size=near.shape) * rng.choice([0.003, 0.03], (len(near), 1)), 0.0, 1.0)
    corners = rng.integers(0, 2, (min(2**d, 256), d)).astype(np.float64)
    candidates = np.concatenate([known, near, corners, rng.random((min(2048, 512 * d), d))])
    values, groups = paths(candidates, np.float32), 4 if d <= 2 else 4 * (1 + d)
    best_of = [candidates[group::groups][values[group::groups].argmax(axis=0)] for group in range(groups)]
    starts = np.stack(best_of, axis=1)  # (s, groups, d)
    if d > 2:
        climbed = _climb(paths, starts, 20)
        highest = np.argsort(-paths.own(climbed), axis=1)[:, :4]
        starts = np.take_along_axis(climbed, highest[..., None], axis=1)
    points = np.concatenate([starts, _climb(paths, starts, 30 if d <= 2 else 80)], axis=1)
    heights = paths.own(points)
    best, rows = np.argmax(heights, axis=1), np.arange(len(paths.means))
    tops, where = heights[rows, best], points[rows, best]
    if d > 2:
        where, tops = polish(paths.own, where, tops, (np.zeros(d), np.ones(d)), d, 1e-9 * paths.scales)
    return tops, where


def _climb(paths: Paths, starts: Array, steps: int) -> Array:
    """Return the points ``(s, q, d)`` that climbs of this many steps reach; each path is in units of its sigma."""
    units, d = paths.scales[:, None], starts.shape[-1]

    def sloped(points: Array) -> tuple[Array, Array]:
        values, gradients = paths.own_with_gradient(points)
        return values / units, gradients / units[..., None]

    return climb(sloped, starts, np.zeros(d), np.ones(d), iterations=steps)[0]
