"""Sample paths of a Gaussian process given data, and their maxima over the unit cube.

A path of the posterior is a path of the prior, corrected by what it gets wrong at the data (Matheron's rule; Wilson,
Borovitskiy, Terenin, Mostowsky and Deisenroth 2020). The prior's path is a sum of random waves; the correction is
exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.boxes import climb, moves_to_bounds
from ctxval.gp.hyperposterior import EXACT, Conditioned

WAVES = 512
"""Frequencies of a prior path: its covariance errs by about ``1 / sqrt(2 WAVES)``, a path's maximum by much less."""

_STARTS = 4
"""Points from which each path is climbed."""


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths under one draw of hyperparameters, as functions on the unit cube.

    Attributes:
        conditioned: the hyperparameters, conditioned on the data.
        X: the data's points ``(n, d)``.
        frequencies: of the waves ``(F, d)``.
        amplitudes: of cosines and sines, shape ``(2 F, s)``.
        corrections: weights of the data's correlations ``(n, s)``.
        means, scales: mu and sigma of each path ``(s,)``.
    """

    conditioned: Conditioned
    X: Array
    frequencies: Array
    amplitudes: Array
    corrections: Array
    means: Array
    scales: Array

    def __len__(self) -> int:
        return len(self.means)

    def __call__(self, Z: Array) -> Array:
        """Return the values of all paths at the same points ``(m, d)``, shape ``(m, s)``."""
        waves = _waves(Z, self.frequencies) @ self.amplitudes
        return np.asarray(self.means + self.scales * (waves + self._correlations(Z) @ self.corrections))

    def roughly(self, Z: Array) -> Array:
        """Return the values of a call, waves in single precision: ten times as fast, enough to choose candidates."""
        single = np.float32
        waves = _waves(Z.astype(single), self.frequencies.astype(single)) @ self.amplitudes.astype(single)
        # The corrections are sums of large terms that cancel: single precision would not do.
        return np.asarray(self.means + self.scales * (waves + self._correlations(Z) @ self.corrections))

    def own(self, Z: Array) -> Array:
        """Return the values of each path at points of its own ``(s, q, d)``, shape ``(s, q)``."""
        return self.own_with_gradient(Z)[0]

    def own_with_gradient(self, Z: Array) -> tuple[Array, Array]:
        """Return values ``(s, q)`` and gradients ``(s, q, d)`` of each path at points of its own ``(s, q, d)``."""
        s, q, d = Z.shape
        flat = Z.reshape(-1, d)
        waves = _waves(flat, self.frequencies).reshape(s, q, -1)
        correlations = self._correlations(flat).reshape(s, q, -1)
        values = np.einsum("sqf,fs->sq", waves, self.amplitudes) + np.einsum(
            "sqn,ns->sq", correlations, self.corrections
        )
        half = len(self.frequencies)
        # d cos = -sin, d sin = cos, each times its frequency
        turned = (
            waves[..., :half] * self.amplitudes[half:].T[:, None]
            - waves[..., half:] * self.amplitudes[:half].T[:, None]
        )
        slopes = turned @ self.frequencies
        weights = np.repeat(self.corrections.T, q, axis=0)
        slopes += self.conditioned.hyperparameters.kernel_pull(flat, self.X, weights).reshape(s, q, d)
        scales = self.scales[:, None]
        return self.means[:, None] + scales * values, scales[..., None] * slopes

    def _correlations(self, Z: Array) -> Array:
        return self.conditioned.hyperparameters.kernel(Z, self.X)


def _waves(Z: Array, frequencies: Array) -> Array:
    """Return cosines and sines ``(m, 2 F)``, scaled so that unit amplitudes give unit variance."""
    phases = Z @ frequencies.T
    return np.asarray(np.concatenate([np.cos(phases), np.sin(phases)], axis=1) / np.sqrt(len(frequencies)))


def draw_paths(conditioned: Conditioned, X: Array, count: int, rng: np.random.Generator) -> Paths:
    """Return paths on the process's scale given points ``(n, d)``, with mu and sigma drawn from their posterior.

    Args:
        conditioned: the data under one draw of hyperparameters.
        X: the data's points.
        count: how many paths.
        rng: of all random numbers.
    """
    hyperparameters, (n, d) = conditioned.hyperparameters, X.shape
    # The spectrum of a Matern kernel is a multivariate t with 2 nu degrees of freedom.
    tails = np.sqrt(2 * hyperparameters.nu / rng.chisquare(2 * hyperparameters.nu, (WAVES, 1)))
    frequencies = rng.normal(size=(WAVES, d)) * tails / np.exp(hyperparameters.log_scales)
    amplitudes = rng.normal(size=(2 * WAVES, count))
    scales = np.sqrt(conditioned.scale2 * (n - 1) / rng.chisquare(n - 1, count))
    means = rng.normal(conditioned.mean, scales * np.sqrt(conditioned.mean_variance))
    noise = np.exp(hyperparameters.log_noise)
    errors = np.zeros((n, count)) if noise <= EXACT else np.sqrt(noise) * rng.normal(size=(n, count))
    gaps = (conditioned.y[:, None] - means) / scales - _waves(X, frequencies) @ amplitudes - errors
    corrections = conditioned.factor.solve(gaps)
    return Paths(conditioned, X, frequencies, amplitudes, corrections, means, scales)


def maxima(paths: Paths, known: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the largest value of each path over the unit cube, shape ``(s,)``, and where it is, ``(s, d)``.

    Candidates are uniform, near ``known`` points (best first) and at corners. They are divided into several lots, and
    the best of each lot is climbed from. Beyond two dimensions there are more lots, only the highest climb all the way,
    and in the end coordinates are moved to their bounds one by one, as long as that pays.
    """
    d = paths.X.shape[1]
    candidates = _candidates(known, d, rng)
    many = _STARTS if d <= 2 else _STARTS * (1 + d)
    starts = _starts(candidates, paths.roughly(candidates), many)
    if d > 2:
        starts = _highest(paths, _climb(paths, starts, 20))
    points = np.concatenate([starts, _climb(paths, starts, 30 if d <= 2 else 80)], axis=1)
    heights = paths.own(points)
    best, rows = np.argmax(heights, axis=1), np.arange(len(paths))
    tops, where = heights[rows, best], points[rows, best]
    return _polish(paths, tops, where) if d > 2 else (tops, where)


