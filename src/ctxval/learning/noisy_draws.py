"""Noisy dynamics: their posterior, and draws of it.

A draw has a residual and sequences of noise, and its distance is a quantile over these. If executions differ by more
than independent steps do, every second sequence is that of a whole execution with its effects, and the larger one of
the quantiles over both kinds of sequences counts.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Step
from ctxval.learning.draws import Draws
from ctxval.learning.features import Features, LinearFunction
from ctxval.learning.innovations import DrawnWeights, InnovationsFit
from ctxval.learning.residual_data import ResidualData


@dataclass(frozen=True)
class NoisyDrawSettings:
    """Numbers of draws of noisy dynamics, and of their sequences of noise."""

    groups: int = 5  # draws of the hyperparameters
    functions: int = 4  # usual number of weights for each of them
    rough: int = 3  # sequences of noise of the mean in a search of tasks, whose best ones are evaluated with all
    settled: int = 80  # sequences of noise at the tasks that a search has found


@dataclass(frozen=True, eq=False)
class NoisyDraws(Draws):
    """S residuals with R sequences of noise each, which are the same in every task (common random numbers)."""

    fit: InnovationsFit
    groups: tuple[DrawnWeights, ...]  # residuals, in groups that are evaluated together
    rows: Rows  # recorded innovations that are the noise of each step, (S, R, T); longer loops repeat them
    start: Array  # differences of the first records from the initial states of the tasks, (S, R, n)
    quantile: float  # q; the distance of a draw is this quantile over its sequences of noise
    of_runs: Rows | None = None  # the execution whose innovations each sequence has, or -1, (S, R); None without any
    left_out: float = 0.0
    settings: NoisyDrawSettings = NoisyDrawSettings()

    @classmethod
    def of(
        cls, fit: InnovationsFit, groups: Sequence[DrawnWeights], scatter: Array, horizon: int, replicates: int,
        quantile: float, rng: np.random.Generator, settings: NoisyDrawSettings,
    ) -> Self:  # fmt: skip
        """Return draws with fresh noise; the first records scatter with standard deviations ``(n,)``."""
        whole = replicates > 1 and fit.runs.matter
        shape = (sum(len(weights) for _, weights, _ in groups), replicates * (2 if whole else 1))
        rows = rng.integers(len(fit.innovations), size=(*shape, horizon))
        of_runs = None
        if whole:
            of_runs = rng.integers(len(fit.executions), size=shape)
            of_runs[:, ::2] = -1
            along = np.array([np.resize(run, horizon) for run in fit.executions])
            rows[:, 1::2] = along[of_runs[:, 1::2]]
        start = scatter * rng.standard_normal((*shape, len(scatter)))
        return cls(fit, tuple(groups), rows, start, quantile, of_runs, settings=settings)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def replicates(self) -> int:
        """The number R of sequences of noise."""
        return int(self.rows.shape[1])

    @functools.cached_property
    def searched(self) -> Self:
        """The same with fewer sequences of noise, with which a search finds the same tasks."""
        rough = self.settings.rough * self.kinds
        return self._first(rough) if self.replicates > rough else self

    @property
    def kinds(self) -> int:
        """The number of kinds of sequences of noise, which take turns."""
        return 1 if self.of_runs is None else 2

    def _first(self, replicates: int) -> Self:
        of_runs = None if self.of_runs is None else self.of_runs[:, :replicates]
        return replace(self, rows=self.rows[:, :replicates], start=self.start[:, :replicates], of_runs=of_runs)

    @property
    def of_steps(self) -> Self:
        """The same with the sequences of independent steps alone."""
        return replace(self, rows=self.rows[:, :: self.kinds], start=self.start[:, :: self.kinds], of_runs=None)

    def settled(self, rng: np.random.Generator) -> Self:
        """Return the same residuals with many other sequences of noise."""
        if self.replicates == 1:
            return self  # there is hardly any noise
        scatter = np.sqrt((self.start**2).mean(axis=(0, 1)))
        settings, horizon = self.settings, self.rows.shape[2]
        return self.of(self.fit, self.groups, scatter, horizon, settings.settled, self.quantile, rng, settings)

    def without_noise(self) -> Self:
        """Return the same residuals without noise."""
        groups = tuple((features, weights, np.zeros_like(noise)) for features, weights, noise in self.groups)
        return replace(self._first(1), groups=groups, start=np.zeros_like(self.start[:, :1]), of_runs=None)

    def __getitem__(self, rows: ArrayLike) -> Self:
        """Return some draws; their rows are in ascending order."""
        chosen = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        groups, first = [], 0
        for features, weights, noise in self.groups:
            some = chosen[(chosen >= first) & (chosen < first + len(weights))] - first
            first += len(weights)
            if len(some):
                groups.append((features, weights[some], noise[some]))
        of_runs = None if self.of_runs is None else self.of_runs[chosen]
        rows, start = self.rows[chosen], self.start[chosen]
        return replace(self, groups=tuple(groups), rows=rows, start=start, of_runs=of_runs)

    def begun(self, rows: Rows, tasks: int, start: Array) -> tuple[Array, Step]:
        """Return the first states, and a step that is called once for each step of the loops."""
        runs = NoisyRuns(self, *np.divmod(rows // tasks, self.replicates), start)
        return runs.first, runs.step

    def reduced(self, distances: Array) -> Array:
        """Return the quantile over the noise of distances ``(S R, q)``, shape ``(S, q)``."""
        each = self.replicates // self.kinds
        of_draws = distances.reshape(len(self), each, self.kinds, -1)
        if each == 1:
            return np.asarray(of_draws.max(axis=(1, 2)))
        ordered = np.sort(of_draws, axis=1)  # NaN, of a task that cannot be planned, is last in every sequence
        return np.asarray(ordered[:, int(np.ceil(self.quantile * (each - 1)))].max(axis=1))


class NoisyRuns:
    """The steps of closed loops that run together, one after the other; it remembers their histories."""

    def __init__(self, draws: NoisyDraws, of_draw: Rows, of_replicate: Rows, start: Array) -> None:
        self._draws, self._fit = draws, draws.fit
        self._of_draw, self._of_replicate = of_draw.ravel(), of_replicate.ravel()
        flat = start.reshape(-1, start.shape[-1])
        self.first = (flat + draws.start[self._of_draw, self._of_replicate]).reshape(start.shape)
        self._memory = self._fit.history.start(self.first.reshape(flat.shape), flat, self._fit.scaled.inputs)
        self._noise = np.concatenate([noise for _, _, noise in draws.groups])[self._of_draw]
        self._step = 0
        # Of each group: the loops of its draws, and for each draw, which of these are its own, and its residual.
        self._parts: list[tuple[Features, Rows, list[tuple[Rows, LinearFunction]]]] = []
        first = 0
        for features, weights, _ in draws.groups:
            loops = np.flatnonzero((self._of_draw >= first) & (self._of_draw < first + len(weights)))
            draw = self._of_draw[loops] - first
            each = [(np.flatnonzero(draw == k), features.function(of_draw)) for k, of_draw in enumerate(weights)]
            if len(loops):
                self._parts.append((features, loops, each))
            first += len(weights)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next records, shapes ``(..., n), (..., m) -> (..., n)``."""
        fit, memory = self._fit, self._memory
        flat = u.reshape(math.prod(u.shape[:-1]), u.shape[-1])
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
                unit = fit.innovations[rows]
                if self._draws.of_runs is not None:
                    runs = self._draws.of_runs[self._of_draw, self._of_replicate]
                    whole = np.flatnonzero(runs >= 0)
                    pairs = z[whole, : x.shape[-1] + fit.scaled.inputs]
                    unit[whole] = fit.runs.within[rows[whole]] + fit.runs.of(runs[whole], pairs)
                noise = unit * self._noise
                if fit.local is not None:
                    noise *= fit.local(z[:, : fit.local.centres.shape[1]])[:, None]
                record = predicted + noise
            self._memory = fit.history.after(memory, flat, of_model, predicted, record)
        self._step += 1
        return np.asarray(record.reshape(x.shape))


