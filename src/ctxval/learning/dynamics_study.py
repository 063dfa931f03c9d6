"""What the executions so far teach of the dynamics, and what follows for the largest distance over all tasks."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.boxes import moves_to_bounds
from ctxval._util.representation import call
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.coverage import Coverage, coverage
from ctxval.learning.dynamics_posterior import DynamicsPosterior, PosteriorSettings, learn_posterior
from ctxval.learning.execution_prediction import ExecutionPrediction, predict_execution
from ctxval.learning.recorded import closed_loops_on_model, recorded_transitions
from ctxval.learning.worst_case import WorstCase, WorstCaseSearch, WorstCaseSettings, loop_pairs
from ctxval.models.corrected import before_refinement

_PROBED = 8
"""Number of tasks at which each task parameter is moved, to see whether it changes the closed loops of M."""
_WEAK = 0.02
"""A change of the loops by less than this many standard deviations of states and inputs is no change."""
_PAIRS = 300
"""Largest number of pairs from which the pivots of a single task are chosen."""


class DynamicsStudy:
    """Learns the dynamics of one experiment from growing sets of executions.

    Everything is a function of the executions and the seed. The controllers of the pool are designed once.

    Args:
        validation: the map p -> d(p); S is never executed.
        seed: seed of all random numbers.
    """

    def __init__(self, validation: Validation, seed: int = 0) -> None:
        self.validation, self.seed = validation, seed
        self.planner = LoopPlanner(validation)

    @functools.cached_property
    def search(self) -> WorstCaseSearch:
        """Searches the tasks for the largest distance of each draw."""
        settings = WorstCaseSettings.for_dimension(self.validation.space.dimension, self.planner.batched)
        return WorstCaseSearch(self.planner, self.seed, settings)

    @functools.cached_property
    def _loops(self) -> Trajectory | None:
        with single_threaded():
            return closed_loops_on_model(self.validation)

    @functools.cached_property
    def unseen_parameters(self) -> tuple[int, ...]:
        """The indices of the task parameters that hardly change the closed loops of M.

        What they change in the system, such as a payload, is no function of state and input.
        """
        d = self.validation.space.dimension
        some = self.search.pool[:_PROBED]
        ends = moves_to_bounds(some, np.zeros(d), np.ones(d)).reshape(-1, d)
        loops: dict[int, Array] = {}
        for one in self.planner.plan(ends):
            promised = np.concatenate([one.promised.states[..., :-1, :], one.promised.inputs], axis=-1)
            loops.update(zip(one.rows.tolist(), promised.reshape(len(one.rows), *promised.shape[-2:]), strict=True))
        if not loops:
            return ()
        size = np.maximum(np.nanstd(np.concatenate(list(loops.values())), axis=0), 1e-12)
        effects = np.zeros(d)
        for first in range(0, len(ends), 2 * d):
            for j in range(d):
                low, high = loops.get(first + j), loops.get(first + d + j)
                if low is not None and high is not None and low.shape == high.shape:
                    effects[j] = max(effects[j], float(np.nanmax(np.abs(high - low) / size)))
        return tuple(np.flatnonzero(effects < _WEAK).tolist())

    def learn(
        self, executed: Sequence[tuple[Array, Trajectory]], logged: Sequence[Trajectory] = ()
    ) -> LearnedDynamics | None:
        """Return what executions teach, and other recordings of the system.

        Returns None if there are no recorded transitions, if M explains them, or if no task can be planned.

        Args:
            executed: points of the unit cube ``(d,)`` with the system's trajectories there.
            logged: recordings with the same time step that belong to no task.
        """
        if self._loops is None:
            return None
        trajectories = [trajectory for _, trajectory in executed]
        recorded = recorded_transitions(self.validation.model, trajectories, self._loops, logged)
        if recorded is None:
            return None
        rng = np.random.default_rng([self.seed, len(executed), 0])
        settings = PosteriorSettings.for_horizon(self._loops.horizon)
        posterior = learn_posterior(before_refinement(self.validation.model), *recorded, rng, settings)
        if posterior is None or not posterior.components:
            return None
        points = np.array([point for point, _ in executed]).reshape(-1, self.validation.space.dimension)
        return LearnedDynamics(self, posterior, points)

    def __repr__(self) -> str:
        return call(self, self.validation, seed=self.seed)


@dataclass(frozen=True, eq=False)
class LearnedDynamics:
    """The dynamics learned from the executions so far; everything that follows is computed once, if it is needed.

    Attributes:
        study: the experiment.
        posterior: the posterior of the dynamics.
        executed: the executed tasks, points of the unit cube ``(n, d)``.
    """

    study: DynamicsStudy
    posterior: DynamicsPosterior
    executed: Array

    _worst_cases: dict[int, WorstCase] = field(default_factory=dict, init=False)

    def expected(self, points: Array) -> Array:
        """Return the distances ``(m,)`` on the posterior mean at points ``(m, d)``; infinity if a loop diverges."""
        planner = self.study.planner
        with single_threaded():
            return np.asarray(planner.distances(self.posterior.mean, planner.plan(points), len(points))[0])

    @property
    def worst_case(self) -> WorstCase:
        """The largest distance over all tasks, for each of the usual number of draws."""
        return self.worst_case_of(self.posterior.settings.functions * len(self.posterior.components))

    def worst_case_of(self, draws: int) -> WorstCase:
        """Return the largest distance over all tasks, for each of at least so many draws of the dynamics."""
        functions = max(self.posterior.settings.functions, -(-draws // len(self.posterior.components)))
        if functions not in self._worst_cases:
            found = self.study.search.maxima(self.posterior, self.executed, self._rng(1), functions)
            self._worst_cases[functions] = found
        return self._worst_cases[functions]

    @functools.cached_property
    def largest_jump(self) -> float:
        """The largest jump of the distance on the posterior mean between nearly equal tasks."""
        return self.study.search.largest_jump(self.posterior)

    @functools.cached_property
    def deeper(self) -> tuple[Array, Array]:
        """The largest distances on the posterior mean ``(2,)`` in two deeper searches, and their points ``(2, d)``."""
        return self.study.search.deeper(self.posterior, self._rng(3))

    @property
    def untried_parameter(self) -> tuple[int, float, Array] | None:
        """A parameter that M's loops do not depend on, its largest gap between executions, and a task in the gap.

        The gap is a share of the parameter's range; None if there is no such parameter.
        """
        gaps = [(j, *_widest_gap(self.executed[:, j])) for j in self.study.unseen_parameters]
        if not gaps:
            return None
        j, gap, value = max(gaps, key=lambda one: one[1])
        task = self.coverage.task.copy()
        task[j] = value
        return j, gap, task

    @functools.cached_property
    def coverage(self) -> Coverage:
        """How well the records cover the closed loops of the tasks, in states and inputs."""
        with single_threaded():
            search = self.study.search
            return coverage(self.study.planner, self.posterior, search.pool, search.plans)

    def predict(self, point: Array) -> ExecutionPrediction | None:
        """Return the prediction of the execution of a task, a point ``(d,)``; None if it cannot be planned."""
        rng = self._rng(2)
        with single_threaded():
            pairs = loop_pairs(self.study.planner, self.posterior, point[None])
            if not len(pairs):
                return None
            draws = self.posterior.draw(pairs[rng.permutation(len(pairs))[:_PAIRS]], rng)
            return predict_execution(self.study.planner, draws, point, len(self.executed))

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.study.seed, len(self.executed), purpose])

    def __repr__(self) -> str:
        return call(self, self.posterior, executed=len(self.executed))


def _widest_gap(values: Array) -> tuple[float, float]:
    """Return the largest distance from a number in [0, 1] to the nearest value, and that number."""
    ordered = np.sort(values)
    if not len(ordered):
        return 1.0, 0.5
    middles = 0.5 * (ordered[1:] + ordered[:-1])
    places = np.concatenate([[0.0], middles, [1.0]])
    gaps = np.concatenate([[ordered[0]], 0.5 * np.diff(ordered), [1 - ordered[-1]]])
    return float(gaps.max()), float(places[gaps.argmax()])
