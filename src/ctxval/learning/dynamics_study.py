"""What the executions so far teach of the dynamics, and what follows for the largest distance over all tasks."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.representation import call
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.coverage import Coverage, coverage
from ctxval.learning.dynamics_posterior import DynamicsPosterior, PosteriorSettings, learn_posterior
from ctxval.learning.execution_prediction import ExecutionPrediction, predict_execution
from ctxval.learning.recorded import closed_loops_on_model, recorded_transitions
from ctxval.learning.worst_case import WorstCase, WorstCaseSearch, WorstCaseSettings, loop_pairs

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
        self.search = WorstCaseSearch(self.planner, seed, WorstCaseSettings.for_dimension(validation.space.dimension))

    @functools.cached_property
    def _loops(self) -> Trajectory | None:
        with single_threaded():
            return closed_loops_on_model(self.validation)

    def learn(self, executed: Sequence[tuple[Array, Trajectory]]) -> LearnedDynamics | None:
        """Return what executions teach.

        Returns None if there are no recorded transitions, if M explains them, or if no task can be planned.

        Args:
            executed: points of the unit cube ``(d,)`` with the system's trajectories there.
        """
        if self._loops is None:
            return None
        recorded = recorded_transitions(self.validation.model, [trajectory for _, trajectory in executed], self._loops)
        if recorded is None:
            return None
        rng = np.random.default_rng([self.seed, len(executed), 0])
        settings = PosteriorSettings.for_horizon(self._loops.horizon)
        posterior = learn_posterior(self.validation.model, *recorded, rng, settings)
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

    @functools.cached_property
    def worst_case(self) -> WorstCase:
        """The largest distance over all tasks, for each draw of the dynamics."""
        return self.study.search.maxima(self.posterior, self.executed, self._rng(1))

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
