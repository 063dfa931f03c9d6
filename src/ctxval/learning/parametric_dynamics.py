"""Dynamics of a model with uncertain parameters: draws of parameters, a linear residual, and what remains.

``x' = M_theta(x, u) + W^T f + e`` with the posterior of theta (:mod:`ctxval.learning.parameter_posterior`), features f
of state, input and change of the input, and rests e of recorded steps, which are drawn in blocks. The residual of a
state is learned only if it predicts left-out executions, so that nothing that is learned destabilises M.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model, advanced, memory_in, predicted_steps, with_memory
from ctxval.core.state_geometry import PLAIN, StateGeometry, geometry_of
from ctxval.core.trajectory import Trajectory
from ctxval.core.uncertain import UncertainModel
from ctxval.learning.draws import DrawsWithoutNoise
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.effects.effect import all_sized
from ctxval.learning.effects.uncertain import UncertainEffects
from ctxval.learning.execution_prediction import ExecutionPrediction, predict_execution
from ctxval.learning.input_effects import Found
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.parameter_posterior import (
    Known,
    ParameterPosterior,
    ParameterSettings,
    blocks_of,
    most_probable,
)
from ctxval.learning.precision import agreeing_posterior
from ctxval.learning.recorded import recorded_transitions
from ctxval.learning.residual_data import ResidualData


@dataclass(frozen=True)
class ParametricSettings:
    """When a residual beside the parameters is learned, how it is drawn, and how many draws there are."""

    ridge: float = 3.0  # prior precision of weights of standardised features, in units of the variance of a rest
    limit: float = 3.0  # standard deviations to which features are limited, so that a residual stays bounded
    better: float = 0.8  # share of the squared errors of left-out executions that a residual must leave at most
    alike: float = 2.0  # factor of the deviations of weights, because rests of steps depend on each other
    block: int = 5  # steps of a block of rests
    draws: int = 20  # of parameters for a bound with confidence 0.95
    predicted: int = 120  # draws that predict an execution
    matters: float = 0.01  # deviation of a task's distance by rests that matters, as a share of the largest distance
    tasks: int = 6  # with the largest distances, of which this is asked
    parameters: ParameterSettings = field(default_factory=ParameterSettings)


@dataclass(frozen=True, eq=False)
class Rest:
    """What a model with the mean parameters misses in recorded steps: a linear part, and rests."""

    shift: Array  # of states, inputs and changes of inputs, (F - 1,)
    scale: Array
    weights: Array  # of the mean, (F, n)
    root: Array  # Cholesky factor of their covariance for rests of variance 1, (F, F)
    deviations: Array  # of the rests of each state that weights have, 0 for a state without residual, (n,)
    rests: Array  # recorded, (N, n)
    lengths: tuple[int, ...]  # numbers of steps of the executions
    limit: float
    geometry: StateGeometry = PLAIN

    def features(self, x: Array, u: Array, before: Array) -> Array:
        """Return features ``(..., F)`` of states, inputs and the inputs before."""
        whole = np.concatenate([self.geometry.features(x), u, u - before], axis=-1)
        bounded = np.clip(np.nan_to_num((whole - self.shift) / self.scale), -self.limit, self.limit)
        return np.concatenate([np.ones((*x.shape[:-1], 1)), bounded], axis=-1)


def rest_of(
    model: Model, executed: Sequence[Trajectory], settings: ParametricSettings = ParametricSettings()
) -> Rest | None:
    """Return what a model misses in executions; None if no step is finite."""
    steps = [with_memory(model, trajectory) for trajectory in executed]
    before = np.concatenate([np.concatenate([each.u[:1], each.u[:-1]]) for each in steps])
    source = np.repeat(np.arange(len(steps)), [len(each) for each in steps])
    geometry = geometry_of(model)
    with np.errstate(all="ignore"):
        errors = np.concatenate([geometry.missed(each.x_next, predicted_steps(model, each), each.x) for each in steps])
    x, u = (np.concatenate([getattr(each, name) for each in steps]) for name in ("x", "u"))
    if not (finite := np.isfinite(errors).all(axis=1)).any():
        return None
    errors[~finite] = 0.0
    whole = np.concatenate([geometry.features(x), u, u - before], axis=1)
    shift, scale = whole.mean(axis=0), whole.std(axis=0) + 1e-6 * np.abs(whole).max(axis=0) + 1e-9
    count = whole.shape[1] + 1
    empty = np.zeros((count, errors.shape[1]))
    rest = Rest(shift, scale, empty, np.eye(count), np.zeros(errors.shape[1]), errors, (), settings.limit, geometry)
    F = rest.features(x, u, before)
    penalty = settings.ridge * np.eye(count)
    penalty[0, 0] = 1e-3
    inverse = np.linalg.inv(F.T @ F + penalty)
    weights = inverse @ F.T @ errors
    # A residual must predict executions that it was not learned from.
    left_out = errors.copy()
    executions = np.unique(source)
    for k in executions if len(executions) > 1 else ():
        rows = source == k
        hat = F[rows] @ inverse @ F[rows].T
        left_out[rows] = np.linalg.solve(np.eye(rows.sum()) - hat, errors[rows] - F[rows] @ weights)
    predicts = (left_out**2).sum(axis=0) < settings.better * (errors**2).sum(axis=0)
    weights[:, ~predicts] = 0.0
    rests = errors - F @ weights
    deviations = np.where(predicts, rests.std(axis=0), 0.0)
    root = np.asarray(np.linalg.cholesky(inverse + 1e-15 * np.eye(count)), dtype=np.float64)
    lengths = tuple(len(each) for each in steps)
    return replace(rest, weights=weights, root=root, deviations=deviations, rests=rests, lengths=lengths)


@dataclass(frozen=True, eq=False)
class ParametricDraws(DrawsWithoutNoise):
    """S systems with drawn parameters, residuals and rests, run together."""

    model: UncertainModel
    z: Array  # standardised parameters, (S, K)
    rest: Rest
    weights: Array  # (S, F, n)
    rows: Rows  # the recorded rest of each step, (S, T); without rests if T is 0
    left_out: float = 0.0

    def __len__(self) -> int:
        return len(self.z)

    def _some(self, rows: Rows) -> Self:
        return replace(self, z=self.z[rows], weights=self.weights[rows], rows=self.rows[rows])

    @functools.cached_property
    def _drawn(self) -> Model:
        return self.model.drawn(self.z)

    def without_noise(self) -> Self:
        """Return the same without rests."""
        return replace(self, rows=self.rows[:, :0]) if self.rows.shape[1] else self

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states of first steps; see :class:`DrawsWithoutNoise`."""
        return self.advance(x, u, self.start(x))[0]

    def start(self, x: Array) -> Array:
        """Return memories: the number of the step, the input before, and the memory of M."""
        each = self._of_draws(x)
        memory = memory_in(self._drawn, each)
        inputs = len(self.rest.shift) - x.shape[-1]
        ours = np.zeros((*each.shape[:-1], 1 + inputs // 2))
        return np.concatenate([ours, memory], axis=-1).reshape(*x.shape[:-1], -1)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states and memories, as :class:`ctxval.core.model.ModelWithMemory`."""
        each, inputs, known = map(self._of_draws, (x, u, memory))
        m = inputs.shape[-1]
        step, before, of_model = np.split(known, [1, 1 + m], axis=-1)
        before = np.where(step > 0, before, inputs)
        following, of_model = advanced(self._drawn, each, inputs, of_model)
        if self.weights.any():
            missed = self.rest.features(each, inputs, before) @ self.weights
            following = self.rest.geometry.corrected(following, missed, each)
        if self.rows.shape[1]:
            at = self.rows[np.arange(len(self)), int(step[0, 0, 0]) % self.rows.shape[1]]
            following = self.rest.geometry.corrected(following, self.rest.rests[at][:, None], each)
        memory = np.concatenate([step + 1, inputs, of_model], axis=-1).reshape(memory.shape)
        return np.asarray(following).reshape(x.shape), memory


@dataclass(frozen=True, eq=False)
class ParametricPosterior(ShortRepr):
    """The posterior of the dynamics, as a search of the worst task sees it."""

    parameters: ParameterPosterior
    rest: Rest
    plain: DynamicsPosterior  # the model with the mean parameters, without a residual
    horizon: int  # number of steps of the longest execution
    settings: ParametricSettings = ParametricSettings()

    has_pivots: ClassVar[bool] = False
    noise: ClassVar[float] = 0.0  # rests are a part of draws

    @property
    def known(self) -> Known:
        """The most probable parameters of M, and the effects of inputs beside them."""
        model, mean = self.parameters.model, self.parameters.mean
        if not isinstance(model, UncertainEffects):
            return Known(mean)
        sizes = [float(each.at(z)) for each, z in zip(model.uncertain, mean, strict=True)]
        count = len(model.given.uncertain)
        return Known(mean[:count], all_sized(model.effects, sizes[count:]))

    def functions_for(self, draws: int) -> int:
        """Return how many times the usual number of draws gives at least so many."""
        return max(1, -(-draws // self.settings.draws))

    @property
    def data(self) -> ResidualData:
        """The recorded transitions."""
        return self.plain.data

    @functools.cached_property
    def mean(self) -> ParametricDraws:
        """The mean parameters and residual, as one draw without rests."""
        no_rests = np.empty((1, 0), dtype=np.intp)
        return ParametricDraws(
            self.parameters.model, self.parameters.mean[None], self.rest, self.rest.weights[None], no_rests
        )

    @property
    def rough_mean(self) -> ParametricDraws:
        """What is searched; nothing is cheaper and as good."""
        return self.mean

    def with_rests(self, count: int, rng: np.random.Generator) -> ParametricDraws:
        """Return the mean with so many sequences of rests."""
        rows = self._rests(count, rng)
        weights = np.repeat(self.rest.weights[None], count, axis=0)
        z = np.repeat(self.parameters.mean[None], count, axis=0)
        return ParametricDraws(self.parameters.model, z, self.rest, weights, rows)

    def draw(
        self,
        relevant: Array,
        rng: np.random.Generator,
        functions: int | None = None,
        hyperparameters: int | None = None,
    ) -> ParametricDraws:
        """Return draws; see :meth:`DynamicsPosterior.draw`. Nothing depends on ``relevant``."""
        count = (1 if functions is None else functions) * (
            self.settings.draws if hyperparameters is None else hyperparameters
        )
        z, rest = self.parameters.draw(count, rng), self.rest
        normal = rng.standard_normal((count, *rest.weights.shape))
        moves = self.settings.alike * np.einsum("ij,sjn->sin", rest.root, normal) * rest.deviations
        return ParametricDraws(self.parameters.model, z, rest, rest.weights + moves, self._rests(count, rng))

    def _rests(self, count: int, rng: np.random.Generator) -> Rows:
        return blocks_of(self.rest.lengths, count, self.horizon, self.settings.block, rng)


@dataclass(frozen=True, eq=False)
class ParametricDynamics(LearnedDynamics):
    """The dynamics of a model with uncertain parameters, learned from executions."""

    parametric: ParametricPosterior | None = None

    @property
    def drawn_from(self) -> ParametricPosterior:  # type: ignore[override]
        """The posterior of which draws bound d*."""
        assert self.parametric is not None
        return self.parametric

    @property
    def mean(self) -> ParametricDraws:
        """The mean parameters and residual."""
        return self.drawn_from.mean

    @property
    def left_out_error(self) -> float:
        """The error of segments that the parameters leave, as a share of the error of M."""
        return float(np.sqrt(self.drawn_from.parameters.left))

    @functools.cached_property
    def scatter(self) -> float:
        """The largest standard deviation of a task's distance over rests, as a share of the largest distance."""
        settings, planner = self.drawn_from.settings, self.study.planner
        distances = np.nan_to_num(self._on_pool[0], nan=-1.0, posinf=-1.0)
        tasks = self.search.pool[np.argsort(-distances, kind="stable")[: settings.tasks]]
        if not distances.max(initial=0.0) > 0:
            return 0.0
        with single_threaded():
            runs = planner.distances(self.drawn_from.with_rests(10, self._rng(9)), planner.plan(tasks), len(tasks))
        return float(np.nanmax(np.where(np.isfinite(runs), runs, np.nan).std(axis=0), initial=0.0) / distances.max())

    @property
    def predicts_distributions(self) -> bool:
        """Whether rests matter, so that predictions are distributions."""
        return self.scatter > self.drawn_from.settings.matters

    @functools.cached_property
    def values(self) -> dict[str, tuple[float, float, float]]:
        """The median and the 5 % and 95 % quantiles of each parameter by its name."""
        drawn = self.drawn_from.parameters.draw(400, self._rng(10))
        quantiles = np.quantile(drawn, [0.5, 0.05, 0.95], axis=0)
        names = self.drawn_from.parameters.model.uncertain
        return {each.name: tuple(each.at(quantiles[:, k]).tolist()) for k, each in enumerate(names)}

    def predictions(self, points: Array, draws: int | None = None) -> list[ExecutionPrediction | None]:
        """Return the predictions of the executions of tasks ``(m, d)`` by the same draws; None for one without plan."""
        rng, planner, posterior = self._rng(2), self.study.planner, self.drawn_from
        count = posterior.settings.predicted if draws is None else draws
        with single_threaded():
            drawn = posterior.draw(np.empty((0, 0)), rng, 1, count)
            recorded, spread = self.study.extended.recorded, self.predicts_distributions
            each = len(self.executed), recorded
            return [predict_execution(planner, drawn, point, *each, distribution=spread) for point in points]


def learned_parameters(
    model: UncertainModel,
    executed: Sequence[Trajectory],
    loops: Trajectory,
    seed: tuple[int, ...],
    candidates: Found = (),
    known: Known | None = None,
    settings: ParametricSettings = ParametricSettings(),
    affords: Callable[[int], bool] = lambda steps: True,
) -> ParametricPosterior | None:
    """Return the posterior of a model's uncertain parameters and of what they leave; None if nothing is usable.

    Effects of inputs are looked for among candidates, or are the ``known`` ones; ``loops`` are closed loops on M.
    Searches from all of the prior need that so many steps of M can be afforded.
    """
    rng = np.random.default_rng(seed)
    with single_threaded(), np.errstate(all="ignore"):
        mode = most_probable(model, executed, candidates, known, rng, settings.parameters, affords)
        if mode is None:
            return None
        parameters = mode.posterior(rng)
        fitted = _Single(parameters.model.drawn(parameters.mean[None]))
        recorded = recorded_transitions(fitted, None, executed, loops)
        plain = None if recorded is None else agreeing_posterior(fitted, *recorded, seed)
        rest = rest_of(fitted, executed, settings)
    if rest is None or plain is None:
        return None
    horizon = max(trajectory.horizon for trajectory in executed)
    return ParametricPosterior(parameters, rest, plain, horizon, settings)


@dataclass(frozen=True)
class _Single:
    """One draw as a model of its own."""

    model: Model

    def step(self, x: Array, u: Array) -> Array:
        return np.asarray(self.model.step(_one(x), _one(u))).reshape(x.shape)

    def start(self, x: Array) -> Array:
        return memory_in(self.model, _one(x)).reshape(*x.shape[:-1], -1)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        following, after = advanced(self.model, _one(x), _one(u), _one(memory))
        return np.asarray(following).reshape(x.shape), after.reshape(memory.shape)


def _one(part: Array) -> Array:
    """Return states, inputs or memories ``(..., k)`` as those of one draw ``(1, q, k)``."""
    return part.reshape(1, -1, part.shape[-1]) if part.size else np.empty((1, math.prod(part.shape[:-1]), 0))
