"""Sample paths of a Gaussian process given data, and their maxima over the unit cube.

A path of the posterior is a path of the prior plus a correction of its errors at the data (Matheron's rule; Wilson,
Borovitskiy, Terenin, Mostowsky and Deisenroth 2020). The prior's path is approximated by a sum of random waves; the
correction is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.boxes import climb, polish
from ctxval.gp.hyperposterior import EXACT, Conditioned

WAVES = 512
"""Number of frequencies of a prior path. The error of its covariance is about ``1 / sqrt(2 WAVES)``, and that of a
path's maximum much smaller."""


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

    def __len__(self) -> int:
        return len(self.means)

    def __call__(self, Z: Array) -> Array:
        """Return the values of all paths at the same points ``(m, d)``, shape ``(m, s)``."""
        waves = _waves(Z, self.frequencies) @ self.amplitudes
        return np.asarray(self.means + self.scales * (waves + self._correlations(Z) @ self.corrections))

    def roughly(self, Z: Array) -> Array:
        """Return the same values with waves in single precision: ten times as fast, and enough to choose candidates."""
        single = np.float32
        waves = _waves(Z.astype(single), self.frequencies.astype(single)) @ self.amplitudes.astype(single)
        # The corrections are sums of large terms that cancel, so they need double precision.
        return np.asarray(self.means + self.scales * (waves + self._correlations(Z) @ self.corrections))

    def own(self, Z: Array) -> Array:
        """Return the values of each path at its own points ``(s, q, d)``, shape ``(s, q)``."""
        return self.own_with_gradient(Z)[0]

    def own_with_gradient(self, Z: Array) -> tuple[Array, Array]:
        """Return values ``(s, q)`` and gradients ``(s, q, d)`` of each path at its own points ``(s, q, d)``."""
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
    """Return paths on the process's scale given points ``(n, d)``, with mu and sigma drawn from their posterior."""
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

    Candidates are uniform, near ``known`` points (best first) and at corners. They are divided into several groups, and
    each path is climbed from the best of each group. Beyond two dimensions there are more groups, only the highest
    climbs are completed, and in the end single coordinates are moved to their bounds while that increases the value.
    """
    d = paths.X.shape[1]
    near = np.repeat(known[:8], 16, axis=0)
    near = np.clip(near + rng.normal(size=near.shape) * rng.choice([0.003, 0.03], (len(near), 1)), 0.0, 1.0)
    corners = rng.integers(0, 2, (min(2**d, 256), d)).astype(np.float64)
    candidates = np.concatenate([known, near, corners, rng.random((min(2048, 512 * d), d))])
    values, groups = paths.roughly(candidates), 4 if d <= 2 else 4 * (1 + d)
    best_of = [candidates[group::groups][values[group::groups].argmax(axis=0)] for group in range(groups)]
    starts = np.stack(best_of, axis=1)  # (s, groups, d)
    if d > 2:
        climbed = _climb(paths, starts, 20)
        highest = np.argsort(-paths.own(climbed), axis=1)[:, :4]
        starts = np.take_along_axis(climbed, highest[..., None], axis=1)
    points = np.concatenate([starts, _climb(paths, starts, 30 if d <= 2 else 80)], axis=1)
    heights = paths.own(points)
    best, rows = np.argmax(heights, axis=1), np.arange(len(paths))
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
