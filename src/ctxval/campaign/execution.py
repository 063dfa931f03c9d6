"""The loop over executions, one or several at a time."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from ctxval._util.cores import Interrupts, exits_as_exceptions
from ctxval._util.progress import advance, is_heard, stage
from ctxval._util.representation import named
from ctxval.campaign.choices import Choice, Execution, OpenTrial
from ctxval.campaign.trials import TrialRecorder
from ctxval.campaign.workers import AHEAD, SerialPool, WorkerPool
from ctxval.core.plan import start_offset
from ctxval.core.trajectory import DIVERGED, TERMINATED, Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CampaignError, CtxvalError, ExecutionError, InputError, StoreError


@dataclass(frozen=True)
class StopSettings:
    """When failures end a campaign."""

    alike: int = 3  #: executions that fail alike, after which a campaign stops if there are no others
    in_a_row: int = 6  #: the same, if earlier ones did not fail


STOP = StopSettings()
"""The settings in use."""


class ExecutionLoop:
    """Keeps all workers busy with interrupted trials and with the choices of a rule, and records what they give.

    The rule returns None if there is no choice at present; it is called again after an execution has ended. Without a
    budget, only the rule ends the loop.

    Without a pool, tasks are executed in this process. The budget is the largest total number of executions, including
    earlier ones; without one, progress is shown of the expected number. If the choices are independent of results, they
    are made before earlier executions end. An execution is repeated at most so many times if its worker is lost
    (``retries``) or if the system fails (``retry_failures``).
    """

    def __init__(
        self,
        recorder: TrialRecorder,
        rule: Callable[[], Choice | None],
        pool: WorkerPool | None = None,
        on_trial: Callable[[Trial], None] | None = None,
        *,
        budget: int | None = None,
        expected: int | None = None,
        independent: bool = False,
        retries: int = 2,
        retry_failures: int = 0,
    ) -> None:
        self.recorder, self.rule, self.on_trial = recorder, rule, on_trial
        self.pool = SerialPool(recorder.validation.system) if pool is None else pool
        self.budget, self.expected, self.independent = budget, expected, independent
        self.retries, self.retry_failures = retries, retry_failures
        self.running: dict[int, OpenTrial] = {}
        self.losses: Counter[int] = Counter()
        self.failures: Counter[int] = Counter()
        self.in_a_row: list[Trial] = []  # that failed after the last one that did not
        self.stopped: BaseException | None = None

    def run(self) -> None:
        """Execute to the end, alone on the store; after an error or Ctrl-C, running executions are waited for."""
        recorder = self.recorder
        with recorder.store.sole_writer(), Interrupts() as interrupts, exits_as_exceptions():
            recorder.refresh()
            if recorder.trials.in_state("unmeasured"):
                recorder.remeasure()
            total = self.expected if self.budget is None else self.budget
            try:
                with stage("executions", total, done=recorder.trials.executions):
                    with interrupts.shielded():
                        try:
                            # The heart of a campaign: choose and store, execute, measure and store.
                            while True:
                                self._fill_pool(interrupts)
                                if not self.running:
                                    break
                                self._record(self.pool.wait())
                        finally:
                            self.pool.close()
                    if self.stopped is not None:
                        raise self.stopped
                    if interrupts.asked:
                        raise KeyboardInterrupt
            finally:
                recorder.executing.clear()  # trials that are still open become interrupted ones

    def _next(self) -> Choice | Trial | None:
        """Return an interrupted trial, or the choice of a new one; None if there is nothing to execute at present."""
        if self.budget is not None and self.recorder.trials.executions + len(self.recorder.executing) >= self.budget:
            return None
        return self.recorder.interrupted or self.rule()

    def _choices(self, first: Choice, most: int) -> Iterator[Choice]:
        """Yield a choice and those that follow it: at most so many, and no more after half a second."""
        until = time.monotonic() + AHEAD
        chosen: Choice | Trial | None = first
        while isinstance(chosen, Choice):
            yield chosen
            most -= 1
            chosen = self._next() if most and time.monotonic() < until else None

    def _fill_pool(self, interrupts: Interrupts) -> None:
        ahead = self.pool.ahead if self.independent else 0
        while self.stopped is None and not interrupts.asked:
            idle = self.pool.size - len(self.running)
            if idle + ahead <= 0:
                return
            most = idle if idle > 0 else idle + ahead  # no worker is idle while the tasks that will wait are chosen
            try:
                with interrupts.shielded(False):  # a choice may take long, and nothing is lost with it
                    chosen = self._next()
                if chosen is None:
                    return
                if isinstance(chosen, Choice):
                    choices = self._choices(chosen, most if self.independent else 1)
                    opened = self.recorder.open_all(choices, attempts=1)
                else:
                    opened = [self.recorder.start_again(chosen)]
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

    def _record(self, executions: Sequence[tuple[int, Execution]]) -> None:
        """Store executions that have ended, or repeat them."""
        measured = list[tuple[Trial, Execution]]()
        for number, execution in executions:
            opened = self.running.pop(number)
            try:
                final = self._measured(opened, execution)
                if final is not None:
                    measured.append((opened.trial, final))
                elif self.stopped is None:
                    self._start(self.recorder.repeat(opened))
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
            self.in_a_row = [*self.in_a_row, trial] if trial.state == "failed" else []
        self.stopped = self.stopped or self._one_reason()
        for trial in ended:
            if is_heard():
                advance(int(trial.executed), _result(self.recorder, trial, by_number[trial.number]))
            if self.on_trial is not None:
                self.on_trial(trial)

    def _one_reason(self) -> CampaignError | None:
        """Return an error if executions fail for one reason, and more would follow; numbers in the reason may differ.

        They are all executions if none moved, or the last ones in a row of this call: who runs again goes on.
        """
        failed = ended = [trial for trial in self.recorder.trials if trial.executed]
        if len(ended) < STOP.alike or not self.in_a_row or (self.budget is not None and len(ended) >= self.budget):
            return None
        which, fewest, numbers = "all", STOP.alike, [trial.number for trial in ended]
        if any(trial.state != "failed" for trial in ended) or self.recorder.store.trajectories(numbers, "system"):
            failed, which, fewest = self.in_a_row, "the last", STOP.in_a_row
        if len(failed) < fewest:
            return None
        reasons = {re.sub(r"[-+.\d]+", "", trial.failure or "") for trial in failed}
        if len(reasons) > 1 or reasons.pop().startswith((DIVERGED, TERMINATED)):
            return None  # a loop that ends is a property of the system
        reason = (failed[-1].failure or "").rstrip(".")
        remedy = "Correct the experiment (`ctxval check` with --execute tries one task)"
        if which != "all":
            remedy = 'Remove the cause and execute them again with --again-failed "..." (again= in Python)'
        what = f"{which} {len(failed)} executions failed for one reason, so no more is executed: {reason}."
        return CampaignError(f"{what} {remedy}, or run again to go on.")

    def _measured(self, opened: OpenTrial, execution: Execution) -> Execution | None:
        """Return an execution with its distance; None if it is to be repeated."""
        if execution.lost is not None:
            self.losses[opened.number] += 1
            losses = self.losses[opened.number]
            if losses <= self.retries:
                return None
            return Execution(failed=f"the worker was lost {losses} times, at last: {execution.lost}")
        try:
            execution = execution.measured(self.recorder.validation, opened.plan)
        except (ExecutionError, InputError) as error:
            failed, validation = Execution(failed=str(error)), self.recorder.validation
            with suppress(InputError):
                failed = Execution.before_failure(validation, opened.plan, execution.trajectory, str(error))
            execution = replace(failed, seconds=execution.seconds)
        if execution.failed is not None and execution.ends is None:  # a fall is no failure to repeat
            self.failures[opened.number] += 1
            if self.failures[opened.number] <= self.retry_failures:
                return None
        return execution


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
        if ended.ended_alone is not None:
            parts.append(f"S ended after {ended.ended_alone:.3g} s, and M did not")
        elif ended.least:
            parts.append(f"at least {ended.least:.4g} {validation.labels.units}".rstrip())
    else:
        parts.append(f"executed {ended.distance:.4g} {validation.labels.units}".rstrip())
    if ended.seconds is not None and ended.seconds >= 1:
        parts.append(f"{ended.seconds:.2g} s")
    if executed is not None and ended.distance is not None:
        offset = start_offset(validation, validation.space.point(ended.parameters), executed)
        if offset.size:
            parts.append(f"its start was off by {offset.text}")
    if ended.note.converged is False:
        parts.append("the design of its controller did not converge")
    return "   ".join(parts)
