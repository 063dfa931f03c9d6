"""The envelope of a campaign: on which tasks d stays below a threshold, and which execution would enlarge it most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval import learning
from ctxval._util.arrays import Array
from ctxval._util.progress import advance, stage
from ctxval._util.texts import reason_of
from ctxval.campaign.choices import Choice
from ctxval.campaign.dynamics import NEAR
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.campaign.thinking import TimeShortage
from ctxval.campaign.trials import TrialRecorder
from ctxval.certificates.automatic import Automatic, WholeSuite
from ctxval.certificates.drawn_distances import DrawnDistances
from ctxval.certificates.dynamics import Dynamics, draws_for
from ctxval.certificates.envelope import (
    ENVELOPE,
    Envelope,
    boundary_tasks,
    doubt_of_envelope,
    envelope_of,
    must_outlive_a_test,
    withdrawn,
)
from ctxval.certificates.evidence import Evidence
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.options import CertificateOptions
from ctxval.certificates.prediction_tests import DRAWN
from ctxval.certificates.predictions import CheckedPrediction, missing_tests
from ctxval.certificates.sample import without_success
from ctxval.certificates.sentences.statements import EXECUTED_AGAIN, whole_suite_statement
from ctxval.core.target import LARGEST_DISTANCE
from ctxval.core.task_suite import TaskSuite
from ctxval.core.trial import Trial, Trials
from ctxval.errors import InputError

if TYPE_CHECKING:
    from ctxval.learning import Costs, LearnedDynamics, Ledger, Thinking


@dataclass(frozen=True)
class CandidateSettings:
    """How many tasks the next one is chosen from."""

    candidates: int = 8192  #: tasks among which these are chosen
    screened: int = 256  #: tasks of the pool among which the next one is chosen
    boundary: int = 512  #: tasks next to the boundary at which closed loops are run, in each of several rounds
    checks: int = 256  #: further tasks that check the interpolation between all these
    noisy: tuple[int, int, int] = (192, 64, 64)  #: pool, boundary and checks if each draw has sequences of noise


CANDIDATES = CandidateSettings()
"""The settings in use."""


_SAME_TASK = 1e-6


@dataclass(frozen=True)
class TaskCounts:
    """Numbers of tasks whose closed loops are run on all draws."""

    pool: int  #: spread over the task space; the executed tasks come with them
    boundary: tuple[int, ...] = ()  #: next to the boundary of the envelope, in rounds
    checks: int = 0  #: that check the interpolation

    @property
    def tasks(self) -> int:
        """The number of all tasks, with those outside of the interpolated set."""
        return self.pool + sum(self.boundary) + self.checks + (self.checks // 2 or ENVELOPE.others)

    def part(self, share: float) -> TaskCounts:
        """Return a share of all numbers."""
        pool, checks, *boundary = (round(share * each) for each in (self.pool, self.checks, *self.boundary))
        return TaskCounts(pool, tuple(boundary), checks)


class EnvelopeSearch:
    """Computes the envelope of the trials, and chooses executions that enlarge it.

    Args:
        interval: the search that leads to the verdict, with its threshold, options and tests.
    """

    def __init__(self, interval: IntervalSearch) -> None:
        kind = interval.options.kind
        if not isinstance(kind, Automatic | Dynamics | WholeSuite):
            raise InputError(f"an envelope needs one of the certificates auto and dynamics, got {kind.name!r}.")
        if kind.target.by_draws:
            raise InputError("an envelope tells which tasks stay below the threshold; leave the share out.")
        self._interval, self._recorder = interval, interval.recorder
        self._threshold, self._confidence = interval.limit, interval.options.confidence
        self._split: tuple[tuple[int, ...], LearnedDynamics | None] | None = None
        self._ledger = learning.Ledger()  # of the present choice or envelope; learning was taken from it before

    def envelope(self) -> Envelope:
        """Return the envelope that the executions give, or why there is none. The system is never executed."""
        space, trials = self._recorder.validation.space, self._recorder.trials.ended
        threshold, confidence = self._threshold, self._confidence
        if not self._recorder.has_tasks and isinstance(space, TaskSuite):
            return of_whole_suite(space, trials, threshold, confidence, self._recorder.validation.labels.units)
        unknown = next((trial for trial in without_success(trials) if trial.least <= threshold), None)
        if unknown is not None:
            why = f"trial {unknown.number} has no distance, so nothing is known of its task; execute it again"
            return withdrawn(space, threshold, confidence, why)
        dynamics = self._recorder.dynamics
        with stage("computing the envelope", unit="closed loops"), dynamics.deciding(trials) as (_, ledger, budget):
            self._begin(ledger, budget)
            if ledger.spent_up or ledger.incomplete:
                return self._without_time(ledger.incomplete)
            known = self._known(trials)
            if known is None:
                why = dynamics.failure or (
                    "no dynamics can be learned: there are no recorded trajectories, or M explains all of them, or no "
                    "controller can be designed"
                )
                return withdrawn(space, threshold, confidence, why)
            regular = self._regular(trials, known[1])
            if regular is None:
                return self._of(*known, trials)
            envelope = self._of(*regular, trials)
            if known[1].target.is_noisy:  # noise that the regular part does not have
                return envelope
            smooth = self._of(*known, trials)  # soft contacts can be learned
            return envelope if envelope.share > smooth.share else smooth

    def _begin(self, ledger: Ledger, budget: Thinking | None) -> None:
        """Begin a choice or an envelope with a budget, from which what was learned is taken."""
        costs = ledger.costs
        self._ledger = learning.Ledger(None if costs is None or budget is None else replace(costs, thinking=budget))
        for kind, seconds in ledger.expected.items():
            if kind != "loops":
                self._ledger.add(kind, seconds)
        self._ledger.replaced += ledger.replaced

    def _without_time(self, missing: float) -> Envelope:
        """Return an envelope that is not stated, as its budget lacks some seconds."""
        costs, ledger = self._ledger.costs, self._ledger
        assert costs is not None
        # With more time, more stages of learning may fit, and take it.
        needed = max(sum(ledger.expected.values()) + missing, costs.thinking.seconds)
        replaced = tuple(dict.fromkeys(ledger.replaced))
        shortage = TimeShortage(needed, costs.thinking.seconds, replaced, "the envelope")
        none = withdrawn(self._recorder.validation.space, self._threshold, self._confidence, str(shortage))
        return replace(none, thinking=shortage.to_json())

    def _of(self, learned: LearnedDynamics, evidence: Evidence, trials: Sequence[Trial]) -> Envelope:
        """Return the envelope of what was learned, or why there is none."""
        space, units = self._recorder.validation.space, self._recorder.validation.labels.units
        threshold, confidence = self._threshold, self._confidence
        # A failed execution whose distance exceeds the threshold by the steps before is outside, too.
        failed = without_success(trials)
        known = [trial for trial in trials if trial.distance is not None or trial in failed]
        executed = [(trial.unit_point, trial.least) for trial in known]
        try:
            if learned.split is not None:
                evidence = self._left_out(learned, evidence)
            if (doubt := doubt_of_envelope(evidence, threshold)) is not None:
                return withdrawn(space, threshold, confidence, doubt)
            if failed:
                predicted = learned.expected(Trials(failed).points(space.dimension))
                for trial, distance in zip(failed, predicted.tolist(), strict=True):
                    if distance <= threshold:
                        doubt = f"trial {trial.number} failed beyond the threshold, and the learned dynamics keep it"
                        return withdrawn(space, threshold, confidence, f"{doubt}; record more executions near its task")
            counts, missing = self._counts(learned, evidence)
            if missing:
                return self._without_time(missing)
            drawn, irregular = self._drawn(learned, evidence, counts), learned.split.irregular if learned.split else 0
            given = space, drawn, evidence, executed, threshold, confidence
            envelope = envelope_of(*given, partial(self._at, learned), counts.checks, units, irregular)
            replaced = list(dict.fromkeys(self._ledger.replaced))
            return replace(envelope, thinking={"replaced": replaced}) if replaced else envelope
        except Exception as error:  # users' parts, at states that no execution has reached
            return withdrawn(space, threshold, confidence, reason_of(error))

    def _regular(self, trials: Sequence[Trial], evidence: Evidence) -> tuple[LearnedDynamics, Evidence] | None:
        """Return what the regular transitions teach; None if all are regular, or if there is noise in them.

        It is left out if it does not fit into the budget: then contacts are learned with all other steps.
        """
        numbers = tuple(trial.number for trial in trials)
        if self._split is None or self._split[0] != numbers:
            tests = sum(each.is_test for each in evidence.predictions)
            if not self._ledger.optional(
                "learning", "the part of the dynamics that is smooth between contacts",
                lambda costs: 4 * costs.learning() + tests * (costs.posterior() + self._seconds(1)(costs)),
            ):  # fmt: skip
                return None
            try:
                self._split = numbers, self._recorder.dynamics.regular(trials)
            except Exception:  # users' parts
                self._split = numbers, None
        learned = self._split[1]
        if learned is None or learned.posterior.noise > LIMITS.noise:
            return None
        without = learned.posterior.covariances.without_model
        noise = learned.posterior.noise
        return learned, replace(evidence, target=LARGEST_DISTANCE, lags=0, noise=noise, without_model=without)

    def _left_out(self, learned: LearnedDynamics, evidence: Evidence) -> Evidence:
        """Return evidence with the tests alone, each predicted from all executions of other tasks.

        Nothing was predicted of a test whose run leaves what these have recorded.
        """
        most, tests = evidence.most_beyond, list[CheckedPrediction]()
        stored = [test for test in evidence.predictions if test.is_test]
        with stage("predicting each test without its own execution", len(stored), "tests"):
            for test in stored:
                point = np.array(test.point)
                same = np.flatnonzero((np.abs(learned.executed - point) <= _SAME_TASK).all(axis=1))
                others = learned.without(same.tolist())
                drawn = None if others is None else self._at(others, point[None])
                median = upper = np.inf
                if drawn is not None and drawn.known[0] and drawn.leaving(most)[0] <= 1:
                    median, upper = np.quantile(drawn.draws[:, 0], [0.5, 0.95]).tolist()
                at = test.point if np.isfinite(median) else ()
                tests.append(replace(test, median=median, upper=upper, quantiles=(), explained=None, point=at))
                advance()
        return replace(evidence, predictions=tuple(tests))

    def reserved(self) -> Choice | None:
        """Return a test if a distance exceeds the threshold, and the budget is just enough for the missing tests."""
        interval, recorder, trials = self._interval, self._recorder, self._recorder.trials.ended
        if interval.best <= self._threshold or not interval.predicts or not recorder.has_tasks:
            return None
        known = self._known(trials)
        if known is None or not 0 < self._left <= known[1].tests - _stored_tests(recorder, trials):
            return None
        return interval.test()

    def choose(self) -> Choice | None:
        """Return the next task that enlarges the envelope, or a test of it; None if it would hardly grow.

        The set grows where the mean is below the threshold and mean + k spread is not, and where closed loops leave the
        records. The larger of these two parts is worked on. Tests come last, when hardly anything is uncertain or the
        budget is just enough for them: those that are predicted by better dynamics raise k less.
        """
        interval, recorder, trials = self._interval, self._recorder, self._recorder.trials.ended
        if not interval.predicts or not recorder.has_tasks:
            return None
        if any(trial.least <= self._threshold for trial in without_success(trials)):
            return None
        with recorder.dynamics.thinking.deciding():
            budget = recorder.dynamics.thinking.after(trials)
        self._begin(recorder.dynamics.ledger(trials), budget)
        known = self._known(trials)
        if known is None:
            return None
        explained = all(known[1].explains(each, self._threshold) for each in known[1].predictions)
        regular = None if not known[1].target.is_noisy and explained else self._regular(trials, known[1])
        learned, evidence = regular or known
        missing = missing_tests(evidence.predictions, evidence.tests)
        if missing and self._left <= missing:
            return interval.test()
        parameter = evidence.unsampled_parameter
        if parameter is not None and parameter.gap > evidence.limits.gap:
            return Choice.tested(parameter.task)
        space, pool = recorder.validation.space, learned.study.search.pool
        screened = min(CANDIDATES.screened, len(pool))
        parts = [round(share * screened) for share in learned.study.settings.thinking.shares]
        replicates = 1 if learned.noisy is None else learned.noisy.replicates
        fitting = (part for part in parts if self._ledger.fits("loops", self._seconds(part, replicates)))
        drawn = self._at(learned, space.candidates(pool[: next(fitting, parts[-1])]), settled=False)
        below, leaving = drawn.mean <= self._threshold, drawn.uncovered(evidence.most_beyond)
        # Within three spreads above the mean, a task is uncertain.
        straddle = 3.0 * drawn.spread(self._threshold) - np.abs(drawn.mean - self._threshold)  # Bryan et al. 2006
        uncertain, uncovered = below & (straddle > 0), below & (leaving > 1)
        if drawn.crossed is not None:  # executions of these tasks would not teach the regular part
            uncertain, uncovered = uncertain & (drawn.crossed <= 0), uncovered & (drawn.crossed <= 0)
            straddle = np.where(drawn.crossed <= 0, straddle, -np.inf)
        few = evidence.executions < evidence.limits.fewest
        # Share of the tasks predicted below the threshold that may be uncertain or uncovered at the end.
        if few or (uncertain | uncovered).sum() > 0.03 * below.sum():
            score = straddle if uncertain.sum() >= uncovered.sum() else np.where(uncovered, leaving, -np.inf)
            executed = recorder.trials.points(space.dimension)
            away = np.abs(drawn.points[:, None] - executed).max(axis=2)
            new = (away > space.near(NEAR)).all(axis=1)
            if (np.isfinite(score) & new).any():
                return Choice.tested(drawn.points[int(np.where(new, score, -np.inf).argmax())])
        outlive = regular is None and must_outlive_a_test(drawn, evidence, self._threshold)
        return interval.test() if missing or outlive else None

    @property
    def _left(self) -> int:
        """The number of executions that the budget leaves."""
        recorder = self._recorder
        return self._interval.budget - recorder.trials.executions - len(recorder.trials.open)

    def _known(self, trials: Sequence[Trial]) -> tuple[LearnedDynamics, Evidence] | None:
        """Return what the executions teach, and what they say of the predictions."""
        dynamics = self._recorder.dynamics
        ledger = dynamics.ledger(trials)
        before = ledger.expected.get("loops", 0.0)
        learned, evidence = dynamics.learned(trials), dynamics.screening(trials)
        self._ledger.add("loops", ledger.expected.get("loops", 0.0) - before)
        if learned is None or evidence is None:
            return None
        noise, without = learned.drawn_from.noise, learned.posterior.covariances.without_model
        needed = evidence.needing(self._interval.tests)
        return learned, replace(needed, confidence=self._confidence, noise=noise, without_model=without)

    def _seconds(self, tasks: int, replicates: int = 1) -> Callable[[Costs], float]:
        """Return the seconds of the closed loops of so many tasks on all draws."""
        draws = draws_for(self._confidence)
        return lambda costs: costs.draws(20) + costs.plan(tasks) + costs.run(draws + 1, tasks, replicates)

    def _counts(self, learned: LearnedDynamics, evidence: Evidence) -> tuple[TaskCounts, float]:
        """Return the most tasks that fit into the budget, and the seconds that the fewest lack; 0 if they fit."""
        pool, space, executed = len(learned.study.search.pool), self._recorder.validation.space, len(learned.executed)
        counts, shares = TaskCounts(pool), learned.study.settings.thinking.shares
        if space.members is not None:
            shares = (1.0,)  # all tasks of a suite
        elif learned.study.planner.batched:  # else each further task costs a design of its own
            rounds = max(space.dimension // 2, 1)
            counts = TaskCounts(pool, (CANDIDATES.boundary,) * rounds, CANDIDATES.checks)
            if evidence.target.is_noisy:  # each draw has sequences of noise
                pool, boundary, checks = CANDIDATES.noisy
                counts = TaskCounts(min(len(learned.study.search.pool), pool), (boundary,), checks)
        replicates, missing = 1 if learned.noisy is None else learned.noisy.replicates, 0.0
        for share in shares:
            part = counts.part(share)
            seconds = self._seconds(part.tasks + executed, replicates)
            missing = self._ledger.seconds("loops", seconds)
            if self._ledger.fits("loops", seconds):
                if share < 1:
                    self._ledger.replaced.append(f"closed loops on {part.tasks} tasks in place of {counts.tasks}")
                return part, 0.0
        return counts, missing

    def _drawn(self, learned: LearnedDynamics, evidence: Evidence, counts: TaskCounts) -> DrawnDistances:
        """Return the drawn distances of the pool's tasks, of executed ones and of tasks next to the boundary."""
        pool, space = learned.study.search.pool, self._recorder.validation.space
        if space.members is not None:
            return self._at(learned, pool)
        drawn = self._at(learned, np.concatenate([pool[: counts.pool], learned.executed]))
        candidates = np.random.default_rng(1).random((CANDIDATES.candidates, space.dimension))
        for count in counts.boundary:
            nearest = boundary_tasks(drawn, evidence, self._threshold, self._confidence, candidates, count)
            drawn = drawn.and_others(self._at(learned, nearest))
        return drawn

    def _at(self, learned: LearnedDynamics, points: Array, *, settled: bool = True) -> DrawnDistances:
        draws = draws_for(self._confidence)
        values, beyond, away, crossed = learned.drawn_distances(points, draws, settled=settled)
        return DrawnDistances(points, values, beyond, away / LIMITS.region, crossed)


