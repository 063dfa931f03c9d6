"""Noisy dynamics: their posterior, and draws of it.

A draw has a residual and sequences of noise, and its distance is a quantile over these.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows, single_threaded
from ctxval._util.representation import ShortRepr
from ctxval.core.quantiles import QUANTILE
from ctxval.errors import InputError
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.features import Features, LinearFunction
from ctxval.learning.histories import Record
from ctxval.learning.innovations import DrawnWeights, InnovationsFit
from ctxval.learning.residual_data import ResidualData
from ctxval.learning.structures import ChosenStructure, fit_structures

MATTERS = 0.01
"""Standard deviation of the distance of a task over its executions, as a share of the largest distance, from which
noise matters."""

GROUPS, EACH = 5, 4  # draws of the hyperparameters, and of weights for each
REPLICATES = 10  # sequences of noise of each draw in a search
ROUGH = 3  # sequences of noise of the mean in a search of tasks, whose best ones are evaluated with all
SETTLED = 80  # sequences of noise at the tasks that a search has found


@dataclass(frozen=True, eq=False)
class NoisyDraws(ShortRepr):
    """S residuals with R sequences of noise each, which are the same in every task (common random numbers).

    Attributes:
        groups: residuals, in groups that are evaluated together.
        rows: recorded innovations that are the noise of each step, shape ``(S, R, T)``; longer loops repeat them.
        start: differences of the first records from the initial states of the tasks, shape ``(S, R, n)``.
        quantile: q; the distance of a draw is this quantile over its sequences of noise.
    """

    fit: InnovationsFit
    groups: tuple[DrawnWeights, ...]
    rows: Rows
    start: Array
    quantile: float
    left_out: float = 0.0

    @classmethod
    def of(
        cls, fit: InnovationsFit, groups: Sequence[DrawnWeights], scatter: Array, horizon: int, replicates: int,
        quantile: float, rng: np.random.Generator,
    ) -> NoisyDraws:  # fmt: skip
        """Return draws with fresh noise; the first records scatter with standard deviations ``(n,)``."""
        shape = (sum(len(weights) for _, weights, _ in groups), replicates)
        rows = rng.integers(len(fit.innovations), size=(*shape, horizon))
        return cls(fit, tuple(groups), rows, scatter * rng.standard_normal((*shape, len(scatter))), quantile)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def replicates(self) -> int:
        """The number R of sequences of noise."""
        return int(self.rows.shape[1])

    def with_replicates(self, count: int, rng: np.random.Generator) -> NoisyDraws:
        """Return the same residuals with other sequences of noise."""
        if self.replicates == 1:
            return self  # there is hardly any noise
        scatter = np.sqrt((self.start**2).mean(axis=(0, 1)))
        return NoisyDraws.of(self.fit, self.groups, scatter, self.rows.shape[2], count, self.quantile, rng)

    def without_noise(self) -> NoisyDraws:
        """Return the same residuals without noise."""
        groups = tuple((features, weights, np.zeros_like(noise)) for features, weights, noise in self.groups)
        return replace(self, groups=groups, rows=self.rows[:, :1], start=np.zeros_like(self.start[:, :1]))

    def __getitem__(self, rows: ArrayLike) -> NoisyDraws:
        """Return some draws; their rows are in ascending order."""
        chosen = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        groups, first = [], 0
        for features, weights, noise in self.groups:
            own = chosen[(chosen >= first) & (chosen < first + len(weights))] - first
            first += len(weights)
            if len(own):
                groups.append((features, weights[own], noise[own]))
        return replace(self, groups=tuple(groups), rows=self.rows[chosen], start=self.start[chosen])

    def reduced(self, distances: Array) -> Array:
        """Return the quantile over the noise of distances ``(S R, q)``, shape ``(S, q)``."""
        of_draws = distances.reshape(len(self), self.replicates, -1)
        if self.replicates == 1:
            return np.asarray(of_draws[:, 0])
        ordered = np.sort(of_draws, axis=1)  # NaN, of a task that cannot be planned, is last in every sequence
        return np.asarray(ordered[:, int(np.ceil(self.quantile * (self.replicates - 1)))])

    def runs(self, draws: Rows, replicates: Rows, start: Array) -> NoisyRuns:
        """Return closed loops from initial states ``(..., n)``, of one draw and sequence of noise each, ``(...)``."""
        return NoisyRuns(self, draws.ravel(), replicates.ravel(), start)


class NoisyRuns:
    """The steps of closed loops that run together, one after the other; it remembers their histories.

    Attributes:
        first: the first records, shape ``(..., n)``.
    """

    def __init__(self, draws: NoisyDraws, of_draw: Rows, of_replicate: Rows, start: Array) -> None:
        self._draws, self._fit = draws, draws.fit
        self._of_draw, self._of_replicate = of_draw, of_replicate
        flat = start.reshape(-1, start.shape[-1])
        self.first = (flat + draws.start[of_draw, of_replicate]).reshape(start.shape)
        self._memory = self._fit.history.start(self.first.reshape(flat.shape), flat, self._fit.scaled.inputs)
        self._noise = np.concatenate([noise for _, _, noise in draws.groups])[of_draw]
        self._step = 0

    @functools.cached_property
    def _parts(self) -> list[tuple[Features, Rows, list[tuple[Rows, LinearFunction]]]]:
        """Of each group: the loops of its draws, and for each draw, which of these are its own, and its residual."""
        parts, first = [], 0
        for features, weights, _ in self._draws.groups:
            loops = np.flatnonzero((self._of_draw >= first) & (self._of_draw < first + len(weights)))
            of_draw = self._of_draw[loops] - first
            each = [(np.flatnonzero(of_draw == k), features.function(own)) for k, own in enumerate(weights)]
            if len(loops):
                parts.append((features, loops, each))
            first += len(weights)
        return parts

    def step(self, x: Array, u: Array) -> Array:
        """Return the next records, shapes ``(..., n), (..., m) -> (..., n)``."""
        fit, memory = self._fit, self._memory
        flat = u.reshape(-1, u.shape[-1])[:, : fit.scaled.inputs]  # those that act
        with np.errstate(all="ignore"):
            z = (fit.history.regressors(memory, flat) - fit.scaled.shift) / fit.scaled.scale
            z = np.clip(np.nan_to_num(z, nan=0.0, posinf=1e3, neginf=-1e3), -1e3, 1e3)
            residual = np.zeros((len(flat), x.shape[-1]))
            for features, loops, each in self._parts:
                residual[loops] = features.values(z[loops], each)
            of_model = fit.history.model.step(memory.estimate, flat)
            predicted = of_model + residual
            record = predicted
            if self._noise.any():
                steps = self._draws.rows.shape[2]
                rows = self._draws.rows[self._of_draw, self._of_replicate, self._step % steps]
                noise = fit.innovations[rows] * self._noise
                if fit.local is not None:
                    noise *= fit.local(z[:, : fit.local.centres.shape[1]])[:, None]
                record = predicted + noise
            self._memory = fit.history.after(memory, flat, of_model, predicted, record)
        self._step += 1
        return np.asarray(record.reshape(x.shape))


@dataclass(frozen=True, eq=False)
class NoisyPosterior(ShortRepr):
    """The posterior of noisy dynamics, as a search of the worst task sees it.

    Attributes:
        data: transitions as those of a state, which tell what is recorded.
        scatter: standard deviations of first records from the initial states of their tasks, shape ``(n,)``.
        horizon: number of steps of the longest record.
        replicates: sequences of noise of each draw in a search.
    """

    fit: InnovationsFit
    data: ResidualData
    scatter: Array
    horizon: int
    replicates: int
    quantile: float
    seed: tuple[int, ...]

    @property
    def noise(self) -> float:
        """The variance of noise as a share of the mean square of a state's error of M, where it is largest."""
        return self.fit.share

    @property
    def groups(self) -> int:
        """The number of draws of the hyperparameters."""
        return GROUPS

    @property
    def functions(self) -> int:
        """The usual number of weights that are drawn for each of them."""
        return EACH

    def with_effect(self, effect: float) -> NoisyPosterior:
        """Return it without noise if noise changes distances by less than a share of the largest one."""
        return self if effect > MATTERS else replace(self, replicates=1)

    @property
    def is_noisy(self) -> bool:
        """Whether the distances of executions of one task differ."""
        return self.replicates > 1

    @functools.cached_property
    def mean(self) -> NoisyDraws:
        """The most probable residual, as one draw."""
        rng = np.random.default_rng([*self.seed, 1])
        most = self.fit.most_probable
        return self._with_noise(most, rng)

    @functools.cached_property
    def searched(self) -> NoisyDraws:
        """The same with fewer sequences of noise, with which a search finds the same tasks."""
        if self.mean.replicates <= ROUGH:
            return self.mean
        return replace(self.mean, rows=self.mean.rows[:, :ROUGH], start=self.mean.start[:, :ROUGH])

    @property
    def rough_mean(self) -> NoisyDraws:
        """What is searched; nothing is cheaper and as good."""
        return self.searched

    @functools.cached_property
    def silent(self) -> NoisyDraws:
        """The most probable residual without noise."""
        return self.mean.without_noise() if self.is_noisy else self.mean

    def draw(
        self,
        relevant: Array,
        rng: np.random.Generator,
        functions: int | None = None,
        hyperparameters: int | None = None,
    ) -> NoisyDraws:
        """Return draws; see :meth:`DynamicsPosterior.draw`. Nothing depends on ``relevant``."""
        groups, each = GROUPS, EACH if functions is None else functions
        if hyperparameters is not None:
            groups, each = hyperparameters // 2, 2 * each  # a few for a screening
        drawn = self.fit.draw(groups, each, rng)
        return self._with_noise(drawn, rng)

    def _with_noise(self, drawn: Sequence[DrawnWeights], rng: np.random.Generator) -> NoisyDraws:
        draws = NoisyDraws.of(self.fit, drawn, self.scatter, self.horizon, self.replicates, self.quantile, rng)
        return draws if self.is_noisy else draws.without_noise()


