"""The campaign: search, validation and store together; the only object with a life."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval.arrays import Array
from ctxval.describe import describe
from ctxval.dynamics import predict_distance
from ctxval.errors import CtxvalError, DistanceError, ExecutionError, InputError
from ctxval.searches import GPUCB, Prediction, Search
from ctxval.store import Store
from ctxval.surrogate import Surrogate, fit_surrogate
from ctxval.trajectory import Trajectory
from ctxval.trial import Origin, Trial
from ctxval.validation import Plan, Validation, require_execution
from ctxval.verdict import CONFIDENCE, Verdict, judge

_AUDIT = 0x6175
"""Marks the randomness of an audit's draws; searches mark streams of theirs with small numbers."""


@dataclass(frozen=True, eq=False)
class OpenTrial:
    """A trial to be executed, with all that an operator needs for it.

    Attributes:
        trial: what is stored.
        plan: its task, its controller and the model's trajectory.
    """

    trial: Trial
    plan: Plan

    @property
    def number(self) -> int:
        """The trial's number."""
        return self.trial.number


class Campaign:
    """A search for the worst task, with everything stored before and after each execution.

    The budget is a total: running again resumes, and a resumed campaign makes the choices that it would have made
    without the interruption.

    Args:
        validation: the map p -> d(p).
        search: chooses the tasks; GP-UCB as in the paper by default.
        store: file of the trials; in memory by default.
        seed: of the search's randomness, not negative.
        name: what the store calls the experiment.

    Raises:
        InputError: a value cannot be used.
        StoreError: the store cannot be used, or was made by another experiment.
    """

    def __init__(
        self,
        validation: Validation,
        *,
        search: Search | None = None,
        store: Store | str | Path | None = None,
        seed: int = 0,
        name: str = "",
    ) -> None:
        if not isinstance(validation, Validation):
            raise InputError(f"validation must be a Validation, got {validation!r}.")
        if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
            raise InputError(f"seed must be an integer >= 0, got {seed!r}.")
        self.validation = validation
        self.search: Search = GPUCB() if search is None else search
        if not isinstance(self.search, Search):
            raise InputError(f"search must have reset, ask and tell, got {search!r}.")
        self.seed = int(seed)
        self.name = name
        self.store = store if isinstance(store, Store) else Store(store)
        self.store.identify(
            {
                "name": name,
                "seed": self.seed,
                "search": describe(self.search),
                "validation": validation.describe(),
            }
        )
        self._replay()

    def _replay(self) -> None:
        """Bring the search to where the stored trials left it."""
        self.search.reset(self.validation.space.dimension, self.seed)
        self._trials = self.store.trials()
        if self._trials:
            points = np.array([trial.unit_point for trial in self._trials])
            self.search.tell(points, [np.nan if t.distance is None else t.distance for t in self._trials])
            if hasattr(self.search, "remember"):
                self.search.remember([trial.note for trial in self._trials])

    # What is known

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All trials in the order of asking."""
        return tuple(self._trials)

    @property
    def completed(self) -> list[Trial]:
        """The trials with a distance."""
        return [trial for trial in self._trials if trial.state == "completed"]

    @property
    def failed(self) -> list[Trial]:
        """The trials that failed."""
        return [trial for trial in self._trials if trial.state == "failed"]

    @property
    def executions(self) -> int:
        """How many executions of S have ended, well or badly."""
        return sum(trial.executed for trial in self._trials)

    @property
    def worst(self) -> Trial | None:
        """The completed trial with the largest distance."""
        return max(self.completed, key=_distance, default=None)

    @property
    def estimate(self) -> float | None:
        """The search's estimate of d*: the largest distance, after discarding where the search discards (SD)."""
        discard = getattr(self.search, "discard", 0)
        ordered = sorted((_distance(trial) for trial in self.completed), reverse=True)
        return ordered[discard] if len(ordered) > discard else None

    def verdict(self, threshold: float, confidence: float = CONFIDENCE, *, stochastic: bool = False) -> Verdict:
        """Return whether M may be trusted up to a threshold tau, in the distance's units.

        Falsified by an executed counterexample, validated by the posterior bound with this confidence, undecided
        otherwise; then it says what is expected to decide.

        Args:
            threshold: tau.
            confidence: of a validation.
            stochastic: whether two executions of one task may differ.
        """
        return judge(self.trials, threshold, confidence, stochastic=stochastic)

    def surrogate(self) -> Surrogate:
        """Return the GP of the distance over the task space, whichever search chose the trials.

        Raises:
            InputError: fewer than two distances are known.
        """
        own = getattr(self.search, "surrogate", None)
        if own is not None:
            surrogate: Surrogate = own()
            return surrogate
        points = np.array([trial.unit_point for trial in self.completed])
        return fit_surrogate(points, np.array([_distance(trial) for trial in self.completed]))

    def trajectories(self, trial: Trial) -> tuple[Trajectory | None, Trajectory | None]:
        """Return the trajectories of the model and of the system in a trial; None where there is none."""
        return self.store.trajectory(trial.number, "model"), self.store.trajectory(trial.number, "system")

    # Running

    def run(
        self,
        budget: int,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        until: Callable[[Campaign], bool] | None = None,
    ) -> Campaign:
        """Execute until ``budget`` executions have ended in all, earlier ones counted.

        A failed execution is a failed trial and counts; the campaign goes on.

        Args:
            budget: total number of executions of S.
            on_trial: called with each trial that has ended.
            until: asked before each execution; the campaign stops early once it answers yes.

        Raises:
            InputError: the budget is not a positive integer.
            ModelError, DesignError, DistanceError: the task, the model or the distance cannot be used. What was
                executed is stored; running again goes on behind the trial that failed.
        """
        if not isinstance(budget, int | np.integer) or isinstance(budget, bool) or budget < 1:
            raise InputError(f"budget must be a positive integer, got {budget!r}.")
        with self.store.sole_writer():
            for trial in self._interrupted():
                if self.executions < budget:
                    self._execute(self._reopen(trial), on_trial)
            while self.executions < budget and not (until is not None and until(self)):
                self._execute(self._open(None, attempts=1), on_trial)
        return self

    def audit(self, draws: int, on_trial: Callable[[Trial], None] | None = None) -> Campaign:
        """Execute independent uniform draws of tasks, whatever the search, until there are so many among the trials.

        Args:
            draws: total number of independent draws.
            on_trial: called with each trial that has ended.

        Raises:
            InputError: the number is not a positive integer.
            ModelError, DesignError, DistanceError: as :meth:`run` does.
        """
        if not isinstance(draws, int | np.integer) or isinstance(draws, bool) or draws < 1:
            raise InputError(f"an audit needs a positive number of draws, got {draws!r}.")
        with self.store.sole_writer():
            for trial in self._interrupted():
                self._execute(self._reopen(trial), on_trial)
            while sum(trial.origin == "iid" for trial in self._trials) < draws:
                # Apart from the search's own randomness, which is that of [seed, number].
                rng = np.random.default_rng(np.random.SeedSequence([self.seed, len(self._trials), _AUDIT]))
                unit_point = rng.random(self.validation.space.dimension)
                self._execute(self._open((unit_point, "iid"), attempts=1), on_trial)
        return self

    def _interrupted(self) -> list[Trial]:
        return [trial for trial in self._trials if trial.state == "open" and trial.attempts]

    def _reopen(self, trial: Trial) -> OpenTrial:
        """Plan an interrupted trial again and count one more attempt."""
        try:
            plan = self._plan(trial)
        except CtxvalError as error:
            self._close(trial, failure=_text(error), executed=False)
            raise
        self.store.begin_attempt(trial.number)
        self._trials[trial.number] = replace(trial, attempts=trial.attempts + 1)
        return OpenTrial(self._trials[trial.number], plan)

    def _execute(self, opened: OpenTrial, on_trial: Callable[[Trial], None] | None) -> None:
        started = time.perf_counter()
        try:
            trajectory = self.validation.execute(opened.plan)
        except ExecutionError as error:
            ended = self._close(opened.trial, failure=_text(error), seconds=time.perf_counter() - started)
        else:
            ended = self._measure(opened, trajectory, time.perf_counter() - started)
        if on_trial is not None:
            on_trial(ended)

    # By hand

    def ask(self, parameters: Mapping[str, Any] | None = None) -> OpenTrial:
        """Open the next trial: the search's choice, or the task with these parameters.

        Raises:
            InputError: the parameters are not of the task space.
            ModelError, DesignError: no controller could be designed and run on the model; the trial is stored as
                failed and costs no execution.
        """
        if parameters is None:
            return self._open(None, attempts=0)
        space = self.validation.space
        return self._open((space.to_unit(space.point(parameters)), "manual"), attempts=0)

    def _open(self, given: tuple[Array, Origin] | None, attempts: int) -> OpenTrial:
        """Store a new trial ahead of its execution; one that is about to be executed counts as its first attempt."""
        try:
            return self._store_next(given, attempts)
        except BaseException:
            # Whatever stopped it, the search must know the stored trials and no other.
            self._replay()
            raise

    def _store_next(self, given: tuple[Array, Origin] | None, attempts: int) -> OpenTrial:
        note = None
        if given is None:
            unit_point, origin = self._suggestion(), self._origin()
            note = self.search.note() if hasattr(self.search, "note") else None
        else:
            unit_point, origin = given
            self.search.tell(unit_point[None], [np.nan])
        names = self.validation.space.describe_point(self.validation.space.from_unit(unit_point))
        trial = Trial(len(self._trials), origin, "open", unit_point, names, attempts, note=note)
        try:
            plan = self._plan(trial)
        except CtxvalError as error:
            self.store.record_failed_plan(replace(trial, state="failed", failure=_text(error), attempts=0))
            raise
        self.store.open_trial(trial, plan.model_trajectory)
        self._trials.append(trial)
        return OpenTrial(trial, plan)

    def tell(
        self, opened: OpenTrial | int, trajectory: Trajectory | None = None, *, failed: str | None = None
    ) -> Trial:
        """Record how an open trial, or the one of this number, ended: its trajectory, or why it failed.

        Raises:
            InputError: neither or both are given, or the trial is not open.
            ExecutionError: the trajectory is not a whole execution of the trial's task; the trial stays open.
        """
        trial = self._open_trial(opened.number if isinstance(opened, OpenTrial) else int(opened))
        if isinstance(opened, OpenTrial) and not np.array_equal(opened.trial.unit_point, trial.unit_point):
            raise InputError(f"this open trial {opened.number} is of another campaign.")
        if (trajectory is None) == (failed is None):
            raise InputError("tell needs either a trajectory or the reason of a failure.")
        if trajectory is None:
            return self._close(trial, failure=_text(failed))
        plan = opened.plan if isinstance(opened, OpenTrial) else self._plan(trial)
        require_execution(plan, trajectory)
        return self._measure(OpenTrial(trial, plan), trajectory, None)

    def _open_trial(self, number: int) -> Trial:
        if not 0 <= number < len(self._trials):
            raise InputError(f"there is no trial {number}; the campaign has {len(self._trials)}.")
        if self._trials[number].state != "open":
            raise InputError(f"trial {number} is {self._trials[number].state}, so nothing more can be told of it.")
        return self._trials[number]

    # What running and telling share

    def _plan(self, trial: Trial) -> Plan:
        return self.validation.plan(self.validation.space.from_unit(trial.unit_point))

    def _suggestion(self) -> Array:
        if hasattr(self.search, "use_prediction"):
            self.search.use_prediction(self._prediction())
        point: Array = np.asarray(self.search.ask(1), dtype=np.float64)
        if point.shape != (1, self.validation.space.dimension) or not ((point >= 0) & (point <= 1)).all():
            raise InputError(
                f"a search must return points of the unit cube, shape (1, {self.validation.space.dimension}), "
                f"got {point.tolist()}."
            )
        return np.asarray(point[0])

    def _prediction(self) -> Prediction | None:
        """Return the distance that the trajectories executed so far predict."""
        executed = [
            (trial.unit_point, trajectory)
            for trial in self.completed
            if (trajectory := self.store.trajectory(trial.number, "system")) is not None
        ]
        return predict_distance(self.validation, executed)

    def _origin(self) -> Origin:
        if getattr(self.search, "iid", False):
            return "iid"
        return "initial" if len(self._trials) < getattr(self.search, "initial", 0) else "acquisition"

    def _measure(self, opened: OpenTrial, trajectory: Trajectory, seconds: float | None) -> Trial:
        try:
            distance = self.validation.measure(opened.plan, trajectory)
        except DistanceError as error:
            self._close(opened.trial, trajectory, failure=_text(error), seconds=seconds)
            raise
        return self._close(opened.trial, trajectory, distance=distance, seconds=seconds)

    def _close(
        self,
        trial: Trial,
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failure: str | None = None,
        seconds: float | None = None,
        executed: bool = True,
    ) -> Trial:
        ended = replace(
            trial,
            state="completed" if failure is None else "failed",
            executed=executed,
            distance=distance,
            failure=failure,
            seconds=seconds,
        )
        self.store.close_trial(ended, trajectory)
        self._trials[trial.number] = ended
        if distance is not None:
            self.search.tell(trial.unit_point[None], [distance])
        return ended


def _distance(trial: Trial) -> float:
    assert trial.distance is not None  # completed trials have one
    return trial.distance


def _text(reason: object) -> str:
    """Return a reason as text that every file can hold; a serial line may have put anything into it."""
    return str(reason).encode("utf-8", "backslashreplace").decode()
