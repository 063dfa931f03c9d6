"""The campaign: a search for the worst task with a budget, in which failures are data and all trials are stored."""

from __future__ import annotations

import concurrent.futures as cf
from collections.abc import Callable
from pathlib import Path

from ctxval._util.checked import NonNegativeInt, PositiveFloat, PositiveInt, Seconds, checked
from ctxval._util.progress_display import progress_shown
from ctxval.campaign import display, remeasuring
from ctxval.campaign.choices import Choice, OpenTrial
from ctxval.campaign.execution import RetryPolicy, Schedule, execute_schedule
from ctxval.campaign.identity import description_of, identify, search_of
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.campaign.operated import OperatedCampaign
from ctxval.campaign.storage.store import Store
from ctxval.campaign.trials import TrialRecorder
from ctxval.campaign.workers import WorkerPool, worker_pool
from ctxval.certificates import RESOLUTION, CertificateOptions
from ctxval.certificates.options import CONFIDENCE, WITHIN
from ctxval.core.distance import Distance
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CertificateError, InputError
from ctxval.searches import Auto, Search

__all__ = ["Campaign", "OpenTrial"]


@checked
class Campaign(OperatedCampaign):
    """A search for the worst task, with every trial stored before and after its execution.

    The budget is a total: running again resumes the campaign. A resumed campaign makes the same choices as an
    uninterrupted one.

    Args:
        validation: the map p -> d(p).
        search: chooses the tasks. By default, it is ``auto`` for a new store and the stored search for an existing one.
        store: the store of the trials, or the path of its file; in memory by default.
        seed: the seed of the random numbers of the search, an integer >= 0.
        name: the name of the experiment in the store.
        accept_change: the reason why the experiment may differ from the one that made the store, for example a repair
            of the system. The store keeps the reason.
        remeasure: recompute the distances of all stored executions, because the distance function was changed.

    Raises:
        InputError: if a value cannot be used.
        DistanceError: if the distance of a stored execution cannot be recomputed; nothing is changed.
        StoreError: if the store cannot be used, if another experiment made it, or if its search must be given.
    """

    def __init__(
        self,
        validation: Validation,
        *,
        search: Search | None = None,
        store: Store | str | Path | None = None,
        seed: NonNegativeInt = 0,
        name: str = "",
        accept_change: str | None = None,
        remeasure: bool = False,
    ) -> None:
        self.seed = int(seed)
        self.name = name
        trials = store if isinstance(store, Store) else Store(store)
        self.search: Search = search_of(trials) if search is None else search
        description = description_of(validation, self.search, self.seed, name)
        identify(trials, validation, description, accept_change, remeasure)
        super().__init__(TrialRecorder(validation, self.search, trials, self.seed, description))
        if remeasure:
            self.remeasure()

    # Running

    @checked
    def run(
        self,
        budget: PositiveInt,
        threshold: PositiveFloat | None = None,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        explore: bool | None = None,
        within: PositiveFloat = WITHIN,
        confidence: float = CONFIDENCE,
        stochastic: bool = False,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        until: Callable[[Campaign], bool] | None = None,
        workers: PositiveInt | None = None,
        executor: cf.Executor | None = None,
        timeout: Seconds | None = None,
        retries: NonNegativeInt = 2,
        retry_failures: NonNegativeInt = 0,
        progress: bool | None = None,
    ) -> Campaign:
        """Execute the tasks that narrow the interval of d*, until it decides or the budget is spent.

        The interval is that from the largest executed distance to a bound on d*. With a threshold, the campaign ends
        when the threshold lies outside of it: the model is falsified or validated. Without one, it ends when the bound
        is close to the largest executed distance. If trajectories teach the dynamics, the bound is that from learned
        dynamics, and each execution is predicted beforehand; the prediction is stored with the trial. Otherwise it is
        the posterior bound of the distance. To explore is to spend the whole budget on the tasks of the search.

        A failed execution is a failed trial. It counts, and the campaign continues. With several workers, a new task is
        chosen as soon as a worker is free. The search knows the tasks that are being executed, and its choice depends
        on the order in which executions end. Ctrl-C stops the campaign after the running executions, and a second
        Ctrl-C stops it at once; in both cases, the campaign can be resumed.

        Args:
            budget: largest total number of executions of S, including earlier ones.
            threshold: tau, in the units of the distance.
            on_trial: called with each trial that has ended.
            explore: whether the search alone chooses the tasks, and the whole budget is spent; None if this holds
                unless there is a threshold or the search is ``auto``.
            within: without a threshold, the share by which the bound may exceed the largest executed distance at the
                end.
            confidence, stochastic, resolution, certificate: as in :meth:`verdict`; unless the campaign explores, the
                kind of the certificate must be ``auto``, ``dynamics``, ``posterior`` or, with an acceptable volume,
                ``anytime``.
            until: called before each execution; the campaign stops early if it returns True.
            workers: number of processes, each with its own copy of the system; with an executor, the number of
                executions that it has at a time.
            executor: an executor of ``concurrent.futures`` that replaces these processes.
            timeout: time limit of an execution in seconds; a longer execution has failed. With a time limit, the
                system is executed in a separate process.
            retries: largest number of repetitions of an execution if its worker is lost.
            retry_failures: largest number of repetitions of an execution if the system fails.
            progress: whether to show the progress on standard error; None to show it at a terminal and in a notebook.

        Raises:
            InputError: if a value cannot be used, or the system cannot be sent to the workers.
            CertificateError: if an option of the certificate is not valid.
            ModelError, DesignError, DistanceError: if the task, the model or the distance cannot be used. All
                executions are stored, and running again continues after the trial that failed.
            CampaignError: if there are no workers any more.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, stochastic, resolution)
        if explore is None:
            explore = threshold is None and not isinstance(self.search, Auto)
        decides = None
        if not explore:
            decides = IntervalSearch(self._recorder, options, budget, threshold, within)
        by_search = Choice(planned_draws=budget if until is None else 0)

        def rule() -> Choice | None:
            if until is not None and until(self):
                return None
            return by_search if decides is None else decides.choose()

        pool, retry = self._pool(workers, executor, timeout), RetryPolicy(retries, retry_failures)
        if retry_failures and pool is None:
            raise InputError("retry_failures needs workers, an executor or a timeout.")
        predicts = decides is not None and decides.predicts
        with self._recorder.predicting(predicts), progress_shown(progress):
            return self._execute(Schedule(self._recorder, rule, budget), pool, on_trial, retry)

    @checked
    def audit(
        self,
        draws: PositiveInt,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        workers: PositiveInt | None = None,
        executor: cf.Executor | None = None,
        timeout: Seconds | None = None,
        progress: bool | None = None,
    ) -> Campaign:
        """Execute independent draws from the distribution of tasks until the trials contain this number of them.

        The search does not choose these tasks.

        Args:
            draws: total number of independent draws, including earlier ones.
            on_trial: called with each trial that has ended.
            workers, executor, timeout, progress: as in :meth:`run`.

        Raises:
            InputError: if the number is not a positive integer.
            CertificateError: if people are executing open trials.
            ModelError, DesignError, DistanceError: as in :meth:`run`.
        """

        def missing() -> int:
            return max(0, draws - sum(trial.origin == "iid" for trial in self.trials))

        def rule() -> Choice | None:
            return Choice(self._recorder.draw(), "iid", planned_draws=draws) if missing() else None

        pool = self._pool(workers, executor, timeout)
        self._require_no_open_trials()
        with progress_shown(progress):
            expected = self.executions + missing()
            return self._execute(Schedule(self._recorder, rule, expected=expected), pool, on_trial)

    def _require_no_open_trials(self) -> None:
        """Refuse open trials that people are executing; an audit itself executes interrupted trials again."""
        self._recorder.refresh()
        waiting = [str(trial.number) for trial in self.trials if trial.state == "open" and not trial.attempts]
        if waiting:
            raise CertificateError(
                f"trials are open: {', '.join(waiting)}. Record their results with `ctxval tell` (tell in Python) "
                "before an audit."
            )

    def _pool(
        self, workers: PositiveInt | None, executor: cf.Executor | None, timeout: Seconds | None
    ) -> WorkerPool | None:
        system = self.validation.system
        if getattr(system, "manual", False):
            raise InputError(
                "this system is executed by people, not by run or audit: get tasks with `ctxval ask` and record the "
                "results with `ctxval tell` (ask and tell in Python)."
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

    # Measuring again

    def remeasure(self, distance: Distance | None = None) -> list[Trial]:
        """Recompute the distances of all stored executions, without an execution; return the trials that changed.

        The history of the store keeps the earlier values. A distance without a trajectory cannot be recomputed: if the
        distance function has changed, the trial becomes unmeasured.

        Args:
            distance: the new distance; by default, that of the validation.

        Raises:
            DistanceError: if the distance of a measured trial cannot be computed any more; nothing is changed.
            StoreAccessError: if another process is running the store.
        """
        return remeasuring.remeasure(self._recorder, distance)

    # What a person sees

    def __repr__(self) -> str:
        return display.as_text(self)

    def _repr_html_(self) -> str:
        return display.as_html(self)
