"""The posterior of the dynamics: ``S(x, u) = M(x, u) + r(x, u)`` with a Gaussian process of unknown hyperparameters.

Its mean, for the most probable hyperparameters, predicts; its variance is the doubt of a prediction; and functions r_s
are drawn from it, each of which makes a model ``M + r_s``. A draw is exact at pivots, which are state-input pairs that
the closed loops of the tasks visit, and is interpolated between them. So all of these are sums of covariances with
centres, and thousands of closed loops on them are cheap.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows, single_threaded
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.core.state_geometry import PLAIN, StateGeometry
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError
from ctxval.gp.cholesky import CholeskyFactor, factorise, pivoted_rows
from ctxval.learning.draws import DisturbedDynamics, DynamicsDraws, bounded
from ctxval.learning.hyperparameters import (
    FAMILIES,
    SMOOTHER_FAMILIES,
    HyperparameterPosterior,
    ResidualHyperparameters,
)
from ctxval.learning.kernel_expansion import Component, KernelExpansion, draw_functions, joined
from ctxval.learning.residual_data import ResidualData, residual_data, smoother_than, with_what_varies
from ctxval.learning.settling import SettlingModel


@dataclass(frozen=True)
class PosteriorSettings:
    """Numbers on which the accuracy and the cost of the posterior depend."""

    hyperparameters: int = 20  # number of draws of the hyperparameters
    functions: int = 2  # number of functions that are drawn for each of them
    learned_from: int = 120  # number of transitions that the hyperparameters are learned from
    centres: int = 400  # largest number of transitions that each process is conditioned on
    least_variance: float = 0.1  # share of the noise below which a transition's variance given the chosen adds nothing
    pivots: int = 100  # largest number of pairs at which a draw is exact
    families: tuple[tuple[float, float], ...] = FAMILIES  # smoothness and growth of each family of covariances
    varies: float = 0.3  # log evidence per recorded value from which residuals depend on states that M says invariant
    of_steps: bool = True  # whether the system may be learned without M, if M is rougher than the system

    @classmethod
    def for_horizon(cls, horizon: int) -> PosteriorSettings:
        """Return settings in which a closed loop of many steps has fewer centres, so that it does not take longer."""
        return cls(centres=int(np.clip(30_000 // horizon, 150, 400)))


@dataclass(frozen=True, eq=False)
class LearnedCovariances(ShortRepr):
    """The posterior of the hyperparameters, learned from the transitions of some executions."""

    model: Model  # the model to which residuals are added: M, or a linear one
    without_model: bool  # whether it is a linear one, because M is rougher than the system
    scale: Array  # the units of the standardised pairs to which the hyperparameters belong, (n + m,)
    posterior: HyperparameterPosterior
    settings: PosteriorSettings
    seed: tuple[int, ...]
    geometry: StateGeometry = PLAIN  # of the states, as residuals depend on them

    @functools.cached_property
    def drawn(self) -> list[ResidualHyperparameters]:
        """The draws of the hyperparameters; the first one is their mode."""
        rng = np.random.default_rng(self.seed)
        with single_threaded():
            return [self.posterior.mode, *self.posterior.draw(self.settings.hyperparameters - 1, rng)]


@dataclass(frozen=True, eq=False)
class DynamicsPosterior(ShortRepr):
    """The posterior of the dynamics of S, given recorded transitions."""

    covariances: LearnedCovariances
    data: ResidualData
    # the process for each draw of the hyperparameters, by its identity
    _of_draws: dict[int, Component] = field(default_factory=dict, init=False, repr=False)

    has_pivots: ClassVar[bool] = True  # whether draws are exact at some of the pairs that closed loops visit

    def functions_for(self, draws: int) -> int:
        """Return the number of functions for each draw of the hyperparameters that gives at least so many draws."""
        return max(self.covariances.settings.functions, -(-draws // len(self.components)))

    @functools.cached_property
    def most_probable(self) -> Component:
        """The posterior of the learned states for the mode of the hyperparameters."""
        return self._component(self.covariances.posterior.mode, self._rng(0))

    @functools.cached_property
    def components(self) -> tuple[Component, ...]:
        """The posteriors of the learned states for each draw of the hyperparameters, the mode first."""
        return self._components(range(1, len(self.covariances.drawn)))

    def _components(self, rows: Iterable[int]) -> tuple[Component, ...]:
        components, drawn = [self.most_probable], self.covariances.drawn
        for row in rows:
            with contextlib.suppress(InputError):  # its covariance matrix is not positive definite
                if id(drawn[row]) not in self._of_draws:
                    self._of_draws[id(drawn[row])] = self._component(drawn[row], self._rng(row))
                components.append(self._of_draws[id(drawn[row])].again(self._rng(row)))
        return tuple(components)

    @functools.cached_property
    def rows(self) -> Rows:
        """The transitions that represent the others for the most probable hyperparameters, by their variance."""
        most, settings = self._rescaled(self.covariances.posterior.mode), self.covariances.settings
        least = settings.least_variance * most.noise
        with single_threaded():
            return pivoted_rows(most.kernel, most.theta, self.data.pairs, settings.centres, least=least)

    def _component(self, drawn: ResidualHyperparameters, rng: np.random.Generator) -> Component:
        with single_threaded():
            return Component.conditioned(self._rescaled(drawn), *self._known(self.rows), rng)

    def _rescaled(self, drawn: ResidualHyperparameters) -> ResidualHyperparameters:
        """Return hyperparameters in the units of these data."""
        theta = drawn.theta.copy()
        theta[:-2] += np.log(self.covariances.scale / self.data.scale)
        return replace(drawn, theta=theta)

    def _known(self, rows: Rows) -> tuple[Array, Array]:
        return self.data.pairs[rows], self.data.outputs[rows][:, self.data.learned]

    def _rng(self, row: int) -> np.random.Generator:
        return np.random.default_rng([*self.covariances.seed, len(self.data.pairs), row])

    # The mean

    @functools.cached_property
    def mean(self) -> DynamicsDraws:
        """The model plus the posterior mean of r for the most probable hyperparameters, as one draw."""
        return self._limited(self.most_probable.mean)

    @functools.cached_property
    def rough_mean(self) -> DynamicsDraws:
        """The same with fewer centres if those predict the others well; it is cheaper to evaluate."""
        rough = self.with_few_centres(64, 0.03)
        return self.mean if rough.centres.shape[1] == len(self.rows) else self._limited(rough)

    def with_few_centres(self, least: int, error: float) -> KernelExpansion:
        """Return the mean of r given so few transitions as predict the others up to a share, at ``least`` so many."""
        most, (Z, Y) = self.most_probable, self._known(self.rows)
        while least < len(Z):
            with single_threaded():
                fewer = Component.conditioned(most.hyperparameters, Z[:least], Y[:least], self._rng(0)).mean
                errors = fewer(Z[None, least:])[0] - Y[least:]
            if (errors**2).mean() <= error**2 * (Y[least:] ** 2).mean():
                return fewer
            least *= 2
        return most.mean

    def means_without(self, left_out: Sequence[Collection[int]]) -> DynamicsDraws:
        """Return one mean for each set of executions that are left out, as draws; the hyperparameters do not change.

        Leaving out a block of data changes the weights of the others by a linear map, as leaving out one observation
        does (Rasmussen and Williams 2006, Sec. 5.4.2). Weights that rounding errors have spoilt are computed directly.
        """
        most, unused = self.most_probable.hyperparameters, np.setdiff1d(np.arange(len(self.data.pairs)), self.rows)
        some = unused[np.linspace(0, max(0, len(unused) - 1), min(600, len(unused))).astype(int)]
        with single_threaded():
            # Up to 100 other transitions replace those that are left out.
            least = self.covariances.settings.least_variance * most.noise
            spare = pivoted_rows(most.kernel, most.theta, self.data.pairs[some], 100, least=least)
            rows = np.concatenate([self.rows, some[spare]])
            Z, Y = self._known(rows)
            covariance = most.kernel(most.theta, Z, Z)
            factor = factorise(covariance, most.noise, insist=True)
            added = float((factor.L[-1] ** 2).sum() - covariance[-1, -1])
            inverse, known = factor.inverse(), factor.solve(Y)
            weights = np.repeat(known[None], len(left_out), axis=0)
            for remaining, without in zip(weights, left_out, strict=True):
                is_gone = np.isin(self.data.sources[rows], list(without))
                gone, kept = np.flatnonzero(is_gone), np.flatnonzero(~is_gone)
                remaining -= inverse[:, gone] @ np.linalg.solve(inverse[np.ix_(gone, gone)], known[gone])
                remaining[gone] = 0.0
                misfit = covariance[kept] @ remaining + added * remaining[kept] - Y[kept]
                if not np.abs(misfit).max(initial=0.0) < 1e-6:
                    again = factorise(covariance[np.ix_(kept, kept)], most.noise, insist=True)
                    remaining[kept] = again.solve(Y[kept])
        return self._limited(KernelExpansion.of(most, Z, weights))

    @property
    def limit(self) -> Array:
        """The largest standardised residual that the mean returns, in magnitude, shape ``(n,)``."""
        return np.asarray(5.0 * np.abs(self.data.outputs).max(axis=0))

    def _limited(self, mean: KernelExpansion) -> DynamicsDraws:
        least = np.zeros(len(mean.weights))  # nothing shows that what is open is larger
        return DynamicsDraws(self.model_with(least), self.data, (mean,), limit=self.limit[self.data.learned])

    @functools.cached_property
    def model(self) -> Model:
        """The model to which residuals are added, with the bounds of what executions leave open in it."""
        model = self.covariances.model
        if not isinstance(model, SettlingModel):
            return model
        mean = DynamicsDraws(model, self.data, (self.most_probable.mean,), limit=self.limit[self.data.learned])
        with single_threaded(), np.errstate(all="ignore"):
            return model.told_by(self.data.executions, lambda x, acting: mean.residuals(x[None], acting[None])[0])

    def model_with(self, shares: ArrayLike) -> Model:
        """Return the model of draws ``(S,)`` in which what is open is a share of the way to the largest it may be."""
        return self.model.between(shares) if isinstance(self.model, SettlingModel) else self.model

    def unfamiliarity(self, states: Array, inputs: Array) -> Array:
        """Return the standard deviation of r along states and inputs ``(q, H, m)``, as a share of a typical step."""
        horizon, data, most = inputs.shape[1], self.data, self.most_probable
        at = np.linspace(0, horizon - 1, min(12, horizon)).astype(int)
        Z = bounded(data.standardised(states[:, at], inputs[:, at]))
        variance = most.whitened(Z.reshape(-1, Z.shape[-1]))[1].reshape(Z.shape[:2]).mean(axis=1)
        sizes = (data.sizes / data.steps)[data.learned] ** 2 * most.squares / len(most.centres)
        return np.asarray(np.sqrt(variance * (sizes.mean() if len(sizes) else 0.0)))

    def prior(self, x: Array, u: Array) -> CholeskyFactor:
        """Return the factor of the prior covariance ``(N, N)``, with noise, at states and acting inputs."""
        most, Z = self.most_probable.hyperparameters, self.data.standardised(x, u)
        return factorise(most.kernel(most.theta, Z, Z), most.noise, insist=True)

    # Draws

    def draw(
        self,
        relevant: Array,
        rng: np.random.Generator,
        functions: int | None = None,
        hyperparameters: int | None = None,
    ) -> DynamicsDraws:
        """Return so many functions, by default those of the settings, for so many or all draws of the hyperparameters.

        Closed loops visit the ``relevant`` standardised pairs ``(R, k)``.
        """
        settings = self.covariances.settings
        count = settings.functions if functions is None else functions
        with single_threaded():
            if hyperparameters is None:
                components = self.components
            else:  # about so many, evenly spread
                rows = np.linspace(1, len(self.covariances.drawn) - 1, hyperparameters - 1).astype(int)
                components = self._components(np.unique(rows).tolist())
            # Adjacent components of the same hyperparameters share their pivots and are evaluated together.
            groups = [list(group) for _, group in groupby(components, lambda component: id(component.factor))]
            drawn = [draw_functions(group, relevant, count, settings.pivots, rng) for group in groups]
        expansions, left_out = zip(*drawn, strict=True)
        draws = DynamicsDraws(self.covariances.model, self.data, joined(expansions), max(left_out))
        if isinstance(self.model, SettlingModel):  # nothing is known of what is open between its bounds
            shares = (rng.permutation(len(draws)) + rng.random(len(draws))) / len(draws)
            draws = replace(draws, model=self.model_with(shares))
        return draws

    @property
    def deviations(self) -> Array:
        """The most probable standard deviations of the noise of each state in a step, shape ``(n,)``."""
        data, deviations = self.data, np.zeros(len(self.data.sizes))
        deviations[data.learned] = self.most_probable.noise * data.sizes[data.learned]
        return deviations

    def with_noise(self, runs: int, least: Array) -> DisturbedDynamics | None:
        """Return the mean with white noise, so many times; None if all its deviations are at most these ``(n,)``."""
        deviations = self.deviations

        def noise(ways: Rows, x: Array) -> Array:
            # The noise is a function of the states, so that a loop is the same each time.
            seed = np.frombuffer(np.ascontiguousarray(x).tobytes()[-64:], dtype=np.uint32)
            rng = np.random.default_rng([int(ways[0]), *seed.tolist()])
            return np.asarray(deviations * rng.standard_normal(x.shape))

        return DisturbedDynamics(self.mean, np.arange(runs), noise) if (deviations > least).any() else None

    @property
    def noise(self) -> float:
        """The median share of noise in the mean square of a state's residual, of the state in which it is largest."""
        return float(np.median([(component.noise**2).max(initial=0.0) for component in self.components]))