def of_whole_suite(
    suite: TaskSuite, trials: Sequence[Trial], threshold: float, confidence: float, units: str
) -> Envelope:
    """Return the envelope of a suite whose tasks were all executed: those whose distances keep the threshold."""
    largest = np.full(len(suite), -np.inf)
    for trial in trials:
        if (distance := trial.distance) is None and trial in without_success(trials):
            distance = np.inf  # of a failed execution
        row = int(suite.rows_at(trial.unit_point))
        largest[row] = max(largest[row], -np.inf if distance is None else distance)
    bounds = np.where((largest >= 0) & (largest <= threshold), largest, np.inf)
    names = tuple(name for name, bound in zip(suite.task_names, bounds, strict=True) if np.isfinite(bound))
    share, count = len(names) / len(suite), sum(trial.executed for trial in trials)
    numbers: dict[str, Any] = {"share": share, "tasks": names, "executions": count, "assumptions": (EXECUTED_AGAIN,)}
    statement = whole_suite_statement(len(names), len(suite), threshold, units)
    return Envelope(suite, threshold, confidence, statement, **numbers, units=units, _bounds=bounds)


def has_tests(recorder: TrialRecorder, options: CertificateOptions) -> bool:
    """Return whether the tests of an envelope were executed, so that it is worth computing; nothing is learned."""
    if not recorder.has_tasks:
        return True
    if not isinstance(options.kind, Automatic | Dynamics) or not recorder.search.uses_prediction:
        return False
    completed = recorder.trials.completed
    drawn = any(trial.origin in DRAWN for trial in completed)
    return drawn and _stored_tests(recorder, completed) >= options.kind.tests


def _stored_tests(recorder: TrialRecorder, trials: Sequence[Trial]) -> int:
    """Return the number of drawn trials with a prediction that was stored before their execution."""
    drawn = (trial for trial in trials if trial.origin in DRAWN)
    return sum(recorder.dynamics.stored_prediction(trial) is not None for trial in drawn)
