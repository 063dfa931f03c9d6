"""The campaign: a search for the worst task, with budget, failures and storage."""

from __future__ import annotations

import concurrent.futures as cf
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign import display, remeasuring
from ctxval.campaign.execution import RetryPolicy, Schedule, execute_schedule
from ctxval.campaign.identity import description_of, identify, search_of
from ctxval.campaign.known import KnownExecution, TrialResult, check_known, told_distance
from ctxval.campaign.results import CampaignResults
from ctxval.campaign.trials import Choice, OpenTrial, TrialRecorder
from ctxval.campaign.workers import WorkerPool, worker_pool
from ctxval.certificates import RESOLUTION, CertificateOptions, Provenance, StoppingRule, Verdict, judge
from ctxval.certificates.options import CONFIDENCE
from ctxval.core.distance import Distance
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.searches import Search
from ctxval.storage.store import Store

__all__ = ["Campaign", "OpenTrial"]


class Campaign(CampaignResults):
    """A search for the worst task, with everything stored before and after each execution.

    The budget is a total: running again resumes, and a resumed campaign makes the choices that it would have made
    without the interruption.

    Args:
        validation: the map p -> d(p).
        search: chooses the tasks. If it is not given, a new store has ``auto``, as on the command line, and an existing
            one goes on with the search that it was made with.
        store: file of the trials; in memory by default.
        seed: of the search's randomness, not negative.
        name: what the store calls the experiment.
        accept_change: why a difference from the experiment that the store was made by does not matter, or what was
            repaired on the system; it is kept in the store.
        remeasure: measure the distance of all stored executions anew, if the store has those of another distance.

    Raises:
        InputError: a value cannot be used.
        DistanceError: a stored execution cannot be measured anew; nothing is changed.
        StoreError: the store cannot be used, was made by another experiment, or has a search that must be given.
    """

    def __init__(
        self,
        validation: Validation,
        *,
        search: Search | None = None,
        store: Store | str | Path | None = None,
        seed: int = 0,
        name: str = "",
        accept_change: str | None = None,
        remeasure: bool = False,
    ) -> None:
        if not isinstance(validation, Validation):
            raise InputError(f"validation must be a Validation, got {validation!r}.")
        if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
            raise InputError(f"seed must be an integer >= 0, got {seed!r}.")
        if search is not None and not isinstance(search, Search):
            raise InputError(f"search must have reset, ask and tell, got {search!r}.")
        self.seed = int(seed)
        self.name = name
        trials = store if isinstance(store, Store) else Store(store)
        self.search: Search = search_of(trials) if search is None else search
        description = description_of(validation, self.search, self.seed, name)
        identify(trials, validation, description, accept_change, remeasure)
        super().__init__(TrialRecorder(validation, self.search, trials, self.seed, description))
        if remeasure:
            self.remeasure()

    # The verdict

    def verdict(
        self,
        threshold: float,
        confidence: float = CONFIDENCE,
        *,
        stochastic: bool = False,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
    ) -> Verdict:
        """Return whether M may be trusted up to a threshold tau, in the distance's units.

        Falsified by an executed counterexample, validated by a certificate with this confidence, undecided otherwise;
        then it says what is expected to decide.

        Args:
            threshold: tau.
            confidence: of a validation.
            stochastic: whether two executions of one task may differ.
            resolution: how far from every trial a task may be, in diagonals of the task space, for a validation.
            certificate: by which certificate, in place of the posterior bound with these options.
        """
        chosen = certificate or CertificateOptions.posterior(confidence, stochastic=stochastic, resolution=resolution)
        known = Provenance.of(self.store.description(), self.store.history())
        return judge(self.trials, threshold, chosen, replace(known, space=self.validation.space))

    # Running

    def run(
        self,
        budget: int,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        until: Callable[[Campaign], bool] | None = None,
        workers: int | None = None,
        executor: cf.Executor | None = None,
        timeout: float | None = None,
        retries: int = 2,
        retry_failures: int = 0,
    ) -> Campaign:
        """Execute until ``budget`` executions have ended in all, earlier ones counted.

        A failed execution is a failed trial and counts; the campaign goes on. With many workers a new task is chosen
        as soon as one is free, while the search knows which are being executed; what it chooses then depends on which
        of them ended first. Ctrl-C ends after the running executions, a second one at once; both can be resumed.

        Args:
            budget: total number of executions of S.
            on_trial: called with each trial that has ended.
            until: asked before each execution; the campaign stops early once it answers yes.
            workers: processes of this computer, each with its own copy of the system; or how many executions the
                executor is given at a time.
            executor: of ``concurrent.futures``, in place of own processes.
            timeout: seconds after which an execution has failed; it then runs in a process of its own.
            retries: how often the execution of a trial is repeated whose worker was lost.
            retry_failures: how often it is repeated if the system itself failed.

        Raises:
            InputError: a value cannot be used, or the system cannot be sent to the workers.
            ModelError, DesignError, DistanceError: the task, the model or the distance cannot be used. What was
                executed is stored; running again goes on behind the trial that failed.
            CampaignError: the workers are gone.
        """
        total = _count("budget must be a positive integer", budget)
        by_search = Choice(planned_draws=total if until is None else 0)

        def rule() -> Choice | None:
            return None if until is not None and until(self) else by_search

        pool, retry = self._pool(workers, executor, timeout), RetryPolicy(retries, retry_failures)
        if retry_failures and pool is None:
            raise InputError("retry_failures is for workers, an executor or a timeout, and none is given.")
        return self._execute(Schedule(self._recorder, rule, total), pool, on_trial, retry)

    def run_until_decided(
        self,
        threshold: float,
        budget: int,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        confidence: float = CONFIDENCE,
        stochastic: bool = False,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        workers: int | None = None,
        executor: cf.Executor | None = None,
        timeout: float | None = None,
    ) -> Campaign:
        """Execute until the verdict on a threshold is reached, or the budget is spent.

        If the posterior bound keeps the threshold, and only tasks that nothing came near to stand in the way, those
        are executed, as long as the budget suffices for all of them; otherwise the search chooses the next task.

        Args:
            threshold: tau, in the distance's units.
            budget: total number of executions of S, at most.
            on_trial: called with each trial that has ended.
            confidence, stochastic, resolution, certificate: as in :meth:`verdict`; it must be the posterior bound.
            workers, executor, timeout: as in :meth:`run`.

        Raises:
            InputError, ModelError, DesignError, DistanceError, CampaignError: as :meth:`run` does.
            CertificateError: the confidence is not a probability.
        """
        total = _count("budget must be a positive integer", budget)
        by = certificate or CertificateOptions.posterior(confidence, stochastic=stochastic, resolution=resolution)
        stopping = StoppingRule(threshold, by)

        def rule() -> Choice | None:
            now = stopping.decide(self.trials, total - self.executions)
            if now.decided:
                return None
            # What is found decides how many draws there are, so their number is not planned.
            return Choice(now.next_point, "covering", planned_draws=0)

        pool = self._pool(workers, executor, timeout)
        return self._execute(Schedule(self._recorder, rule, total), pool, on_trial)

    def audit(
        self,
        draws: int,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        workers: int | None = None,
        executor: cf.Executor | None = None,
        timeout: float | None = None,
    ) -> Campaign:
        """Execute independent uniform draws of tasks, whatever the search, until there are so many among the trials.

        Args:
            draws: total number of independent draws.
            on_trial: called with each trial that has ended.
            workers, executor, timeout: as in :meth:`run`.

        Raises:
            InputError: the number is not a positive integer.
            ModelError, DesignError, DistanceError: as :meth:`run` does.
        """
        planned = _count("an audit needs a positive number of draws", draws)

        def rule() -> Choice | None:
            drawn = sum(trial.origin == "iid" for trial in self.trials)
            return None if drawn >= planned else Choice(self._recorder.draw(), "iid", planned_draws=planned)

        return self._execute(Schedule(self._recorder, rule), self._pool(workers, executor, timeout), on_trial)

    def _pool(self, workers: int | None, executor: cf.Executor | None, timeout: float | None) -> WorkerPool | None:
        system = self.validation.system
        if getattr(system, "manual", False):
            raise InputError(
                "this system is executed by people, not by run or audit: take tasks with ask and say what happened "
                "with tell, in Python or as `ctxval ask` and `ctxval tell`."
            )
        return worker_pool(system, workers=workers, executor=executor, timeout=timeout)

    def _execute(
        self,
        schedule: Schedule,
        pool: WorkerPool | None,
        on_trial: Callable[[Trial], None] | None,
        retry: RetryPolicy | None = None,
    ) -> Campaign:
        execute_schedule(schedule, pool, on_trial, retry or RetryPolicy())
        return self

    # By hand

    def ask(
        self,
        parameters: Mapping[str, Any] | None = None,
        *,
        draw: bool = False,
        because: str | None = None,
        wait: float = 0.0,
    ) -> OpenTrial:
        """Open the next trial: the search's choice, the task with these parameters, or an independent uniform draw.

        Args:
            parameters: of a task that you chose yourself.
            draw: for an audit.
            because: what was changed on the system since the task of these parameters was executed before.
            wait: seconds to wait for another process that is asking.

        Raises:
            InputError: the parameters are not of the task space.
            StoreAccessError: another process is running the store.
            ModelError, DesignError: no controller could be designed and run on the model; the trial is stored as
                failed and costs no execution.
        """
        if because is not None and (parameters is None or not because.strip()):
            raise InputError('a reason such as "fuse replaced" is given for a task that was executed before.')
        with self.store.sole_writer(wait):
            self._recorder.refresh()
            if parameters is not None:
                return self._recorder.open(Choice(self._unit_point(parameters), "manual", because))
            return self._recorder.open(Choice(self._recorder.draw(), "iid") if draw else Choice())

    def reopen(self, number: int) -> OpenTrial:
        """Return an open trial again, with its task and controller.

        Raises:
            InputError: there is no such trial, or it is not open.
        """
        self._recorder.refresh()
        trial = self._recorder.open_trial(number)
        return OpenTrial(trial, self._recorder.plan(trial))

    def tell(
        self,
        opened: OpenTrial | int,
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        start_tolerance: float | None = None,
    ) -> Trial:
        """Record how an open trial, or the one of this number, ended: its trajectory, its distance, or why it failed.

        Raises:
            InputError: not exactly one of them is given, the trial is not open, or the trajectory is of another task.
            ExecutionError: the trajectory is not a whole execution of the trial's task; the trial stays open.
            DistanceError: the distance gave no usable number; the execution is stored.
        """
        recorder = self._recorder
        recorder.refresh()
        trial = recorder.open_trial(opened.number if isinstance(opened, OpenTrial) else int(opened))
        if isinstance(opened, OpenTrial) and not np.array_equal(opened.trial.unit_point, trial.unit_point):
            raise InputError(f"this open trial {opened.number} is of another campaign.")
        told = TrialResult(trajectory, distance, failed)
        with recorder.not_executing(trial):
            trial = recorder.open_trial(trial.number)
            if told.failed is not None:
                return recorder.fail(trial, told.failed)
            if told.distance is not None:
                return recorder.complete(trial, told_distance(told.distance))
            plan = opened.plan if isinstance(opened, OpenTrial) else recorder.plan(trial)
            return recorder.complete(
                trial, self.validation.accept(plan, told.trajectory, start_tolerance), told.trajectory
            )

    def add(
        self,
        parameters: Mapping[str, Any],
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        start_tolerance: float | None = None,
        wait: float = 0.0,
    ) -> Trial | None:
        """Record an execution that was made before, with the origin manual; None if it is in the store already.

        It counts as an execution.

        Raises:
            InputError, ExecutionError: as :meth:`tell` does; nothing is stored then.
            ModelError, DesignError: the task cannot be planned; nothing is stored.
        """
        point = self.validation.space.point(parameters)
        told = TrialResult(trajectory, distance, failed)
        return self.add_known(check_known(self.validation, point, told, start_tolerance), wait)

    def add_known(self, known: KnownExecution, wait: float = 0.0) -> Trial | None:
        """Record an execution that ``campaign.known.check_known`` has checked; None if it is in the store already."""
        return self._recorder.add(known, wait)

    def _unit_point(self, parameters: Mapping[str, Any]) -> Array:
        return self.validation.space.to_unit(self.validation.space.point(parameters))

    # Measuring again

    def remeasure(self, distance: Distance | None = None) -> list[Trial]:
        """Measure the distance of every stored execution anew, without an execution; return the trials that changed.

        The values of before stay in the store's history. A distance that was told without a trajectory cannot be
        measured anew: if the definition has changed, its trial has no distance from then on.

        Args:
            distance: the distance from now on; the one of the validation if it is not given.

        Raises:
            DistanceError: the distance of a trial that had one cannot be measured any more; nothing is changed.
            StoreAccessError: another process is running the store.
        """
        return remeasuring.remeasure(self._recorder, distance)

    # What a person sees

    def __repr__(self) -> str:
        return display.as_text(self)

    def _repr_html_(self) -> str:
        return display.as_html(self)


def _count(sentence: str, count: object) -> int:
    """Return a positive integer, or raise with the sentence."""
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise InputError(f"{sentence}, got {count!r}.")
    return int(count)
