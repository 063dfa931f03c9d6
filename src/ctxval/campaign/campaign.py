"""The campaign: the only object with a life."""

from __future__ import annotations

import concurrent.futures as cf
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.interrupts import Interrupts, kept_alive
from ctxval._util.texts import text_of
from ctxval.campaign import display
from ctxval.campaign.ledger import Ledger, OpenTrial
from ctxval.campaign.workers import Crew, Ended, crew
from ctxval.certificates import RESOLUTION, CertificateOptions, Provenance, StoppingRule, Verdict, judge
from ctxval.certificates.options import CONFIDENCE
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError, ExecutionError, InputError
from ctxval.gp.surrogate import Surrogate, fit_surrogate
from ctxval.plot import overview

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

__all__ = ["Campaign", "OpenTrial"]


class Campaign(Ledger):
    """A search for the worst task, with everything stored before and after each execution.

    The budget is a total: running again resumes, and a resumed campaign makes the choices that it would have made
    without the interruption.

    Args:
        validation: the map p -> d(p).
        search: chooses the tasks; GP-UCB as in the paper by default.
        store: file of the trials; in memory by default.
        seed: of the search's randomness, not negative.
        name: what the store calls the experiment.
        accept_change: why a difference from the experiment that the store was made by does not matter, or what was
            repaired on the system; it is kept in the store.
        remeasure: measure the distance of all stored executions anew, if the store has those of another distance.

    Raises:
        InputError: a value cannot be used.
        DistanceError: a stored execution cannot be measured anew; nothing is changed.
        StoreError: the store cannot be used, or was made by another experiment.
    """

    @property
    def worst(self) -> Trial | None:
        """The completed trial with the largest distance."""
        return max(self.completed, key=_distance, default=None)

    @property
    def estimate(self) -> float | None:
        """The search's estimate of d*: the largest distance, after discarding where the search discards (SD).

        Where the search repeats its tasks, the largest mean distance of a task that was executed that often.
        """
        ordered = sorted(self._heights(), reverse=True)
        discard = getattr(self.search, "discard", 0)
        return ordered[discard] if len(ordered) > discard else None

    def _heights(self) -> list[float]:
        times = getattr(self.search, "times", 1)
        if times == 1:
            return [_distance(trial) for trial in self.completed]
        tasks: dict[bytes, list[float]] = {}
        for trial in self.completed:
            tasks.setdefault(trial.unit_point.tobytes(), []).append(_distance(trial))
        return [float(np.mean(found)) for found in tasks.values() if len(found) >= times]

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
            retry_failures: how often it is repeated where the system itself failed.

        Raises:
            InputError: a value cannot be used, or the system cannot be sent to the workers.
            ModelError, DesignError, DistanceError: the task, the model or the distance cannot be used. What was
                executed is stored; running again goes on behind the trial that failed.
            CampaignError: the workers are gone.
        """

        def chosen() -> OpenTrial | None:
            return None if until is not None and until(self) else self._open(None, attempts=1)

        hands, patience = self._crew(workers, executor, timeout), _Patience(retries, retry_failures)
        if retry_failures and hands is None:
            raise InputError("retry_failures is for workers, an executor or a timeout, and none is given.")
        return self._carry_out(self._within(budget, chosen, budget if until is None else 0), hands, on_trial, patience)

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
        rule = StoppingRule(
            threshold,
            certificate or CertificateOptions.posterior(confidence, stochastic=stochastic, resolution=resolution),
        )

        def chosen() -> OpenTrial | None:
            now = rule.decide(self.trials, budget - self.executions)
            if now.decided:
                return None
            return self._open(None if now.next_point is None else (now.next_point, "covering"), attempts=1)

        hands = self._crew(workers, executor, timeout)
        return self._carry_out(self._within(budget, chosen, 0), hands, on_trial, _Patience())

    def _within(
        self, budget: int, chosen: Callable[[], OpenTrial | None], draws: int
    ) -> Callable[[int], OpenTrial | None]:
        """Return what is wanted, given how many executions are running: what was interrupted, then what is chosen."""
        _require_count("budget must be a positive integer", budget)
        self._planned = int(draws)  # how many independent draws there are to be; 0 if what is found ends them

        def wanted(running: int) -> OpenTrial | None:
            if self.executions + running >= budget:
                return None
            return self._reopen(self._again.popleft()) if self._again else chosen()

        return wanted

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
        _require_count("an audit needs a positive number of draws", draws)

        def wanted(running: int) -> OpenTrial | None:
            if self._again:
                return self._reopen(self._again.popleft())
            enough = sum(trial.origin == "iid" for trial in self._trials) >= draws
            return None if enough else self._open((self._draws.point(self._trials), "iid"), attempts=1)

        self._planned = int(draws)
        return self._carry_out(wanted, self._crew(workers, executor, timeout), on_trial, _Patience())

    def _crew(self, workers: int | None, executor: cf.Executor | None, timeout: float | None) -> Crew | None:
        system = self.validation.system
        if getattr(system, "manual", False):
            raise InputError(
                "this system is executed by people, not by run or audit: take tasks with ask and say what happened "
                "with tell, in Python or as `ctxval ask` and `ctxval tell`."
            )
        return crew(system, workers=workers, executor=executor, timeout=timeout)

    def _carry_out(
        self,
        wanted: Callable[[int], OpenTrial | None],
        hands: Crew | None,
        on_trial: Callable[[Trial], None] | None,
        patience: _Patience,
    ) -> Campaign:
        """Execute what is wanted, given how many executions are running, until nothing is."""
        with self.store.sole_writer(), Interrupts() as interrupts, kept_alive():
            self._refresh()
            if self.unmeasured:
                self.remeasure()
            self._again = deque(trial for trial in self._trials if trial.state == "open" and trial.attempts)
            try:
                if hands is None:
                    self._one_by_one(wanted, on_trial, interrupts)
                else:
                    _Together(self, hands, on_trial, patience).carry_out(wanted, interrupts)
            finally:
                self._executing.clear()
        return self

    def _one_by_one(
        self,
        wanted: Callable[[int], OpenTrial | None],
        on_trial: Callable[[Trial], None] | None,
        interrupts: Interrupts,
    ) -> None:
        while (opened := wanted(0)) is not None:
            with interrupts.shielded():
                self._execute(opened, on_trial)
            interrupts.raise_if_asked()

    def _execute(self, opened: OpenTrial, on_trial: Callable[[Trial], None] | None) -> None:
        started = time.perf_counter()
        try:
            trajectory = self.validation.execute(opened.plan)
        except ExecutionError as error:
            ended = self._close(opened.trial, failure=text_of(error), seconds=time.perf_counter() - started)
        else:
            ended = self._measure(opened, trajectory, time.perf_counter() - started)
        if on_trial is not None:
            on_trial(ended)

    # What a person sees

    def __repr__(self) -> str:
        return display.as_text(self)

    def _repr_html_(self) -> str:
        return display.as_html(self)

    def to_dataframe(self) -> DataFrame:
        """Return the trials as a table of pandas, one row for each.

        The columns are number, origin, state, one for each task parameter (``name[0], name[1], ...`` for a vector),
        distance, seconds, attempts and failure. A parameter that is called like another column, such as ``distance``,
        is in the column ``parameters.distance``. What is not known is missing.

        Raises:
            InputError: pandas is not installed.
        """
        return display.to_dataframe(self.trials, self.validation.space)

    def plot(self, *, units: str = "", ax: Axes | None = None) -> Axes:
        """Draw the surrogate over one task parameter, or else the distances in their order; return the axes.

        Args:
            units: the distance's.
            ax: matplotlib axes to draw into; new ones of ``matplotlib.pyplot`` by default.

        Raises:
            InputError: no distance is known.
        """
        return overview(self, units=units, ax=ax)


@dataclass(frozen=True)
class _Patience:
    """How often an execution is repeated: where the worker was lost, and where the system failed."""

    losses: int = 2
    failures: int = 0

    def __post_init__(self) -> None:
        for name, value in (("retries", self.losses), ("retry_failures", self.failures)):
            if not isinstance(value, int) or isinstance(value, bool) or value < 0:
                raise InputError(f"{name} must be an integer >= 0, got {value!r}.")


class _Together:
    """Many executions at a time, of one campaign."""

    def __init__(
        self, campaign: Campaign, hands: Crew, on_trial: Callable[[Trial], None] | None, patience: _Patience
    ) -> None:
        self.campaign, self.hands, self.on_trial, self.patience = campaign, hands, on_trial, patience
        self.running: dict[int, OpenTrial] = {}
        self.losses: Counter[int] = Counter()
        self.failures: Counter[int] = Counter()
        self.stopped: BaseException | None = None

    def carry_out(self, wanted: Callable[[int], OpenTrial | None], interrupts: Interrupts) -> None:
        """Keep the workers busy; whatever stops that, first wait for the executions that are running."""
        try:
            while True:
                self._start_wanted(wanted, interrupts)
                if not self.running:
                    break
                with interrupts.shielded():
                    self._take(self.hands.wait())
        finally:
            self.hands.close()
        if self.stopped is not None:
            raise self.stopped
        interrupts.raise_if_asked()

    def _start_wanted(self, wanted: Callable[[int], OpenTrial | None], interrupts: Interrupts) -> None:
        while self.stopped is None and not interrupts.asked and len(self.running) < self.hands.size:
            try:
                opened = wanted(len(self.running))
                if opened is None:
                    return
                self._start(opened)
            except (CtxvalError, KeyboardInterrupt) as error:
                self.stopped = error
                if self.running and isinstance(error, KeyboardInterrupt):
                    interrupts.announce()

    def _start(self, opened: OpenTrial) -> None:
        self.hands.start(opened.number, opened.plan)
        self.running[opened.number] = opened

    def _take(self, ended: Ended) -> None:
        opened = self.running.pop(ended.number)
        try:
            closed = self._closed(opened, ended)
        except CtxvalError as error:
            self.stopped = self.stopped or error
            return
        if closed is not None and self.on_trial is not None:
            self.on_trial(closed)

    def _closed(self, opened: OpenTrial, ended: Ended) -> Trial | None:
        """Store how an execution ended; None where it is repeated."""
        number, campaign = ended.number, self.campaign
        if ended.lost is not None:
            self.losses[number] += 1
            if self.losses[number] <= self.patience.losses:
                self._repeat(opened)
                return None
            reason = f"the worker was lost {self.losses[number]} times, at last: {ended.lost}"
            return campaign._close(opened.trial, failure=text_of(reason))
        failure = ended.failure or self._refused(opened, ended.trajectory)
        if failure is not None:
            self.failures[number] += 1
            if self.failures[number] <= self.patience.failures:
                self._repeat(opened)
                return None
            return campaign._close(opened.trial, failure=text_of(failure), seconds=ended.seconds)
        assert ended.trajectory is not None
        return campaign._measure(opened, ended.trajectory, ended.seconds)

    def _refused(self, opened: OpenTrial, trajectory: Trajectory | None) -> str | None:
        """Return why what a worker returned is no execution; None if it is one."""
        try:
            self.campaign.validation.require(opened.plan, trajectory)
        except (ExecutionError, InputError) as error:
            return str(error)
        return None

    def _repeat(self, opened: OpenTrial) -> None:
        if self.stopped is None:
            begun = self.campaign._begin_again(opened.trial)
            self._start(OpenTrial(begun, opened.plan))


def _require_count(sentence: str, count: object) -> None:
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise InputError(f"{sentence}, got {count!r}.")


def _distance(trial: Trial) -> float:
    assert trial.distance is not None  # completed trials have one
    return trial.distance
