"""The posterior of the dynamics: ``S(x, u) = M(x, u) + r(x, u)`` with a Gaussian process of unknown hyperparameters.

Functions r_s are drawn from it; each makes a model ``M + r_s``. A draw is exact at pivots, which are state-input pairs
that the closed loops of the tasks visit, and is interpolated between them. So it is a sum of covariances with centres
that all draws of one set of hyperparameters share, and thousands of closed loops on it are cheap.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np

from ctxval._util.arrays import Array, Rows, rows_of, single_threaded
from ctxval._util.representation import call
from ctxval.core.model import Model
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError
from ctxval.gp.cholesky import CholeskyFactor, factorise, tenfold
from ctxval.gp.subset import pivoted_cholesky, pivoted_rows
from ctxval.learning.hyperparameters import (
    FAMILIES,
    SMOOTHER_FAMILIES,
    Hyperparameters,
    draw_hyperparameters,
    learning_rows,
)
from ctxval.learning.kernel_expansion import KernelExpansion
from ctxval.learning.recorded import affordable_centres
from ctxval.learning.residual_data import ResidualData, residual_data
from ctxval.learning.without_model import smoother_than

_PIVOT = 0.1
"""Variance, as a share of the noise, below which a transition adds nothing to those chosen before it."""
_NEGLIGIBLE = 1e-6
"""Share of the largest posterior variance below which a pivot adds nothing to those chosen before it."""
_ROUNDING = 1e-13
"""Posterior variances below this share of the prior variance are rounding errors."""
_CENTRES = (150, 400)
"""Least and largest number of centres."""
_LARGEST = 1e6
"""Standardised pairs are limited to this magnitude, so that a loop that diverges stays finite in its residual."""


@dataclass(frozen=True)
class PosteriorSettings:
    """Numbers on which the accuracy and the cost of the posterior depend.

    Attributes:
        hyperparameters: number of draws of the hyperparameters.
        functions: number of functions that are drawn for each of them.
        learned_from: number of transitions that the hyperparameters are learned from.
        centres: largest number of transitions that each process is conditioned on.
        pivots: largest number of pairs at which a draw is exact.
        families: smoothness and growth of each family of covariances.
    """

    hyperparameters: int = 20
    functions: int = 2
    learned_from: int = 120
    centres: int = 400
    pivots: int = 100
    families: tuple[tuple[float, float], ...] = FAMILIES

    @classmethod
    def for_horizon(cls, horizon: int) -> PosteriorSettings:
        """Return settings in which a closed loop of many steps has fewer centres, so that it does not take longer."""
        return cls(centres=affordable_centres(horizon, *_CENTRES))

    def without_model(self) -> PosteriorSettings:
        """Return settings for learning S itself, which is smoother than the error of M and takes more transitions."""
        return replace(self, centres=2 * self.centres, families=SMOOTHER_FAMILIES)


@dataclass(frozen=True, eq=False)
class Component:
    """The posterior of r for one draw of the hyperparameters.

    Attributes:
        hyperparameters: the covariance and its hyperparameters.
        centres: standardised pairs that it is conditioned on, shape ``(M, k)``.
        factor: Cholesky factor of their covariance with noise.
        weights: weights of the mean, shape ``(M, n)``.
        squares: squared size of each state's residuals, relative to the covariance, shape ``(n,)``.
        amplitudes: standard deviations of the states' residuals, relative to the covariance, shape ``(n,)``.
    """

    hyperparameters: Hyperparameters
    centres: Array
    factor: CholeskyFactor
    weights: Array
    squares: Array
    amplitudes: Array

    @classmethod
    def conditioned(
        cls, hyperparameters: Hyperparameters, Z: Array, Y: Array, centres: int, rng: np.random.Generator
    ) -> Component:
        """Return the process conditioned on well-spread pairs, with amplitudes drawn from their posterior."""
        kernel, theta, noise = hyperparameters.kernel, hyperparameters.theta, hyperparameters.noise
        rows = pivoted_rows(kernel, theta, Z, centres, least=_PIVOT * noise)
        factor = factorise(kernel(theta, Z[rows], Z[rows]), tenfold(noise))
        weights = factor.solve(Y[rows])
        squares = (Y[rows] * weights).sum(axis=0)
        return cls(hyperparameters, Z[rows], factor, weights, squares, _amplitudes(squares, len(rows), rng))

    def again(self, rng: np.random.Generator) -> Component:
        """Return the same process with other amplitudes."""
        return replace(self, amplitudes=_amplitudes(self.squares, len(self.centres), rng))

    @property
    def mean(self) -> KernelExpansion:
        """The posterior mean, as one function."""
        return KernelExpansion(self.hyperparameters, self.centres, self.weights[None])

    @property
    def noise(self) -> Array:
        """The standard deviation of the noise of each standardised residual, shape ``(n,)``."""
        return np.asarray(np.sqrt(self.hyperparameters.noise) * self.amplitudes)

    def variance(self, Z: Array) -> Array:
        """Return the posterior variance at pairs ``(N, k)``, relative to the amplitudes, shape ``(N,)``."""
        return self._halved(Z)[1]

    def _halved(self, Z: Array) -> tuple[Array, Array]:
        kernel, theta = self.hyperparameters.kernel, self.hyperparameters.theta
        half = self.factor.whiten(kernel(theta, self.centres, Z))
        return half, np.maximum(kernel.diagonal(theta, Z) - (half**2).sum(axis=0), 0.0)

    def draw(self, relevant: Array, count: int, pivots: int, rng: np.random.Generator) -> tuple[KernelExpansion, float]:
        """Return draws that are exact at pivots, and the share of the variance that they leave out elsewhere.

        Args:
            relevant: pairs ``(R, k)`` that closed loops visit; the pivots are chosen from them.
            count: number of draws.
            pivots: largest number of pivots.
            rng: the source of the draws.
        """
        return _drawn([self], relevant, count, pivots, rng)

    def pivots(self, relevant: Array, count: int) -> tuple[Rows, Array, float]:
        """Return rows by pivoted Cholesky of the posterior covariance, its factor, and the share of variance left."""
        kernel, theta = self.hyperparameters.kernel, self.hyperparameters.theta
        half, left = self._halved(relevant)
        first = left.max(initial=0.0)
        # Variances below the noise are drawn too: many noisy transitions determine a function better than one does.
        rounding = _ROUNDING * kernel.diagonal(theta, relevant).max(initial=0.0)
        towards = kernel.towards(theta, relevant)

        def covariances(row: int) -> Array:
            return np.asarray(towards(relevant[row : row + 1])[0] - half[:, row] @ half)

        found = pivoted_cholesky(left, covariances, count, least=max(_NEGLIGIBLE * first, rounding))
        left_out = found.left.max() / first if first > rounding else 0.0
        return found.rows, found.L, float(left_out)


def _amplitudes(squares: Array, count: int, rng: np.random.Generator) -> Array:
    """Return a draw of the amplitudes from their posterior, given ``count`` transitions."""
    return np.asarray(np.sqrt(squares / rng.chisquare(count, len(squares))))


def _drawn(
    alike: Sequence[Component], relevant: Array, count: int, pivots: int, rng: np.random.Generator
) -> tuple[KernelExpansion, float]:
    """Return ``count`` draws of each of some components that differ in their amplitudes only; see Component.draw."""
    own = alike[0]
    chosen, L, left_out = own.pivots(relevant, pivots)
    if not len(chosen):
        return own.mean.repeated(count * len(alike)), left_out
    kernel, theta = own.hyperparameters.kernel, own.hyperparameters.theta
    shape = (count, len(chosen), own.weights.shape[1])
    normal = np.concatenate([rng.standard_normal(shape) * one.amplitudes for one in alike])
    # The values L xi at the pivots are interpolated by the posterior covariance L L', with weights L'^-1 xi.
    weights = np.linalg.solve(L.T, normal)
    cross = own.factor.solve(kernel(theta, own.centres, relevant[chosen]))
    together = np.concatenate([own.weights - np.matmul(cross, weights), weights], axis=1)
    centres = np.concatenate([own.centres, relevant[chosen]])
    return KernelExpansion(own.hyperparameters, centres, together), left_out


@dataclass(frozen=True, eq=False)
class DynamicsPosterior:
    """The posterior of the dynamics of S, given recorded transitions.

    Attributes:
        model: the model to which residuals are added: M, or a linear one.
        data: the standardised residuals.
        components: posteriors of the learned states, one for each draw of the hyperparameters; the first one has the
            most probable hyperparameters.
        settings: its settings.
        without_model: whether residuals are added to a linear model, because M is rougher than the system.
    """

    model: Model
    data: ResidualData
    components: tuple[Component, ...]
    settings: PosteriorSettings = field(default_factory=PosteriorSettings)
    without_model: bool = False

    @property
    def mean(self) -> DynamicsDraws:
        """The model M plus the posterior mean of r for the most probable hyperparameters, as one draw."""
        return DynamicsDraws(self.model, self.data, (self.components[0].mean,), (0.0,))

    def draw(self, relevant: Array, rng: np.random.Generator, functions: int | None = None) -> DynamicsDraws:
        """Return draws of the dynamics.

        Args:
            relevant: standardised pairs ``(R, k)`` that closed loops visit.
            rng: the source of the draws.
            functions: number of functions for each draw of the hyperparameters; that of the settings if None.
        """
        count = self.settings.functions if functions is None else functions
        with single_threaded():
            # Adjacent components of the same hyperparameters share their pivots and are evaluated together.
            groups = [list(group) for _, group in groupby(self.components, lambda one: id(one.hyperparameters))]
            drawn = [_drawn(group, relevant, count, self.settings.pivots, rng) for group in groups]
        return DynamicsDraws(self.model, self.data, *(tuple(part) for part in zip(*drawn, strict=True)))

    @property
    def noise(self) -> float:
        """The learned variance of noise, as a share of the mean square of a state's residual.

        It is the median over the draws of the hyperparameters, of the state in which it is largest.
        """
        return float(np.median([(one.noise**2).max() for one in self.components]))

    def __repr__(self) -> str:
        return call(self, self.model, components=len(self.components), data=self.data)


@dataclass(frozen=True, eq=False)
class DynamicsDraws:
    """S models ``M + r_s``, run together: a draw is the first axis of states and inputs.

    Attributes:
        model: the model M.
        data: constants that standardise pairs and residuals.
        expansions: functions r_s, in groups that share their centres.
        left_out: share of the posterior variance that the draws of each group leave out between pivots.
    """

    model: Model
    data: ResidualData
    expansions: tuple[KernelExpansion, ...]
    left_out: tuple[float, ...]

    def __len__(self) -> int:
        return sum(len(one.weights) for one in self.expansions)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, shapes ``(S, q, n), (S, q, m) -> (S, q, n)``."""
        with np.errstate(all="ignore"):
            z = self.data.standardised(x, u)
            np.maximum(z, -_LARGEST, out=z)
            np.minimum(z, _LARGEST, out=z)
            z[np.isnan(z)] = 0.0
            residuals, learned, first = np.zeros_like(x), self.data.learned, 0
            for one in self.expansions:
                last = first + len(one.weights)
                residuals[first:last, :, learned] = one(z[first:last])
                first = last
            return self.model.step(x, u) + residuals * self.data.units

    def between(self, first: int, last: int) -> DynamicsDraws:
        """Return the draws from ``first`` up to and without ``last``."""
        groups, left_out, start = [], [], 0
        for one, left in zip(self.expansions, self.left_out, strict=True):
            own = one.weights[max(first - start, 0) : max(last - start, 0)]
            if len(own):
                groups.append(KernelExpansion(one.hyperparameters, one.centres, own))
                left_out.append(left)
            start += len(one.weights)
        return DynamicsDraws(self.model, self.data, tuple(groups), tuple(left_out))

    def __getitem__(self, index: int) -> DrawnModel:
        """Return one draw as a model."""
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} draws.")
        return DrawnModel(self.between(index, index + 1))

    def __repr__(self) -> str:
        return call(self, self.model, draws=len(self))


