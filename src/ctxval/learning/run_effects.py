r"""Effects of a whole execution: what its innovations have in common, such as a wet floor or a weak battery.

Innovations that are drawn step by step average out over an execution, and what is constant within it does not. So the
innovations e_k of execution k have random effects ``e_k = Phi_k b_k + w_k``, linear in the state and the input, with
``b_k ~ N(0, tau^2)`` for each state (Laird and Ware 1982). The residual r was learned of the same innovations and has
taken a part of the effects; with its hat matrix H, ``Phi' (1 - H) Phi`` takes the place of ``Phi' Phi``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows


@dataclass(frozen=True)
class RunEffectSettings:
    """When executions differ by more than independent steps do."""

    gain: float = 3.0  # gain of the log likelihood of a state's innovations from which executions differ
    correlation: float = 4.0  # standard deviations of a correlation of successive innovations that are not independent
    fewest: int = 6  # executions from which on it is tested whether effects change with something
    permutations: int = 999  # of these tests


@dataclass(frozen=True, eq=False)
class RunEffects:
    """The random effects of executions in unit innovations."""

    rows: tuple[Rows, ...]  # the innovations of each execution, in the order of time
    effects: Array  # b of each execution, (K, 1 + n + m, n)
    within: Array  # w, (N, n)
    gain: float  # the largest gain of the log likelihood of a state's innovations by such effects
    correlation: float  # the largest correlation of a state's successive innovations w, in its standard deviations
    settings: RunEffectSettings = RunEffectSettings()

    @property
    def matter(self) -> bool:
        """Whether innovations that are drawn step by step are no executions."""
        return self.gain > self.settings.gain or self.correlation > self.settings.correlation

    def drift(self, columns: Array) -> tuple[int, float] | None:
        """Return the column ``(K, c)`` with which the effects change most, and the p-value of a permutation test.

        The effects are summarised by their first principal component. It is None if there are none, or too few.
        """
        flat = self.effects.reshape(len(self.effects), -1)
        if not self.matter or len(flat) < self.settings.fewest or not flat.any():
            return None
        component = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[0][:, 0]
        rng = np.random.default_rng(len(flat))
        shuffled = [rng.permutation(len(flat)) for _ in range(self.settings.permutations)]
        orders = np.stack([np.arange(len(flat)), *shuffled])
        centred = columns - columns.mean(axis=0)
        unit = centred / np.maximum(np.linalg.norm(centred, axis=0), 1e-300)
        alike = np.abs(component[orders] @ unit)
        largest = alike.max(axis=1)
        return int(alike[0].argmax()), float((largest >= largest[0] - 1e-12).mean())

    def of(self, executions: Rows, pairs: Array) -> Array:
        """Return the effects ``(L, n)`` of executions ``(L,)`` at standardised states and inputs ``(L, n + m)``."""
        return np.asarray((regressors(pairs)[:, None] @ self.effects[executions])[:, 0])


def regressors(pairs: Array) -> Array:
    """Return the regressors ``(N, 1 + n + m)`` of effects at standardised states and inputs ``(N, n + m)``.

    These are limited to three standard deviations, because effects are not extrapolated.
    """
    return np.concatenate([np.ones((len(pairs), 1)), np.clip(pairs, -3.0, 3.0)], axis=1)


def run_effects(
    pairs: Array, innovations: Array, live: Mask, rows: Sequence[Rows], hats: Sequence[tuple[Array, Array]] | None
) -> RunEffects:
    """Return the effects of executions in unit innovations ``(N, n)`` at standardised states and inputs.

    ``hats`` are the features ``(N, F)`` of the residual of each learned state and the inverse ``(F, F)`` of their
    regularised second moments; None if innovations are those of a filter, which has no hat matrix.
    """
    Phi, sizes = regressors(pairs), np.logspace(-1.5, 1.0, 11)  # tau, in root mean squares of the innovations
    deviations = np.array([1.0, 0.9, 0.75, 0.5, 0.25, 0.1])  # of w
    effects, within = np.zeros((len(rows), Phi.shape[1], innovations.shape[1])), innovations.copy()
    gain = correlation = 0.0
    for place, i in enumerate(np.flatnonzero(live)):
        spectra = []
        for run in rows:
            P, e = Phi[run], innovations[run, i]
            moments = P.T @ P
            if hats is not None:
                features, inverse = hats[place][0][run], hats[place][1]
                moments = moments - P.T @ features @ inverse @ features.T @ P
            values, vectors = np.linalg.eigh(moments)
            spectra.append((np.maximum(values, 0.0), vectors, vectors.T @ (P.T @ e)))
        values, projected = (np.array([each[k] for each in spectra]) for k in (0, 2))
        squares = float((innovations[:, i] ** 2).sum())
        # The log likelihood for tau (rows) and the standard deviations of w (columns).
        s2, t2 = deviations[None, :, None, None] ** 2, np.concatenate([[0.0], sizes**2])[:, None, None, None]
        explained = (t2 * projected**2 / (s2 * (s2 + t2 * values))).sum(axis=(2, 3))
        volume = np.log1p(t2 * values / s2).sum(axis=(2, 3)) + len(innovations) * np.log(s2[..., 0, 0])
        heights = -0.5 * (volume + np.maximum(squares / s2[..., 0, 0] - explained, 0.0))
        j, k = np.unravel_index(int(heights.argmax()), heights.shape)
        gain = max(gain, float(heights.max() - heights[0].max()))
        if j:
            ridge = (deviations[k] / sizes[j - 1]) ** 2
            for number, (of_run, vectors, onto) in enumerate(spectra):
                effects[number, :, i] = vectors @ (onto / (of_run + ridge))
                within[rows[number], i] -= Phi[rows[number]] @ effects[number, :, i]
        following = sum(float(within[run[1:], i] @ within[run[:-1], i]) for run in rows)
        usual = np.sqrt(max(len(innovations) - len(rows), 1)) * max(float((within[:, i] ** 2).mean()), 1e-300)
        correlation = max(correlation, following / usual)
    return RunEffects(tuple(rows), effects, within, gain, correlation)
