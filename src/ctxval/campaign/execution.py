"""The loop over executions, one or several at a time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

from ctxval._util.checked import NonNegativeInt, checked
from ctxval._util.cores import Interrupts, exits_as_exceptions
from ctxval._util.progress import advance, is_heard, stage
from ctxval._util.representation import named
from ctxval.campaign.choices import Choice, Execution, OpenTrial
from ctxval.campaign.trials import TrialRecorder
from ctxval.campaign.workers import AHEAD, SerialPool, WorkerPool
from ctxval.core.plan import start_offset
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import CONVERGED, Trial
from ctxval.errors import CtxvalError, ExecutionError, InputError, StoreError

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
    budget, the total number of executions, only the rule ends the campaign, after about the expected number. If the
    choices are ``independent`` of results, they are made before the executions in front of them have ended.
    """

    recorder: TrialRecorder
    rule: Callable[[], Choice | None]
    budget: int | None = None
    expected: int | None = None
    independent: bool = False

    def next(self) -> Choice | Trial | None:
        """Return an interrupted trial, or the choice of a new one; None if there is nothing to execute at present."""
        recorder = self.recorder
        if self.budget is not None and recorder.executions + recorder.executing >= self.budget:
            return None
        return recorder.interrupted or self.rule()

    def choices(self, first: Choice, most: int) -> Iterator[Choice]:
        """Yield a choice and those that follow it: at most so many, and no more after half a second."""
        until = time.monotonic() + AHEAD
        chosen: Choice | Trial | None = first
        while isinstance(chosen, Choice):
            yield chosen
            most -= 1
            chosen = self.next() if most and time.monotonic() < until else None


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
                    self._take(self.pool.wait())
            finally:
                self.pool.close()
        if self.stopped is not None:
            raise self.stopped
        if interrupts.asked:
            raise KeyboardInterrupt

    def _fill_pool(self, interrupts: Interrupts) -> None:
        ahead = self.pool.ahead if self.schedule.independent else 0
        while self.stopped is None and not interrupts.asked:
            free = self.pool.size + ahead - len(self.running)
            if free <= 0:
                return
            idle = self.pool.size - len(self.running)
            most = idle if idle > 0 else free  # no worker is idle while the tasks that will wait are chosen
            try:
                with interrupts.shielded(False):  # a choice may take long, and nothing is lost with it
                    chosen = self.schedule.next()
                if chosen is None:
                    return
                if isinstance(chosen, Choice) and self.schedule.independent and most > 1:
                    opened = self.recorder.start_together(self.schedule.choices(chosen, most))
                else:
                    opened = [self.recorder.start(chosen)]
                for each in opened:
                    self._start(each)
                if idle <= 0:
                    return  # results may have come in the meantime
            except (CtxvalError, KeyboardInterrupt) as error:
                self.stopped = error
                if self.running and isinstance(error, KeyboardInterrupt):
                    interrupts.announce()

    def _start(self, opened: OpenTrial) -> None:
        self.pool.start(opened.number, opened.plan)
        self.running[opened.number] = opened

    def _take(self, executions: Sequence[tuple[int, Execution]]) -> None:
        """Record executions that have ended, or repeat them."""
        measured = list[tuple[Trial, Execution]]()
        for number, execution in executions:
            try:
                measured += self._measured(self.running.pop(number), execution)
            except CtxvalError as error:
                self.stopped = self.stopped or error
        ended = list[Trial]()
        by_number = {trial.number: execution.trajectory for trial, execution in measured}
        if len(measured) > 1 and all(each.distance is not None or each.failed for _, each in measured):
            with suppress(StoreError, InputError):  # one alone says what is wrong with it
                ended, measured = self.recorder.close_together(measured), []
        for trial, execution in measured:
            try:
                ended.append(self.recorder.close(trial, execution))
            except CtxvalError as error:
                self.stopped = self.stopped or error
        for trial in ended:
            if is_heard():
                advance(int(trial.executed), _result(self.recorder, trial, by_number[trial.number]))
            if self.on_trial is not None:
                self.on_trial(trial)

    def _measured(self, opened: OpenTrial, execution: Execution) -> list[tuple[Trial, Execution]]:
        """Return the trial of an execution with what is recorded of it; nothing if the execution is repeated."""
        if execution.lost is not None:
            self.losses[opened.number] += 1
            losses = self.losses[opened.number]
            if losses <= self.retry.retries:
                self._repeat(opened)
                return []
            failure = f"the worker was lost {losses} times, at last: {execution.lost}"
            return [(opened.trial, Execution(failed=failure))]
        try:
            execution = execution.measured(self.recorder.validation, opened.plan)
        except (ExecutionError, InputError) as error:
            execution = Execution(failed=str(error), seconds=execution.seconds)
        if execution.failed is not None:
            self.failures[opened.number] += 1
            if self.failures[opened.number] <= self.retry.retry_failures:
                self._repeat(opened)
                return []
        return [(opened.trial, execution)]

    def _repeat(self, opened: OpenTrial) -> None:
        if self.stopped is None:
            self._start(self.recorder.repeat(opened))


def _result(recorder: TrialRecorder, ended: Trial, executed: Trajectory | None) -> str:
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
    if executed is not None and ended.distance is not None:
        offset = start_offset(validation, validation.space.point(ended.parameters), executed)
        if offset.size:
            parts.append(f"its start was off by {offset.text}")
    if (ended.note or {}).get(CONVERGED) is False:
        parts.append("the design of its controller did not converge")
    return "   ".join(parts)