class DrawnModel:
    """The model ``M + r_s`` of one draw.

    Args:
        draws: draws of the dynamics with one member.
    """

    def __init__(self, draws: DynamicsDraws) -> None:
        self._draws = draws

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return np.asarray(self._draws.step(rows_of(x)[None], rows_of(u)[None]).reshape(x.shape))


def learn_posterior(
    model: Model,
    transitions: Transitions,
    sources: Rows,
    rng: np.random.Generator,
    settings: PosteriorSettings | None = None,
) -> DynamicsPosterior | None:
    """Return the posterior of the dynamics given recorded transitions.

    Returns None if fewer than two transitions are usable, or if M explains all of them. If M is rougher than S, the
    residuals are those of a linear model (:mod:`ctxval.learning.without_model`).

    Args:
        model: the model M.
        transitions: N transitions of the system.
        sources: the execution of each transition; -1 for data that the model was made from, shape ``(N,)``.
        rng: the source of the draws of the hyperparameters.
        settings: numbers on which accuracy and cost depend; the defaults if None.
    """
    chosen = PosteriorSettings() if settings is None else settings
    data = residual_data(model, transitions, sources)
    if data is None:
        return None
    with single_threaded():
        smoother = None
        with contextlib.suppress(InputError, np.linalg.LinAlgError):  # numbers too large for a linear model
            smoother = smoother_than(data, chosen.learned_from)
        if smoother is not None:
            model, data = smoother
            chosen = chosen.without_model()
        Z, Y = data.pairs, data.outputs[:, data.learned]
        rows = learning_rows(Z, data.inputs, chosen.learned_from)
        drawn = draw_hyperparameters(Z[rows], Y[rows], data.inputs, chosen.hyperparameters, rng, chosen.families)
        components = tuple(_conditioned(drawn, Z, Y, chosen.centres, rng))
    return DynamicsPosterior(model, data, components, chosen, smoother is not None)


def _conditioned(
    drawn: Sequence[Hyperparameters], Z: Array, Y: Array, centres: int, rng: np.random.Generator
) -> list[Component]:
    """Return the processes of those hyperparameters whose covariance matrix is positive definite."""
    found: list[Component] = []
    for one in drawn:
        if found and found[-1].hyperparameters is one:
            found.append(found[-1].again(rng))
            continue
        with contextlib.suppress(InputError):
            found.append(Component.conditioned(one, Z, Y, centres, rng))
    return found
