"""The loop over executions: one after the other in this process, or several at a time on workers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from ctxval._util.checked import NonNegativeInt, checked
from ctxval._util.interrupts import Interrupts, exits_as_exceptions
from ctxval._util.progress import advance, is_heard, stage
from ctxval._util.representation import named
from ctxval.campaign.choices import Choice, OpenTrial
from ctxval.campaign.remeasuring import remeasure
from ctxval.campaign.trials import TrialRecorder
from ctxval.campaign.workers import ExecutionResult, WorkerPool, execute_task
from ctxval.core.plan import Measurement, Plan
from ctxval.core.trial import CONVERGED, Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, ExecutionError, InputError

_SLOW = 1.0
"""Seconds from which on the duration of an execution is said."""

_CLEAR = 5e-4
"""Share of a predicted distance from which on its standard deviation is said."""

OnTrial = Callable[[Trial], None]
"""Called with each trial that has ended."""


@checked
@dataclass(frozen=True)
class RetryPolicy:
    """Limits on the repetitions of the execution of one trial.

    Attributes:
        retries: the largest number of repetitions if the worker is lost.
        retry_failures: the largest number of repetitions if the system fails.
    """

    retries: NonNegativeInt = 2
    retry_failures: NonNegativeInt = 0


@dataclass(frozen=True, eq=False)
class Schedule:
    """The order of the executions: first the interrupted trials, then the choices of a rule.

    Attributes:
        recorder: the recorder of the trials.
        rule: returns the choice of a new trial, or None if there is none at present. It is called again after an
            execution has ended.
        budget: the total number of executions; None if only the rule ends the campaign.
        expected: the total number of executions that are expected if there is no budget.
    """

    recorder: TrialRecorder
    rule: Callable[[], Choice | None]
    budget: int | None = None
    expected: int | None = None

    def next(self) -> Choice | Trial | None:
        """Return an interrupted trial, or the choice of a new one; None if there is nothing to execute at present."""
        recorder = self.recorder
        if self.budget is not None and recorder.executions + recorder.executing >= self.budget:
            return None
        return recorder.interrupted or self.rule()


def execute_schedule(schedule: Schedule, pool: WorkerPool | None, on_trial: OnTrial | None, retry: RetryPolicy) -> None:
    """Execute a schedule to its end, as the only process that runs the store."""
    recorder = schedule.recorder
    with recorder.store.sole_writer(), Interrupts() as interrupts, exits_as_exceptions():
        recorder.refresh()
        if any(trial.state == "unmeasured" for trial in recorder.trials):
            remeasure(recorder)
        total = schedule.expected if schedule.budget is None else schedule.budget
        try:
            with stage("executions", total, done=recorder.executions):
                if pool is None:
                    _execute_in_turn(schedule, on_trial, interrupts)
                else:
                    _ParallelExecution(schedule, pool, on_trial, retry).run(interrupts)
        finally:
            recorder.abandon_executions()


def _report(recorder: TrialRecorder, ended: Trial, on_trial: OnTrial | None) -> None:
    """Tell whoever listens that a trial has ended."""
    if is_heard():
        advance(int(ended.executed), _result(recorder, ended))
    if on_trial is not None:
        on_trial(ended)


def _result(recorder: TrialRecorder, ended: Trial) -> str:
    """Return a trial in one line: its task, what was predicted, and what was executed."""
    validation, predicted = recorder.validation, recorder.dynamics.stored_prediction(ended)
    parts = [f"trial {ended.number:<2}", str(named(ended.parameters, validation.space.units))]
    if predicted is not None:
        clear = predicted.deviation >= _CLEAR * predicted.median
        parts.append(f"predicted {predicted.median:.4g}" + (f" ± {predicted.deviation:.1g}" if clear else ""))
    if ended.distance is None:
        parts.append(f"failed: {ended.failure}")
    else:
        parts.append(f"executed {ended.distance:.4g} {validation.labels.units}".rstrip())
    if ended.seconds is not None and ended.seconds >= _SLOW:
        parts.append(f"{ended.seconds:.2g} s")
    offset = recorder.start_offset(ended)
    if offset is not None and offset.size:
        parts.append(f"its start was off by {offset.text}")
    if (ended.note or {}).get(CONVERGED) is False:
        parts.append("the design of its controller did not converge")
    return "   ".join(parts)


def _execute_in_turn(schedule: Schedule, on_trial: OnTrial | None, interrupts: Interrupts) -> None:
    recorder = schedule.recorder
    while (chosen := schedule.next()) is not None:
        opened = recorder.start(chosen)
        with interrupts.shielded():
            system, plan = recorder.validation.system, opened.plan
            result = execute_task(system, plan.controller, plan.task)
            try:
                measurement = _measured(recorder.validation, plan, result)
            except ExecutionError as error:
                ended = recorder.fail(opened.trial, error, seconds=result.seconds)
            else:
                ended = recorder.complete(opened.trial, measurement, result.trajectory, result.seconds)
            _report(recorder, ended, on_trial)
        interrupts.raise_if_asked()


def _measured(validation: Validation, plan: Plan, result: ExecutionResult) -> Measurement:
    """Return the distance of an execution."""
    if result.failure is not None:
        raise ExecutionError(result.failure)
    try:
        return validation.accept(plan, result.trajectory)
    except InputError as error:
        raise ExecutionError(str(error)) from error


class _ParallelExecution:
    """Several executions at a time.

    Args:
        schedule: the trials to execute.
        pool: the workers.
        on_trial: called with each trial that has ended.
        retry: the limits on repetitions.
    """

    def __init__(self, schedule: Schedule, pool: WorkerPool, on_trial: OnTrial | None, retry: RetryPolicy) -> None:
        self.schedule, self.pool, self.on_trial, self.retry = schedule, pool, on_trial, retry
        self.recorder = schedule.recorder
        self.running: dict[int, OpenTrial] = {}
        self.losses: Counter[int] = Counter()
        self.failures: Counter[int] = Counter()
        self.stopped: BaseException | None = None

    def run(self, interrupts: Interrupts) -> None:
        """Execute the schedule; if an error stops it, first wait for the running executions."""
        try:
            while True:
                self._fill_pool(interrupts)
                if not self.running:
                    break
                with interrupts.shielded():
                    self._take(*self.pool.wait())
        finally:
            self.pool.close()
        if self.stopped is not None:
            raise self.stopped
        interrupts.raise_if_asked()

    def _fill_pool(self, interrupts: Interrupts) -> None:
        while self.stopped is None and not interrupts.asked and len(self.running) < self.pool.size:
            try:
                chosen = self.schedule.next()
                if chosen is None:
                    return
                self._start(self.recorder.start(chosen))
            except (CtxvalError, KeyboardInterrupt) as error:
                self.stopped = error
                if self.running and isinstance(error, KeyboardInterrupt):
                    interrupts.announce()

    def _start(self, opened: OpenTrial) -> None:
        self.pool.start(opened.number, opened.plan)
        self.running[opened.number] = opened

    def _take(self, number: int, result: ExecutionResult) -> None:
        opened = self.running.pop(number)
        try:
            ended = self._lost(opened, result.lost) if result.lost is not None else self._ended(opened, result)
        except CtxvalError as error:
            self.stopped = self.stopped or error
            return
        if ended is not None:
            _report(self.recorder, ended, self.on_trial)

    def _lost(self, opened: OpenTrial, reason: str) -> Trial | None:
        """Repeat an execution whose worker was lost and return None; after too many losses, return the failed trial."""
        self.losses[opened.number] += 1
        if self.losses[opened.number] <= self.retry.retries:
            self._repeat(opened)
            return None
        failure = f"the worker was lost {self.losses[opened.number]} times, at last: {reason}"
        return self.recorder.fail(opened.trial, failure)

    def _ended(self, opened: OpenTrial, result: ExecutionResult) -> Trial | None:
        """Store the result of an execution and return its trial; return None if it failed and is repeated."""
        try:
            measurement = _measured(self.recorder.validation, opened.plan, result)
        except ExecutionError as error:
            self.failures[opened.number] += 1
            if self.failures[opened.number] <= self.retry.retry_failures:
                self._repeat(opened)
                return None
            return self.recorder.fail(opened.trial, error, seconds=result.seconds)
        return self.recorder.complete(opened.trial, measurement, result.trajectory, result.seconds)

    def _repeat(self, opened: OpenTrial) -> None:
        if self.stopped is None:
            self._start(self.recorder.repeat(opened))
