"""The dynamics learned from the executions so far, and what follows for the largest distance over all tasks."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import parted
from ctxval.core.coverage import StateInputCoverage, UnsampledParameter, UntestedRest, UnvisitedRegion
from ctxval.core.labels import labels_of
from ctxval.core.learned_numbers import PushedDistances
from ctxval.core.model import Model, predicted_steps
from ctxval.core.trajectory import Trajectory
from ctxval.learning.closed_loops import AnyPosterior, Loops, distances_of, loop_pairs
from ctxval.learning.coverage import (
    away_from_executions,
    beyond_records,
    coverage,
    farthest_value,
    largest_pocket,
    position_states,
)
from ctxval.learning.draws import Draws, DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.effects.dry_friction import DryFriction
from ctxval.learning.effects.inputs import labelled_sizes
from ctxval.learning.execution_prediction import ExecutionPrediction, predict_execution
from ctxval.learning.noisy_draws import NoisyPosterior
from ctxval.learning.regular import Boundary, RegularTransitions
from ctxval.learning.rest_places import RestPlaces, rest_places, untested_rest
from ctxval.learning.settling import SettlingModel
from ctxval.learning.stage_costs import Costs, Ledger
from ctxval.learning.tolerance import push_response
from ctxval.learning.worst_case import WorstCase, WorstCaseSearch

if TYPE_CHECKING:
    from ctxval.learning.dynamics_study import DynamicsStudy


@dataclass(frozen=True, eq=False)
class LearnedDynamics(ShortRepr):
    """The dynamics learned from the executions so far; everything that follows is computed once, if it is needed."""

    study: DynamicsStudy
    posterior: DynamicsPosterior
    executed: Array  # the executed tasks, points of the unit cube (n, d)
    trajectories_of_system: Sequence[Trajectory]  # their trajectories
    # whether the data that M was made from are learned from too; if they contradict the executions, M was learned on
    # another system, such as one without its load
    with_data: bool = True
    # if only regular transitions are learned from: all of them, and where the regular part ends
    split: RegularTransitions | None = None
    boundary: Boundary | None = None
    # learns the dynamics with noise; by default, there are none
    learn_noisy: Callable[[Ledger], NoisyPosterior | None] = field(default=lambda ledger: None, repr=False)
    ledger: Ledger = field(default_factory=Ledger, repr=False)  # of the choice that needs it; no budget by default

    _worst_cases: dict[int, WorstCase] = field(default_factory=dict, init=False)
    _draws: dict[tuple[int, bool], Draws] = field(default_factory=dict, init=False)

    @functools.cached_property
    def search(self) -> WorstCaseSearch:
        """Searches the tasks, as many of them as the budget of thinking allows."""
        return self.study.search_within(self.ledger, 1 if self.noisy is None else self.noisy.replicates)

    def with_whole_search(self) -> LearnedDynamics:
        """Return this with a search of all tasks, whatever the budget."""
        if self.search is self.study.search:
            return self
        noisy = self.noisy
        return replace(self, ledger=Ledger(), learn_noisy=lambda ledger: noisy)

    @property
    def is_complete(self) -> bool:
        """Whether no part of the dynamics was left out for lack of time."""
        return self.drawn_from is not None and not self.ledger.incomplete

    @property
    def unseen_parameters(self) -> tuple[int, ...]:
        """The task parameters that hardly change the closed loops of M; none if the search is reduced."""
        return self.study.unseen_parameters if self.search is self.study.search else ()

    @property
    def seen_parameters(self) -> Rows | slice:
        """The other task parameters."""
        return self.study.seen_parameters if self.search is self.study.search else slice(None)

    @property
    def executions(self) -> list[tuple[Array, Trajectory]]:
        """The executed tasks with their trajectories."""
        return list(zip(self.executed, self.trajectories_of_system, strict=True))

    @functools.cached_property
    def noisy(self) -> NoisyPosterior | None:
        """The dynamics with noise and histories; None if state and input suffice, or if nothing can be learned."""
        if not len(self.executed):
            return None
        with single_threaded():
            return self.learn_noisy(self.ledger)

    @property
    def drawn_from(self) -> AnyPosterior:
        """The posterior of which draws bound d*."""
        return self.noisy or self.posterior

    def expected(self, points: Array) -> Array:
        """Return the distances ``(m,)`` on the posterior mean at points ``(m, d)``; infinity if a loop diverges."""
        planner = self.study.planner
        with single_threaded():
            return np.asarray(planner.distances(self.drawn_from.mean, planner.plan(points), len(points))[0])

    def near_pool(self, points: Array) -> Array:
        """Return the distances on the posterior mean ``(m,)`` of the tasks of the pool next to points ``(m, d)``."""
        nearest = scipy.spatial.distance.cdist(points, self.search.pool).argmin(axis=1)
        return np.asarray(self._on_pool[0][nearest])

    @property
    def mean(self) -> Draws:
        """The posterior mean without noise, as one draw."""
        return self.posterior.mean

    @property
    def predicts_distributions(self) -> bool:
        """Whether executions of one task differ, so that predictions are distributions."""
        return self.noisy is not None and self.noisy.is_noisy

    @property
    def values(self) -> dict[str, tuple[float, float, float]]:
        """The median and the 5 % and 95 % quantiles of the uncertain parameters of M; empty without any."""
        return {}

    @property
    def scatter(self) -> float:
        """The deviation of a task's distance that nothing learned explains, as a share of the largest; 0 if unknown."""
        return 0.0

    def trajectories(self, points: Array) -> list[tuple[Array, Trajectory]]:
        """Return tasks ``(m, d)`` with their closed loops on the posterior mean, without those that diverge."""
        planner, tasks = self.study.planner, list[tuple[Array, Trajectory]]()
        with single_threaded():
            for point in points:
                for plan in planner.plan(point[None]):
                    (loops,) = planner.run(self.mean, [plan])
                    executed = Trajectory(plan.nominal.times, loops.states[0, 0], loops.inputs[0, 0])
                    if executed.finite:
                        tasks.append((point, executed))
        return tasks

    @property
    def negligible(self) -> float:
        """The largest distance of any task under errors that are not learned, if none of M is learned; 0 otherwise."""
        return 0.0

    @property
    def left_out_error(self) -> float:
        """The error of the next states of each execution, predicted from the others, as a share of the error of M."""
        return float(np.sqrt((self.left_out_errors[self.posterior.data.learned] ** 2).mean()))

    @functools.cached_property
    def left_out_errors(self) -> Array:
        """The same of each state ``(n,)``; 0 for those of which nothing is learned."""
        numbers = range(len(self.executed))
        without = self.posterior.means_without([[k] for k in numbers])
        errors = self._errors_of([without[k] for k in numbers]) / self.error_units
        return np.where(self.posterior.data.learned, errors, 0.0)

    @property
    def error_units(self) -> Array:
        """The errors of M of each state ``(n,)``, at least 1e-4 of the largest, in shares of the state's steps."""
        steps = np.maximum(self.posterior.data.steps, 1e-300)
        return np.asarray(np.maximum(self.model_errors, 1e-4 * steps * (self.model_errors / steps).max() + 1e-300))

    @functools.cached_property
    def model_errors(self) -> Array:
        """The root mean squares of the errors of the next states that M predicts in the executions ``(n,)``."""
        return self._errors_of([self.study.validation.model] * len(self.executed))

    def _errors_of(self, models: Sequence[Model]) -> Array:
        loops, steps = self.trajectories_of_system, []
        for model, loop in zip(models, loops, strict=True):
            # A mean has the memory of the model to which it adds residuals.
            followed = model.model if isinstance(model, DynamicsDraws) else model
            steps.append(predicted_steps(model, self.study.memories.of(followed, loop)))
        errors = [predicted - loop.states[1:] for predicted, loop in zip(steps, loops, strict=True)]
        return np.asarray(np.sqrt((np.concatenate(errors) ** 2).mean(axis=0)))

    @functools.cached_property
    def screened(self) -> WorstCase:
        """The largest distance over some tasks, for each of a few draws of the dynamics: a quick lower bound."""
        replicates = 1 if self.noisy is None else self.noisy.replicates
        settings, rests = self.search.settings, isinstance(self.posterior.model, SettlingModel)
        stage = "posterior samples in the choice of a task"
        if not self.ledger.fits(
            "loops", lambda costs: costs.screening(settings, replicates, rests), self.ledger.reserve
        ):
            self.ledger.replaced.append(stage)
            return self.worst_of_mean
        return self.search.screened(self.drawn_from, self.worst_of_mean, self.executed, self._rng(5))

    @functools.cached_property
    def worst_of_mean(self) -> WorstCase:
        """The largest distance over some tasks on the posterior mean alone, as if it were the only draw."""
        return self.search.on_mean(self.drawn_from, self._on_pool[0], self.executed, self._rng(4), globally=False)

    def without(self, rows: Collection[int]) -> LearnedDynamics | None:
        """Return what the regular transitions of the other executions teach; None if it is nothing."""
        parts = None if self.split is None else self.split.posterior(rows)
        return None if parts is None else replace(self, posterior=parts[0], boundary=parts[1])

    def drawn_distances(
        self, points: Array, draws: int, *, settled: bool = True
    ) -> tuple[Array, Array, Array, Array | None]:
        """Return the distances ``(S, m)`` of tasks ``(m, d)`` on draws, and how far their loops leave the records.

        The latter is the largest excess ``(m,)`` of the loop on the mean over the records in a coordinate, as a share
        of the range of the loops of the pool; it is infinity if a task cannot be planned. The draws, at least so many,
        are the same for all points; if the system is noisy and not ``settled``, they have fewer sequences of noise.
        The third array is the largest distance of the loop from places that executions entered ``(m,)``, as a share of
        their range; 0 if tasks choose no positions. If only regular transitions are learned from, the fourth array says
        how far loops cross their boundary ``(m,)``.
        """
        search, planner = self.search, self.study.planner
        with single_threaded():
            planned = planner.plan(points)
            functions = self.drawn_from.functions_for(draws)
            key = functions, settled
            if key not in self._draws:
                # Their pivots lie on the loops of all tasks.
                rng = self._rng(6)
                some = search.pool[rng.permutation(len(search.pool))[:64]]
                drawn = self.drawn_from.draw(search.relevant(self.drawn_from, some, rng), rng, functions)
                many = drawn.settled(rng) if settled else None
                self._draws[key] = drawn if many is None else many
            values = planner.distances(self._draws[key], planned, len(points))
            of_pool, loops = self._pool_loops, planner.run(self.drawn_from.mean.without_noise(), planned)
            beyond, away, crossed = np.full(len(points), np.inf), np.zeros(len(points)), np.ones(len(points))
            boundary = self.boundary
            all_beyond = beyond_records(self.posterior, of_pool, loops, executed_only=boundary is not None)
            all_away = away_from_executions(self.trajectories_of_system, self.positions, of_pool, loops)
            for plan, loop, *each in zip(planned, loops, all_beyond, all_away, strict=True):
                beyond[plan.rows], away[plan.rows] = each
                if boundary is not None:
                    crossed[plan.rows] = boundary.crossed(self.posterior, loop)
        return values, beyond, away, None if boundary is None else crossed

    def worst_case_of(self, draws: int) -> WorstCase:
        """Return the largest distance over all tasks, for each of at least so many draws of the dynamics."""
        functions = self.drawn_from.functions_for(draws)
        if functions not in self._worst_cases:
            search, known, rng = self.search, self.executed, self._rng(1)
            of_mean = search.on_mean(self.drawn_from, self._on_pool[0], known, rng)
            self._worst_cases[functions] = search.maxima(self.drawn_from, of_mean, known, rng, functions)
        return self._worst_cases[functions]

    @functools.cached_property
    def intensified_search(self) -> tuple[Array, Array]:
        """The largest distances on the posterior mean ``(2,)`` in two deeper searches, and their points ``(2, d)``."""
        return self.search.intensified_search(self.drawn_from, self._rng(3))

    @functools.cached_property
    def push_response(self) -> PushedDistances | None:
        """The largest distances over large, executed and random tasks if something pushes the posterior mean.

        It is None if no residual is learned, with which pushes are compared.
        """
        search = self.search
        if not self.posterior.data.learned.any():
            return None
        tasks = [self.worst_of_mean.local_maxima[:16], self.executed, search.pool[:16]]
        return push_response(self.study.planner, self.posterior, np.concatenate(tasks), self.labels)

    @functools.cached_property
    def labels(self) -> tuple[str, ...]:
        """The labels of the states and inputs, with units; ``x[0], ..., u[0], ...`` for those without names."""
        inputs = self.posterior.data.inputs
        states = self.posterior.data.pairs.shape[1] - inputs
        coordinates = [*(("x", i) for i in range(states)), *(("u", i) for i in range(inputs))]
        labels = [label for names in self.study.validation.names(states, inputs) for label in labels_of(names)]
        twice = len(set(labels)) < len(labels)  # a state and an input of the same name
        return tuple(
            f"{letter}[{i}]" if twice or label == f"{letter}{i}" else label
            for (letter, i), label in zip(coordinates, labels, strict=True)
        )

    @property
    def acting(self) -> dict[str, float]:
        """The sizes of effects of inputs by their labels; empty if commands act as they are."""
        return labelled_sizes(self.study.of_inputs, self.study.input_names(self.posterior.data.inputs))

    @property
    def friction(self) -> dict[str, float]:
        """The dry friction at the inputs that have some, by their labels.

        If the executions permit more at rest, that follows, and its share of the input if it grows with it.
        """
        friction, sizes = self.posterior.model, dict[str, float]()
        if isinstance(friction, DryFriction) and friction.told is not None:
            of_inputs = self.labels[-self.posterior.data.inputs :]
            each_input = np.stack([friction.sliding, friction.told.largest.max(axis=0), friction.load], axis=1).tolist()
            for label, (sliding, at_rest, load) in zip(of_inputs, each_input, strict=True):
                name, _ = parted(label)
                sizes[label] = sliding
                at_most = label.replace(name, f"{name} at rest at most", 1)
                sizes[at_most] = at_rest if at_rest > 1.02 * sliding else 0.0  # no more than that in motion
                sizes[f"share of {name}"] = load
        return {label: size for label, size in sizes.items() if size}

    @functools.cached_property
    def positions(self) -> list[list[int]]:
        """Of each position that tasks choose, the two states that are its coordinates; a suite has no other tasks."""
        study, search = self.study, self.search
        space, goals = study.validation.space, not study.given.outputs.hide_states
        labels = self.labels[: len(self.posterior.data.sizes)]
        return position_states(space, labels, search.plans, search.pool, goals=goals) if space.members is None else []

    @functools.cached_property
    def unvisited_region(self) -> UnvisitedRegion | None:
        """The largest region of two states that loops enter and no execution has entered."""
        planner, states, pool = self.study.planner, len(self.posterior.data.sizes), self.search.pool[:256]
        with single_threaded():
            planned = planner.plan(pool)
            loops = planner.run(self.mean, planned)
        visited = np.concatenate([each.states.reshape(-1, states) for each in loops])
        steps = [
            np.broadcast_to(p.rows[:, None], each.states.shape[:3]) for p, each in zip(planned, loops, strict=True)
        ]
        rows, finite = np.concatenate([each.ravel() for each in steps]), np.isfinite(visited).all(axis=1)
        executed, labels = self.trajectories_of_system, self.labels[:states]
        return largest_pocket(visited[finite], executed, labels, self.positions, rows[finite], pool)

    @functools.cached_property
    def _rest_places(self) -> list[RestPlaces]:
        """Where the friction at rest of each joint is tested, and where predicted runs need it."""
        planner, search = self.study.planner, self.search
        with single_threaded(), np.errstate(all="ignore"):
            return rest_places(self.posterior, planner, search.pool, search.plans, self._pool_loops)

    @functools.cached_property
    def untested_rest(self) -> UntestedRest | None:
        """The longest stretch of places where friction at rest was not tested; None without such friction."""
        with single_threaded(), np.errstate(all="ignore"):
            return untested_rest(self._rest_places, self.labels, self._rng(7))

    def at_untested_rest(self, task: Array) -> Array | None:
        """Return a task ``(d,)`` that leaves rest under the force of another one where friction at rest is untested.

        It is None if the other task tests no place, or if there is none.
        """
        if self.untested_rest is None or self.untested_rest.size <= UntestedRest.MOST:
            return None
        worst = max(self._rest_places, key=lambda each: each.widest[0])
        with single_threaded(), np.errstate(all="ignore"):
            return worst.like(task, self._rng(8))

    @property
    def unsampled_parameter(self) -> UnsampledParameter | None:
        """The parameter without effect on M's loops whose gap is largest; None if there is none."""
        space, executed = self.study.validation.space, self.executed
        gaps = [
            (j, *farthest_value(executed[:, j], None if space.members is None else space.members[:, j]))
            for j in self.unseen_parameters
        ]
        if not gaps:
            return None
        j, gap, value = max(gaps, key=lambda each: each[1])
        task = self.coverage.task.copy()
        task[j] = value
        return UnsampledParameter(space.names[j], gap, task, self.has_idle)

    @functools.cached_property
    def has_idle(self) -> bool:
        """Whether an unseen parameter changes no predicted distance either, unlike the place of an obstacle."""
        space, some = self.study.validation.space, self.search.pool[:8]
        if space.members is not None:
            return False
        for j in self.unseen_parameters:
            low, high = some.copy(), some.copy()
            low[:, j], high[:, j] = 0.0, 1.0
            below, above = self.expected(np.concatenate([low, high])).reshape(2, -1)
            if np.isclose(below, above, rtol=0.05, atol=0, equal_nan=True).all():
                return True
        return False

    def spread_unseen(self, task: Array, known: Array) -> Array:
        """Return a task ``(d,)`` with values of the unseen parameters that are far from those of known ones ``(n, d)``.

        What such a parameter changes in the system is met by no choice that follows predictions. Trying it costs no
        execution of its own. The task stays the same if another distance is predicted for the moved one.
        """
        if not self.unseen_parameters:
            return task
        rng, moved = np.random.default_rng([self.study.seed, len(known)]), task.copy()
        for j in self.unseen_parameters:
            moved[j] = farthest_value(known[:, j], rng=rng)[1]
        before, after = self.expected(np.stack([task, moved]))
        return moved if np.isclose(after, before, rtol=0.05, atol=0) else task

    @property
    def coverage(self) -> StateInputCoverage:
        """How well the records cover the closed loops of the tasks, in states and inputs."""
        return self._on_pool[1]

    @functools.cached_property
    def _pool_loops(self) -> list[Loops]:
        """The closed loops of the pool's tasks on the posterior mean, without noise."""
        return self.study.planner.run(self.drawn_from.mean.without_noise(), self.search.plans)

    @functools.cached_property
    def _on_pool(self) -> tuple[Array, StateInputCoverage]:
        """The distances of the pool's tasks on the posterior mean, and the coverage of their closed loops."""
        search, planner = self.search, self.study.planner
        with single_threaded():
            searched, loops = self.drawn_from.mean.searched, self._pool_loops
            noisy = loops if searched.replicates == 1 else planner.run(searched, search.plans)
            (distances,) = distances_of(searched, noisy, search.plans, len(search.pool))
            return distances, coverage(self.posterior, search.pool, search.plans, loops, self.labels)

    def predict(self, point: Array) -> ExecutionPrediction | None:
        """Return the prediction of the execution of a task, a point ``(d,)``; None if it cannot be planned.

        It has fewer draws, or is None, if the budget of thinking allows no more.
        """
        few, replicates = self.study.settings.thinking.few_draws, 1 if self.noisy is None else self.noisy.replicates
        for draws, number in ((40, None), (few, few)):
            if self.ledger.fits("loops", functools.partial(Costs.prediction, draws=draws, replicates=replicates)):
                return self.predictions(point[None], number)[0]
            self.ledger.replaced.append(f"{draws} posterior samples in the prediction of an execution")
        return None

    def predictions(self, points: Array, draws: int | None = None) -> list[ExecutionPrediction | None]:
        """Return the predictions of the executions of tasks ``(m, d)`` by the same draws; None for one without plan."""
        rng, planner = self._rng(2), self.study.planner
        with single_threaded():
            pairs = loop_pairs(planner, self.drawn_from, points)
            if self.noisy is None and not len(pairs):
                return [None] * len(points)
            few = {} if draws is None else {"functions": 1, "hyperparameters": draws}
            drawn = self.drawn_from.draw(pairs[rng.permutation(len(pairs))[:300]], rng, **few)
            if isinstance(drawn, DynamicsDraws):  # if friction at rest made predictions vague, they could not fail
                drawn = replace(drawn, model=self.posterior.model_with(np.zeros(len(drawn))))
            recorded = self.study.extended.recorded
            return [predict_execution(planner, drawn, point, len(self.executed), recorded) for point in points]

    @property
    def influential(self) -> Array | None:
        """The task on whose execution the noisy dynamics depend most, ``(d,)``; None if such a task was executed twice.

        One execution does not tell what is a property of its task or place from what is one of this execution.
        """
        if self.noisy is None or not self.noisy.is_noisy:
            return None
        tasks, of_task = np.unique(self.executed, axis=0, return_inverse=True)
        executions = [np.flatnonzero(of_task.ravel() == row).tolist() for row in range(len(tasks))]
        influences = self.noisy.fit.influences(executions)
        if influences is None:  # the largest distance instead
            influences = np.nan_to_num(self.expected(tasks), posinf=0.0)
        # Of tasks with about the same influence, one executed twice suffices.
        twice = max((value for value, rows in zip(influences, executions, strict=True) if len(rows) > 1), default=0.0)
        return None if twice > 0.5 * influences.max() else tasks[int(influences.argmax())]

    @property
    def drift(self) -> tuple[str, float] | None:
        """What the effects of whole executions change with, and the p-value; None if there are none."""
        if self.noisy is None or not self.noisy.is_noisy:
            return None
        columns = np.column_stack([np.arange(len(self.executed)), self.executed])
        found = self.noisy.fit.runs.drift(columns)
        return found and (["the order of the executions", *self.study.validation.space.names][found[0]], found[1])

    @property
    def uneven_friction(self) -> float:
        """By how many times a force that a joint withstood exceeds one that moved it; 1 if none does."""
        friction = self.posterior.model
        told = friction.told if isinstance(friction, DryFriction) else None
        return 1.0 if told is None else float(told.uneven.max())

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.study.seed, len(self.executed), purpose])
