"""The loop over executions, one or several at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from ctxval._util.checked import NonNegativeInt, checked
from ctxval._util.interrupts import Interrupts, exits_as_exceptions
from ctxval._util.progress import advance, is_heard, stage
from ctxval._util.representation import named
from ctxval.campaign.choices import Choice, Execution, OpenTrial
from ctxval.campaign.trials import TrialRecorder
from ctxval.campaign.workers import SerialPool, WorkerPool
from ctxval.core.trial import CONVERGED, Trial
from ctxval.errors import CtxvalError, ExecutionError, InputError

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

    The rule returns None if there is no choice at present; it is called again after an execution has ended. Without a
    budget, the total number of executions, only the rule ends the campaign, after about the expected number.
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
    """Execute a schedule to its end, as the only process that runs the store; without a pool, in this process."""
    recorder = schedule.recorder
    with recorder.store.sole_writer(), Interrupts() as interrupts, exits_as_exceptions():
        recorder.refresh()
        if any(trial.state == "unmeasured" for trial in recorder.trials):
            recorder.remeasure()
        workers = SerialPool(recorder.validation.system) if pool is None else pool
        total = schedule.expected if schedule.budget is None else schedule.budget
        try:
            with stage("executions", total, done=recorder.executions):
                _Loop(schedule, workers, on_trial, retry).run(interrupts)
        finally:
            recorder.abandon_executions()


class _Loop:
    """Keeps all workers busy, and records what their executions gave."""

    def __init__(self, schedule: Schedule, pool: WorkerPool, on_trial: OnTrial | None, retry: RetryPolicy) -> None:
        self.schedule, self.pool, self.on_trial, self.retry = schedule, pool, on_trial, retry
        self.recorder = schedule.recorder
        self.running: dict[int, OpenTrial] = {}
        self.losses: Counter[int] = Counter()
        self.failures: Counter[int] = Counter()
        self.stopped: BaseException | None = None

    def run(self, interrupts: Interrupts) -> None:
        """Execute the schedule; if an error stops it, first wait for the running executions."""
        with interrupts.shielded():
            try:
                while True:
                    self._fill_pool(interrupts)
                    if not self.running:
                        break
                    self._take(*self.pool.wait())
            finally:
                self.pool.close()
        if self.stopped is not None:
            raise self.stopped
        if interrupts.asked:
            raise KeyboardInterrupt

    def _fill_pool(self, interrupts: Interrupts) -> None:
        while self.stopped is None and not interrupts.asked and len(self.running) < self.pool.size:
            try:
                with interrupts.shielded(False):  # a choice may take long, and nothing is lost with it
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

    def _take(self, number: int, execution: Execution) -> None:
        """Record an execution that has ended, or repeat it."""
        try:
            ended = self._recorded(self.running.pop(number), execution)
        except CtxvalError as error:
            self.stopped = self.stopped or error
            return
        if ended is not None and is_heard():
            advance(int(ended.executed), _result(self.recorder, ended))
        if ended is not None and self.on_trial is not None:
            self.on_trial(ended)

    def _recorded(self, opened: OpenTrial, execution: Execution) -> Trial | None:
        """Return the trial of an execution that was stored; None if the execution is repeated."""
        if execution.lost is not None:
            self.losses[opened.number] += 1
            losses = self.losses[opened.number]
            if losses <= self.retry.retries:
                self._repeat(opened)
                return None
            failure = f"the worker was lost {losses} times, at last: {execution.lost}"
            return self.recorder.close(opened.trial, Execution(failed=failure))
        try:
            execution = execution.measured(self.recorder.validation, opened.plan)
        except (ExecutionError, InputError) as error:
            execution = Execution(failed=str(error), seconds=execution.seconds)
        if execution.failed is not None:
            self.failures[opened.number] += 1
            if self.failures[opened.number] <= self.retry.retry_failures:
                self._repeat(opened)
                return None
        return self.recorder.close(opened.trial, execution)

    def _repeat(self, opened: OpenTrial) -> None:
        if self.stopped is None:
            self._start(self.recorder.repeat(opened))


def _result(recorder: TrialRecorder, ended: Trial) -> str:
    """Return a trial in one line: its task, what was predicted, and what was executed."""
    validation, predicted = recorder.validation, recorder.dynamics.stored_prediction(ended)
    parts = [f"trial {ended.number:<2}", str(named(ended.parameters, validation.space.units))]
    if predicted is not None and predicted.deviation > max(predicted.median, 1e-300):
        parts.append("hardly predictable yet")
    elif predicted is not None:
        visible = predicted.deviation >= 5e-4 * predicted.median
        parts.append(f"predicted {predicted.median:.4g}" + (f" ± {predicted.deviation:.1g}" if visible else ""))
    if ended.distance is None:
        parts.append(f"failed: {ended.failure}")
    else:
        parts.append(f"executed {ended.distance:.4g} {validation.labels.units}".rstrip())
    if ended.seconds is not None and ended.seconds >= 1:
        parts.append(f"{ended.seconds:.2g} s")
    offset = recorder.start_offset(ended)
    if offset is not None and offset.size:
        parts.append(f"its start was off by {offset.text}")
    if (ended.note or {}).get(CONVERGED) is False:
        parts.append("the design of its controller did not converge")
    return "   ".join(parts)