def learn_noisy(
    posterior: DynamicsPosterior,
    records: Sequence[Record],
    pairs: Array,
    chosen: ChosenStructure | None = None,
    *,
    replicates: int = REPLICATES,
    quantile: float = QUANTILE,
    seed: tuple[int, ...] = (0,),
) -> tuple[NoisyPosterior, ChosenStructure] | None:
    """Return the posterior of noisy dynamics, and its structure, which is learned unless it was chosen before.

    Returns None if nothing can be learned: the recursions diverge, or numbers are too large.

    Args:
        posterior: that of dynamics without noise and history, for its model and its units.
        pairs: states and inputs of closed loops on M, shape ``(V, n + m)``.
    """
    try:
        with single_threaded(), np.errstate(all="ignore"):
            fit, chosen = fit_structures(posterior.model, records, pairs, posterior.data.learned, chosen)
    except (np.linalg.LinAlgError, InputError, ValueError):  # numbers that are not finite
        return None
    horizon = max(len(record.inputs) for record in records)
    return NoisyPosterior(fit, posterior.data, scatter_of(records), horizon, replicates, quantile, seed), chosen


def scatter_of(records: Sequence[Record]) -> Array:
    """Return the standard deviations of first records from the initial states of their tasks, shape ``(n,)``."""
    return np.asarray(np.sqrt(np.mean([(record.states[0] - record.start) ** 2 for record in records], axis=0)))