@dataclass(frozen=True, eq=False)
class NoisyPosterior(ShortRepr):
    """The posterior of noisy dynamics, as a search of the worst task sees it."""

    fit: InnovationsFit
    data: ResidualData  # transitions as those of a state, which tell what is recorded
    scatter: Array  # standard deviations of first records from the initial states of their tasks, (n,)
    horizon: int  # number of steps of the longest record
    replicates: int  # sequences of noise of each draw in a search
    quantile: float
    seed: tuple[int, ...]
    settings: NoisyDrawSettings = NoisyDrawSettings()

    has_pivots: ClassVar[bool] = False  # draws are not those of a DynamicsPosterior

    def functions_for(self, draws: int) -> int:
        """Return the number of weights for each draw of the hyperparameters that gives at least so many draws."""
        return max(self.settings.functions, -(-draws // self.settings.groups))

    @property
    def noise(self) -> float:
        """The variance of noise as a share of the mean square of a state's error of M, where it is largest."""
        return self.fit.share

    @property
    def is_noisy(self) -> bool:
        """Whether the distances of executions of one task differ."""
        return self.replicates > 1

    @functools.cached_property
    def mean(self) -> NoisyDraws:
        """The most probable residual, as one draw."""
        most = [(self.fit.features, self.fit.weights[None], self.fit.noise[None])]
        return self._with_noise(most, np.random.default_rng([*self.seed, 1]))

    @property
    def rough_mean(self) -> NoisyDraws:
        """What is searched; nothing is cheaper and as good."""
        return self.mean.searched

    def with_noise(self, runs: int, least: Array) -> NoisyDraws | None:
        """Return the mean with noise in steps; None if all deviations are at most those that are given, ``(n,)``."""
        return self.mean.of_steps if ((self.fit.noise > least) | (self.scatter > least)).any() else None

    def draw(
        self,
        relevant: Array,
        rng: np.random.Generator,
        functions: int | None = None,
        hyperparameters: int | None = None,
    ) -> NoisyDraws:
        """Return draws; see :meth:`DynamicsPosterior.draw`. Nothing depends on ``relevant``."""
        groups, each = self.settings.groups, self.settings.functions if functions is None else functions
        if hyperparameters is not None:
            groups, each = hyperparameters // 2, 2 * each  # a few for a screening
        return self._with_noise(self.fit.draw(groups, each, rng), rng)

    def _with_noise(self, drawn: Sequence[DrawnWeights], rng: np.random.Generator) -> NoisyDraws:
        sizes = self.scatter, self.horizon, self.replicates, self.quantile
        draws = NoisyDraws.of(self.fit, drawn, *sizes, rng, self.settings)
        return draws if self.is_noisy else draws.without_noise()