def learn_covariances(
    model: Model,
    transitions: Transitions,
    sources: Rows,
    seed: tuple[int, ...] = (0,),
    settings: PosteriorSettings | None = None,
) -> LearnedCovariances | None:
    """Return the posterior of the hyperparameters given recorded transitions, and the execution of each ``(N,)`` or -1.

    Returns None if fewer than two transitions are usable, or if M explains all of them. If M is rougher than S, the
    residuals are those of a linear model (:mod:`ctxval.learning.residual_data`).
    """
    settings, data, smoother = settings or PosteriorSettings(), residual_data(model, transitions, sources), None
    if data is None:
        return None
    with single_threaded():
        data = with_what_varies(data, model, transitions, sources, settings.learned_from, settings.varies)
        if settings.of_steps and not isinstance(model, SettlingModel):
            with contextlib.suppress(InputError, np.linalg.LinAlgError):  # numbers too large for a linear model
                smoother = smoother_than(data, settings.learned_from)
        if smoother is not None:
            model, data = smoother
            # S itself is smoother than the error of M, and takes more transitions.
            settings = replace(settings, centres=2 * settings.centres, families=SMOOTHER_FAMILIES)
        Z, Y, rows = data.pairs, data.outputs[:, data.learned], data.learning_rows(settings.learned_from)
        climb = functools.partial(data.climbed, rows=rows)
        posterior = HyperparameterPosterior.given(Z[rows], Y[rows], data.inputs, settings.families, climb)
    return LearnedCovariances(model, smoother is not None, data.scale, posterior, settings, seed, data.geometry)


def condition(covariances: LearnedCovariances, transitions: Transitions, sources: Rows) -> DynamicsPosterior | None:
    """Return the posterior given transitions and learned covariances; None if nothing usable is left to learn."""
    data = residual_data(covariances.model, transitions, sources, geometry=covariances.geometry)
    return None if data is None else DynamicsPosterior(covariances, data)


def learn_posterior(
    model: Model,
    transitions: Transitions,
    sources: Rows,
    seed: tuple[int, ...] = (0,),
    settings: PosteriorSettings | None = None,
) -> DynamicsPosterior | None:
    """Return the posterior of the dynamics, with hyperparameters that are learned from the same transitions."""
    covariances = learn_covariances(model, transitions, sources, seed, settings)
    return None if covariances is None else condition(covariances, transitions, sources)