def _candidates(known: Array, d: int, rng: np.random.Generator) -> Array:
    near = np.repeat(known[:8], 16, axis=0)
    near = np.clip(near + rng.normal(size=near.shape) * rng.choice([0.003, 0.03], (len(near), 1)), 0.0, 1.0)
    corners = rng.integers(0, 2, (min(2**d, 256), d)).astype(np.float64)
    return np.concatenate([known, near, corners, rng.random((min(2048, 512 * d), d))])


def _starts(candidates: Array, values: Array, many: int) -> Array:
    """Return the best candidates of many lots for each path, shape ``(s, many, d)``: they are far apart, yet good."""
    return np.stack([candidates[lot::many][values[lot::many].argmax(axis=0)] for lot in range(many)], axis=1)


def _highest(paths: Paths, points: Array) -> Array:
    """Return the few highest of each path's points ``(s, q, d)``."""
    order = np.argsort(-paths.own(points), axis=1)[:, :_STARTS]
    return np.take_along_axis(points, order[..., None], axis=1)


def _climb(paths: Paths, starts: Array, steps: int) -> Array:
    """Return the points ``(s, q, d)`` that climbs of so many iterations reach, each path in units of its sigma."""
    units, d = paths.scales[:, None], starts.shape[-1]

    def sloped(points: Array) -> tuple[Array, Array]:
        values, gradients = paths.own_with_gradient(points)
        return values / units, gradients / units[..., None]

    return climb(sloped, starts, np.zeros(d), np.ones(d), iterations=steps)[0]


def _polish(paths: Paths, tops: Array, where: Array) -> tuple[Array, Array]:
    """Move one coordinate at a time to a bound, the best one first."""
    s, d = where.shape
    for _ in range(d):
        moved = moves_to_bounds(where, np.zeros(d), np.ones(d))
        heights = paths.own(moved)
        best = heights.argmax(axis=1)
        rows = np.arange(s)
        better = heights[rows, best] > tops + 1e-9 * paths.scales
        if not better.any():
            break
        tops = np.where(better, heights[rows, best], tops)
        where = np.where(better[:, None], moved[rows, best], where)
    return tops, where
