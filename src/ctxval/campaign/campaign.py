"""The campaign: a search for the worst task with a budget, in which failures are data and all trials are stored."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace as replaced
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval import learning
from ctxval._util.arrays import Array
from ctxval._util.checked import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Seconds,
    TimeLimit,
    checked,
)
from ctxval._util.describe import describe
from ctxval._util.progress import progress_shown, stage
from ctxval._util.representation import call
from ctxval.campaign import display
from ctxval.campaign.choices import Choice, Execution, OpenTrial
from ctxval.campaign.envelope import EnvelopeSearch
from ctxval.campaign.execution import ExecutionLoop
from ctxval.campaign.executors import Executor, worker_pool
from ctxval.campaign.history import executed_trials
from ctxval.campaign.identity import identify, search_of
from ctxval.campaign.storage.other_stores import provenance_of_store
from ctxval.campaign.storage.store import Store
from ctxval.campaign.suite_intervals import interval_search, with_next_task
from ctxval.campaign.trials import TrialRecorder
from ctxval.campaign.watching import FALSE_ALARMS, Watch
from ctxval.certificates import RESOLUTION, Certificate, CertificateOptions, Provenance, Verdict, assess, judge
from ctxval.certificates.envelope import Envelope
from ctxval.certificates.evidence import Learned
from ctxval.certificates.expiry import WatchState
from ctxval.certificates.options import CONFIDENCE, WITHIN
from ctxval.certificates.sample import without_success
from ctxval.certificates.verdict import Assessment, counterexample
from ctxval.core.distance import Distance
from ctxval.core.plan import StartOffset, input_difference, start_offset
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial, Trials
from ctxval.core.validation import Validation
from ctxval.errors import CertificateError, CtxvalError, InputError
from ctxval.gp.surrogate import Surrogate, fit_surrogate
from ctxval.searches import Auto, Search

if TYPE_CHECKING:
    from pandas import DataFrame

    from ctxval.learning import Sensitivity

__all__ = ["Campaign", "OpenTrial"]


@checked
class Campaign:
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

    Attributes:
        recorder: opens and closes the trials, for code that chooses the tasks of several campaigns.

    Raises:
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
        described = {
            "name": name,
            "seed": self.seed,
            "search": describe(self.search),
            "validation": validation.describe(),
        }
        description: dict[str, Any] = json.loads(json.dumps(described))
        identify(trials, validation, description, accept_change, remeasure)
        self.recorder = TrialRecorder(validation, self.search, trials, self.seed, description)
        if remeasure:
            self.remeasure()

    # The trials

    @property
    def validation(self) -> Validation:
        """The map p -> d(p), with the present distance function."""
        return self.recorder.validation

    @property
    def store(self) -> Store:
        """The store of the trials."""
        return self.recorder.store

    @property
    def trials(self) -> Trials:
        """All trials in the order of asking, a tuple."""
        return self.recorder.trials

    @property
    def completed(self) -> list[Trial]:
        """The trials with a distance."""
        return list(self.trials.completed)

    @property
    def failed(self) -> list[Trial]:
        """The trials that failed."""
        return list(self.trials.in_state("failed"))

    @property
    def unmeasured(self) -> list[Trial]:
        """The trials that were executed but have no distance, because it could not be measured."""
        return list(self.trials.in_state("unmeasured"))

    @property
    def executions(self) -> int:
        """The number of executions of S that have ended, with or without success."""
        return self.trials.executions

    @property
    def worst(self) -> Trial | None:
        """The completed trial with the largest distance."""
        return self.trials.worst

    @property
    def sensitivity(self) -> Sensitivity | None:
        """How far small changes move closed loops of M if these are not smooth, as found before the first execution."""
        found = next((trial.note.sensitivity for trial in self.trials[:1]), None)
        return None if found is None else learning.Sensitivity.from_json(found)

    def trajectories(self, trial: Trial) -> tuple[Trajectory | None, Trajectory | None]:
        """Return the trajectories of the model and of the system in a trial; None if a trajectory is not stored.

        That of a failed execution has the steps before the failure.
        """
        return self.store.trajectory(trial.number, "model"), self.store.trajectory(trial.number, "system")

    def start_offset(self, trial: Trial) -> StartOffset | None:
        """Return how far an execution started from the initial state of its task; None if it was not recorded."""
        executed = self.store.trajectories([trial.number], "system").get(trial.number)
        point = self.validation.space.point(trial.parameters)
        return None if executed is None else start_offset(self.validation, point, executed)

    def input_difference(self, trial: Trial) -> str | None:
        """Return how the recorded inputs of a trial are not those of its controller at the recorded states.

        It is a hint that the recording is of another run, begins at another moment than the controller, or that the
        controller acts on old states. Returns None if they agree up to a third, or if nothing was recorded.
        """
        executed = self.store.trajectories([trial.number], "system").get(trial.number)
        if executed is not None:
            with suppress(CtxvalError):  # the result is stored, whether or not its controller can be designed again
                plan = self.recorder.plan(trial)
                names = self.validation.names(executed.states.shape[-1], executed.inputs.shape[-1])[1]
                return input_difference(plan.controller, plan.task, executed, names)
        return None

    # Running

    @checked
    def run(
        self,
        budget: PositiveInt,
        threshold: PositiveFloat | None = None,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        explore: bool | None = None,
        envelope: bool = False,
        within: PositiveFloat = WITHIN,
        confidence: float = CONFIDENCE,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        share: float = 1.0,
        until: Callable[[Campaign], bool] | None = None,
        again: str | None = None,
        workers: PositiveInt | None = None,
        executor: Executor | None = None,
        timeout: Seconds | None = None,
        retries: NonNegativeInt = 2,
        retry_failures: NonNegativeInt = 0,
        thinking: TimeLimit | None = None,
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
            envelope: whether to go on after the model is falsified, with executions that enlarge the set of tasks on
                which the distance stays below the threshold; see :meth:`envelope`.
            within: without a threshold, the share by which the bound may exceed the largest executed distance at the
                end.
            confidence, resolution, certificate, share: as in :meth:`verdict`; unless the campaign explores, the
                kind of the certificate must be ``auto``, ``dynamics``, ``posterior`` or, with an acceptable volume,
                ``anytime``.
            until: called before each execution; the campaign stops early if it returns True.
            again: the change that was made to the system since executions failed, such as "fuse replaced": their tasks
                are executed again first, and certificates list the reason.
            workers: number of processes, each with its own copy of the system; with an executor, the number of
                executions that it has at a time.
            executor: an executor that replaces these processes: one of ``concurrent.futures``, or any object whose
                ``submit(function, *arguments)`` returns a job with ``done()``, ``result()`` and ``cancel()``.
            timeout: time limit of an execution in seconds; a longer execution has failed. With a time limit, the
                system is executed in a separate process.
            retries: largest number of repetitions of an execution if its worker is lost.
            retry_failures: largest number of repetitions of an execution if the system fails.
            thinking: seconds of CPU that the choice of a task may take, verdict included. Stages that do not fit are
                replaced by cheaper ones. By default, it is the time of one execution or 20 s, whichever is longer, and
                3 times that for the evidence of a verdict; infinity for no limit.
            progress: whether to show the progress on standard error; None to show it at a terminal and in a notebook.

        Raises:
            CertificateError: if an option of the certificate is not valid.
            ModelError, DesignError, DistanceError: if the task, the model or the distance cannot be used. All
                executions are stored, and running again continues after the trial that failed.
            CampaignError: if there are no workers any more.
            InputError: if an envelope, ``again`` or ``retry_failures`` lacks what it needs.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, resolution, share)
        if explore is None:
            explore = threshold is None and not isinstance(self.search, Auto)
        decides = None if explore else interval_search(self.recorder, options, budget, threshold, within)
        if envelope and (decides is None or threshold is None):
            raise InputError("an envelope needs a threshold, and a campaign that does not explore.")
        enlarges = EnvelopeSearch(decides) if envelope and decides is not None else None
        by_search = Choice(planned_draws=budget if until is None else 0)
        lost = list[Trial]()
        if again is not None:
            if not again.strip():
                raise InputError('again needs a reason, such as "fuse replaced".')
            self.refresh()
            failed = (each for each in without_success(self.trials) if each.executed and each.state == "failed")
            lost = list({each.unit_point.tobytes(): each for each in failed}.values())  # each task once

        def rule() -> Choice | None:
            if lost and not (until is not None and until(self)):
                repeated = lost.pop(0)
                return Choice(repeated.unit_point, "manual", again, parameters=repeated.parameters)
            if not self.recorder.has_tasks or (until is not None and until(self)):
                return None
            if decides is None:
                return by_search
            if enlarges is not None and (test := enlarges.reserved()) is not None:
                return test
            choice = decides.choose()
            return enlarges.choose() if choice is None and enlarges is not None and decides.is_falsified else choice

        pool = worker_pool(self.validation.system, workers=workers, executor=executor, timeout=timeout)
        if retry_failures and pool is None:
            raise InputError("retry_failures needs workers, an executor or a timeout.")
        if threshold is not None:
            self.state_threshold(threshold)
        predicts = decides is not None and decides.predicts
        with self.recorder.predicting(predicts, thinking), progress_shown(progress):
            if predicts and not self.trials and not options.kind.target.by_draws:
                self.recorder.dynamics.find_sensitivity(threshold)
            ExecutionLoop(
                self.recorder,
                rule,
                pool,
                on_trial,
                budget=budget,
                independent=decides is None and self.recorder.search.iid and until is None,
                retries=retries,
                retry_failures=retry_failures,
            ).run()
        return self

    @checked
    def audit(
        self,
        draws: PositiveInt,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        workers: PositiveInt | None = None,
        executor: Executor | None = None,
        timeout: Seconds | None = None,
        progress: bool | None = None,
    ) -> Campaign:
        """Execute independent draws from the distribution of tasks until the trials contain this number of them.

        The number of draws includes earlier ones. The other arguments and errors are those of :meth:`run`.

        Raises:
            CertificateError: if people are executing open trials.
        """

        def missing() -> int:
            return max(0, draws - sum(trial.origin == "iid" for trial in self.trials))

        def rule() -> Choice | None:
            return Choice(self.recorder.draw(), "iid", planned_draws=draws) if missing() else None

        pool = worker_pool(self.validation.system, workers=workers, executor=executor, timeout=timeout)
        self.refresh()
        # Interrupted trials are executed again; these are open, because people are executing them.
        waiting = [str(trial.number) for trial in self.trials.open if not trial.attempts]
        if waiting:
            raise CertificateError(
                f"trials are open: {', '.join(waiting)}. Record their results with `ctxval tell` (tell in Python) "
                "before an audit."
            )
        with progress_shown(progress):
            expected = self.executions + missing()
            ExecutionLoop(self.recorder, rule, pool, on_trial, expected=expected, independent=True).run()
        return self

    # Trials that people execute

    @checked
    def ask(
        self,
        parameters: Mapping[str, Any] | None = None,
        *,
        draw: bool = False,
        because: str | None = None,
        wait: NonNegativeFloat = 0.0,
        progress: bool | None = None,
    ) -> OpenTrial:
        """Open the next trial: the search's choice, the task with these parameters, or an independent draw.

        Args:
            parameters: the parameters of a task that you chose yourself.
            draw: draw the task from the distribution of tasks, for an audit.
            because: the change that was made to the system since the task with these parameters was executed before.
            wait: seconds to wait while another process chooses a task.
            progress: as in :meth:`run`.

        Raises:
            StoreAccessError: if another process is running the store.
            ModelError, DesignError: if no controller can be designed and run on the model. The trial is stored as
                failed and does not count as an execution.
            InputError: if ``because`` has no reason or no parameters.
        """
        if because is not None and (parameters is None or not because.strip()):
            raise InputError('because needs the parameters of an earlier task and a reason, such as "fuse replaced".')
        # An operator's time is worth a prediction: it is stored, and the execution tests it.
        recorder, predicts = self.recorder, self.recorder.search.uses_prediction
        with progress_shown(progress), recorder.store.sole_writer(wait), recorder.predicting(predicts):
            recorder.refresh()
            if parameters is None:
                return recorder.open(Choice(recorder.draw(), "iid") if draw else Choice())
            space = recorder.validation.space
            point = space.point(parameters)
            choice = Choice(space.to_unit(point), "manual", because, parameters=space.describe_point(point))
            return recorder.open(choice)

    @checked
    def ask_for_verdict(
        self,
        threshold: PositiveFloat,
        budget: PositiveInt,
        *,
        confidence: float = CONFIDENCE,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        thinking: TimeLimit | None = None,
        wait: NonNegativeFloat = 0.0,
        progress: bool | None = None,
    ) -> OpenTrial | None:
        """Open the trial that :meth:`run` would execute next for a threshold, if people execute it.

        Returns None if the model is validated or falsified for the threshold, or if the budget is spent. Open trials
        count for the budget. The arguments and the errors raised are those of :meth:`run` and :meth:`ask`.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, resolution)
        with progress_shown(progress), self.store.sole_writer(wait):
            self.refresh()
            search = interval_search(self.recorder, options, budget, threshold)
            self.state_threshold(threshold)
            with self.recorder.predicting(search.predicts, thinking):
                choice = search.choose() if self.executions + len(self.trials.open) < budget else None
                return None if choice is None else self.recorder.open(choice)

    def reopen(self, number: int, *, ended: bool = False) -> OpenTrial:
        """Return an open trial again, with its task and controller.

        With ``ended``, return a trial whose result was told, to replace the result.
        """
        self.refresh()
        trial = self.recorder.trial(number, ended=ended)
        return OpenTrial(trial, self.recorder.plan(trial))

    @checked
    def tell(
        self,
        opened: OpenTrial | NonNegativeInt,
        trajectory: Trajectory | None = None,
        *,
        distance: NonNegativeFloat | None = None,
        failed: str | None = None,
        start_tolerance: NonNegativeFloat | None = None,
        replace: str | None = None,
    ) -> Trial:
        """Record the result of an open trial: its trajectory, its distance, or the reason of its failure.

        Args:
            opened: the open trial, or its number.
            trajectory: the recorded trajectory.
            distance: the distance, if there is no recording.
            failed: the reason why there is no result; a trajectory has then the steps before the failure.
            start_tolerance: replaces the start tolerance of the validation.
            replace: why this result replaces one that was told before, such as "wrong file". The history of the store
                keeps the earlier result with its trajectory.

        Raises:
            ExecutionError: if the trajectory is not a complete execution of the task; the trial stays open.
            DistanceError: if the distance function gives no usable number; the execution is stored.
            InputError: if ``replace`` has no reason, or if the trial belongs to another campaign.
        """
        recorder, ended = self.recorder, replace is not None
        recorder.refresh()
        if replace is not None and not replace.strip():
            raise InputError('replace needs a reason, such as "wrong file".')
        trial = recorder.trial(opened.number if isinstance(opened, OpenTrial) else opened, ended=ended)
        if isinstance(opened, OpenTrial) and not np.array_equal(opened.trial.unit_point, trial.unit_point):
            raise InputError(f"the open trial {opened.number} belongs to another campaign.")
        execution = Execution.reported(trajectory, distance, failed)
        with recorder.not_executing(trial):
            trial = recorder.trial(trial.number, ended=ended)
            if trajectory is not None:
                plan = opened.plan if isinstance(opened, OpenTrial) else recorder.plan(trial)
                execution = execution.measured(recorder.validation, plan, start_tolerance)
            return recorder.close(trial, execution, replacing=replace)

    @checked
    def add(
        self,
        parameters: Mapping[str, Any],
        trajectory: Trajectory | None = None,
        *,
        distance: NonNegativeFloat | None = None,
        failed: str | None = None,
        start_tolerance: NonNegativeFloat | None = None,
        wait: NonNegativeFloat = 0.0,
    ) -> Trial | None:
        """Record an earlier execution as a trial with the origin manual. It counts as an execution.

        Returns None if the execution is already in the store. Nothing is stored if an error is raised: those of
        :meth:`tell`, and a ModelError or a DesignError if the task cannot be planned.
        """
        execution = Execution.reported(trajectory, distance, failed)
        plan = self.validation.plan(self.validation.space.point(parameters))
        return self.recorder.add([(plan, execution.measured(self.validation, plan, start_tolerance))], wait)[0]

    def refresh(self) -> None:
        """Read the trials again if another process has changed the store; refuse it if its experiment has changed."""
        self.recorder.refresh()

    def remeasure(self, distance: Distance | None = None) -> list[Trial]:
        """Recompute the distances of all stored executions, without an execution; return the trials that changed.

        The history of the store keeps the earlier values. A distance without a trajectory cannot be recomputed: if the
        distance function has changed, the trial becomes unmeasured.

        Args:
            distance: the new distance; by default, that of the validation.

        Raises:
            DistanceError: if the distance of a measured trial cannot be computed any more; nothing is changed.
        """
        return self.recorder.remeasure(distance)

    # Results

    @property
    def estimate(self) -> float | None:
        """The search's estimate of d*: the largest distance, unless the search discards some (SD).

        It is None if there are too few distances.
        """
        return self.recorder.search.estimate(*self._distances())

    @property
    def provenance(self) -> Provenance:
        """What a certificate needs besides the trials: the task space, the search, changes, and what M predicts."""
        recorder, validation, trials = self.recorder, self.recorder.validation, self.recorder.trials
        offsets = [
            (start_offset(validation, validation.space.point(trial.parameters), executed), trial.number)
            for trial, executed in executed_trials(recorder.store, trials)
        ]
        return replaced(
            provenance_of_store(recorder.store),
            space=validation.space,
            learned=Learned(),
            start=max(((offset.size, f"{offset.text} (trial {number})") for offset, number in offsets), default=None),
            units=validation.labels.units,
        )

    def provenance_for(
        self, options: CertificateOptions, threshold: float | None = None, trials: Trials | None = None
    ) -> Provenance:
        """Return :attr:`provenance` with what a certificate of these options reads of the learned dynamics.

        If an executed distance falsifies the threshold, the verdict needs nothing, and nothing is computed.
        """
        known, judged = self.provenance, self.recorder.trials if trials is None else trials
        confidence, target = options.confidence, options.kind.target
        if threshold is not None and counterexample(judged, threshold, known.quantities, confidence, target):
            return known
        return replaced(known, learned=self.recorder.dynamics.learned_for(judged, options))

    @checked
    def state_threshold(self, threshold: PositiveFloat) -> None:
        """Record in the store that a threshold was stated, and how many distances were known.

        A verdict says so if the threshold was first stated after distances were known. :meth:`run`,
        :meth:`ask_for_verdict` and :meth:`verdict` state their thresholds; call this if the trials come from
        :meth:`ask`, :meth:`audit` or :meth:`add`. A threshold that was stated before is not recorded again.
        """
        self.store.state_threshold(float(threshold))

    @checked
    def verdict(
        self,
        threshold: PositiveFloat,
        confidence: float = CONFIDENCE,
        *,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        share: float = 1.0,
        thinking: TimeLimit | None = None,
        progress: bool | None = None,
    ) -> Verdict:
        """Return whether the model can be trusted up to a threshold tau.

        The model is falsified if an executed distance exceeds the threshold, and validated if a certificate bounds d*
        by the threshold. Otherwise the verdict is undecided, with a forecast of the executions that would decide
        and, if learned dynamics choose it, the next task.

        Args:
            threshold: tau, in the units of the distance.
            confidence: the confidence level of the certificate, at least 0.5.
            resolution: the largest distance between a task and its nearest trial that a validation permits, in
                diagonals of the task space.
            certificate: the kind and the options of the certificate, in place of ``auto`` with the other options.
            share: the share of the tasks that must stay below the threshold, from 0.5 to 1. With less than 1, the model
                is falsified if executions at drawn tasks prove that more of them exceed it.
            thinking: as in :meth:`run`. If its evidence needs more, the verdict is undecided with the code ``no_time``.
            progress: as in :meth:`run`.

        Raises:
            CertificateError: if an option of the certificate is not valid.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, resolution, share)
        self.state_threshold(threshold)
        with progress_shown(progress):
            return self.judged(threshold, options, thinking)[0]

    def judged(
        self, threshold: float, options: CertificateOptions, thinking: float | None
    ) -> tuple[Verdict, Provenance]:
        """Return the verdict, and what it follows from besides the trials; that the threshold was stated is not stored.

        The arguments are those of :meth:`verdict`.
        """
        recorder = self.recorder
        recorder.dynamics.shortage = None
        with stage("certifying"), recorder.dynamics.thinking.limited(thinking):
            known, shortage = self.provenance_for(options, threshold), recorder.dynamics.shortage
            if shortage is None:
                verdict = judge(recorder.trials, threshold, options, known)
            else:
                verdict = Verdict("undecided", threshold, f"{shortage}.", shortage=shortage.to_json())
                # In a box, another bound has not seen what the missing evidence might show, such as noise.
                if recorder.validation.space.members is not None:
                    by_distances = judge(recorder.trials, threshold, options, known)
                    undecided = by_distances.answer == "undecided" and by_distances.certificate is None
                    verdict = verdict if undecided else by_distances
            failure = (recorder.dynamics.failure or "").rstrip(".")
            if verdict.answer == "undecided" and failure and failure not in verdict.reason:
                verdict = replaced(
                    verdict, reason=f"{verdict.reason.rstrip('.')}; learning the dynamics failed: {failure}."
                )
            return with_next_task(verdict, recorder, options), known

    @checked
    def certify(
        self,
        confidence: float = CONFIDENCE,
        *,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        share: float = 1.0,
        thinking: TimeLimit | None = None,
        progress: bool | None = None,
    ) -> Certificate:
        """Return the bound on d*, which needs no threshold. The arguments are those of :meth:`verdict`.

        Raises:
            CertificateError: if the theory of the certificate refuses the trials, or if its evidence needs more
                seconds than ``thinking`` allows.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, resolution, share)
        with progress_shown(progress):
            certified = self.assessed(None, options, thinking).certificate
        assert certified is not None  # without a threshold, a refusal is raised
        return certified

    def assessed(self, threshold: float | None, options: CertificateOptions, thinking: float | None) -> Assessment:
        """Return the certificate of :meth:`certify` with a verdict on a threshold, if there is one.

        Raises:
            CertificateError: as :meth:`certify`, if no trial exceeds the threshold.
        """
        dynamics, trials = self.recorder.dynamics, self.trials
        with stage("certifying"), dynamics.limited(thinking, trials):
            known = self.provenance_for(options)
            if dynamics.shortage is None:
                return assess(trials, options, threshold, known)
            target, refusal = options.kind.target, f"{dynamics.shortage}."
            falsified = threshold and counterexample(trials, threshold, known.quantities, options.confidence, target)
            if not falsified:
                raise CertificateError(refusal)
            return Assessment(options.kind.name, None, falsified, refusal)

    @checked
    def watch(
        self,
        threshold: PositiveFloat,
        false_alarms: PositiveFloat = FALSE_ALARMS,
        *,
        state: WatchState | None = None,
        progress: bool | None = None,
    ) -> Watch:
        """Return a watch, which tests later executions against what the executions of this campaign predict.

        Args:
            threshold: tau; what moves no distance by 1 % of it is no change.
            false_alarms: largest rate of false alarms, below 1, such as one in 1,000 executions.
            state: the state of an earlier watch of the same campaign, to go on with.
            progress: as in :meth:`run`.

        Raises:
            CertificateError: if too little can be learned from the executions.
            InputError: if ``false_alarms`` is not below 1.
        """
        if not false_alarms < 1:
            raise InputError(f"false_alarms must be less than 1, such as 0.001, got {false_alarms:g}.")
        with progress_shown(progress):
            return Watch(self.recorder, threshold, false_alarms, state)

    @checked
    def envelope(
        self,
        threshold: PositiveFloat,
        confidence: float = CONFIDENCE,
        *,
        certificate: CertificateOptions | None = None,
        thinking: TimeLimit | None = None,
        progress: bool | None = None,
    ) -> Envelope:
        """Return the set of tasks on which d stays below a threshold, with a confidence for all of them at once.

        It follows from the learned dynamics, and says why it is not stated if these do not suffice: it needs the tests
        that a validation needs. ``run(..., envelope=True)`` executes what is missing.

        Args:
            threshold: tau, in the units of the distance.
            confidence: the confidence that d stays below the threshold on all tasks of the set.
            certificate: the options ``auto`` or ``dynamics``, in place of the confidence.
            thinking: as in :meth:`verdict`. Closed loops are run on fewer tasks if not all fit.
            progress: as in :meth:`run`.

        Raises:
            CertificateError: if the confidence needs too many posterior samples.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, RESOLUTION)
        search = EnvelopeSearch(interval_search(self.recorder, options, self.executions + 1, threshold, keeps=False))
        with progress_shown(progress), self.recorder.dynamics.limited(thinking, self.trials):
            return search.envelope()

    def surrogate(self) -> Surrogate:
        """Return the Gaussian process of the distance over the task space, for every search, from two distances on."""
        of_search = self.recorder.search.surrogate()
        return fit_surrogate(*self._distances()) if of_search is None else of_search

    def to_dataframe(self) -> DataFrame:
        """Return the trials as a table of pandas, one row for each.

        The columns are number, origin, state, one for each task parameter (``name[0], name[1], ...`` for a vector),
        distance, seconds, attempts and failure. If a parameter has the name of another column, such as ``distance``,
        its column is ``parameters.distance``. Unknown values are missing values.
        """
        return display.to_dataframe(self.trials, self.validation.space)

    def _distances(self) -> tuple[Array, Array]:
        """Return the points of the unit cube with a distance ``(n, d)``, and the distances ``(n,)``."""
        completed = self.trials.completed
        return completed.points(self.validation.space.dimension), completed.distances

    def __repr__(self) -> str:
        known = {"trials": len(self.trials), "worst": self.worst and self.worst.distance, "store": self.store}
        return call(self, self.validation.space, name=self.name or None, seed=self.seed, **known)
