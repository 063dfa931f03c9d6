"""What to execute next, or that it is enough: the interval from the largest executed distance to a bound on d*.

Each choice narrows the interval, until a threshold lies outside of it or, without a threshold, until it is narrow. If
trajectories teach the dynamics, the bound is that from learned dynamics. It needs executions where a draw of the
dynamics exceeds the limit, where states and inputs are not covered by records, and where predictions are tested. If no
dynamics can be learned, if most predictions fail, or if it decides earlier, it is the posterior bound of the distance.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval import learning
from ctxval._util.arrays import Array
from ctxval.campaign.choices import Choice
from ctxval.campaign.dynamics import NEAR
from ctxval.campaign.next_task import CandidateFilter, next_task
from ctxval.campaign.proposals import DesignContinuity, spread_tests
from ctxval.campaign.trials import TrialRecorder
from ctxval.certificates import CertificateOptions, Evidence, Sample, StoppingRule
from ctxval.certificates.anytime import AnytimeAudit
from ctxval.certificates.automatic import Automatic, WholeSuite
from ctxval.certificates.base import CertificateKind
from ctxval.certificates.bets import bets_against
from ctxval.certificates.bounds import Quantities
from ctxval.certificates.checks import Remedy, open_checks, remedies
from ctxval.certificates.covering import RESOLUTION, covering
from ctxval.certificates.dynamics import Dynamics, certify_dynamics
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.options import WITHIN
from ctxval.certificates.posterior import DistanceBound
from ctxval.certificates.prediction_tests import DRAWN, MANY, TESTS
from ctxval.certificates.predictions import missing_tests, mostly_fail
from ctxval.certificates.task_share import bet_on
from ctxval.certificates.verdict import counterexample, require_possible
from ctxval.core.target import Target
from ctxval.core.trial import Trial, Trials
from ctxval.core.trial_note import NO_NOTE, TrialNote
from ctxval.errors import CertificateError, InputError

if TYPE_CHECKING:
    from ctxval.learning import LearnedDynamics


@dataclass(frozen=True)
class SearchSettings:
    """How tests are chosen, and of what a choice warns."""

    hypercubes: int = 128  #: from which the one that is executed is chosen
    above: float = 10.0  #: expected number of random tasks above the threshold, of which one is executed, at the share
    far: float = 10.0  #: multiple of what is known or allowed from which a predicted distance is said to be dangerous


SEARCH = SearchSettings()
"""The settings in use."""


@dataclass(frozen=True, eq=False)
class IntervalSearch:
    """Chooses the next task until the interval of d* decides."""

    recorder: TrialRecorder
    options: CertificateOptions  #: the certificate that bounds d*: ``auto``, ``dynamics``, ``posterior`` or ``anytime``
    budget: int  #: the largest total number of executions
    threshold: float | None = None  #: tau, in the distance's units; None if there is none
    #: without a threshold, the share by which the bound may exceed the largest executed distance at the end
    within: float = WITHIN
    keeps: bool = True  #: whether the store keeps the evidence that may decide

    def __post_init__(self) -> None:
        require_decisive(self.options)
        require_possible(self.options.kind, self.recorder.validation.space)
        if self.threshold is None and isinstance(self.options.kind, AnytimeAudit):
            raise InputError("an anytime audit ends by its threshold; state one, or run another certificate.")
        self.options.kind.require_usable(self.options.confidence, self.budget)
        self.recorder.dynamics.ask_of(self._target)

    @property
    def limit(self) -> float:
        """The value that the bound must not exceed at the end: the threshold, or a little more than was executed."""
        if self.threshold is not None:
            return self.threshold
        learned = self.recorder.dynamics.learned(self.recorder.trials) if self.predicts else None
        if learned is None:
            return (1 + self.within) * self._target.reached(self.best, lambda: 0.0)
        least = max(self.best, learned.negligible)
        return (1 + self.within) * self._target.reached(least, lambda: learned.worst_of_mean.highest)

    @property
    def best(self) -> float:
        """The largest executed distance; 0 if none is known."""
        return self.recorder.trials.largest

    @property
    def tests(self) -> int:
        """The number of tests that the certificate needs."""
        return self.options.kind.tests if isinstance(self.options.kind, Automatic | Dynamics) else 0

    @property
    def predicts(self) -> bool:
        """Whether learned dynamics choose the tasks, and each execution is predicted beforehand."""
        kind = self.options.kind
        if isinstance(kind, Automatic) and kind.resolution == RESOLUTION:
            # Another search was chosen for its tasks: they are not replaced.
            return self.recorder.search.uses_prediction
        return isinstance(kind, Dynamics)

    @property
    def interval(self) -> tuple[float, float | None]:
        """What the bound must reach, and the bound that a few posterior samples give; None if they give none.

        The former is the largest executed distance or, of a share of the tasks, its distance on the posterior mean.
        """
        evidence = self._evidence()
        if evidence is None:
            return self.best, None
        return self._target.reached(self.best, lambda: evidence.highest), evidence.bound

    @property
    def is_falsified(self) -> bool:
        """Whether the executed distances falsify the limit; of a noisy system, one above it may not suffice."""
        known, confidence = Quantities(space=self.recorder.validation.space), self.options.confidence
        return counterexample(self.recorder.trials, self.limit, known, confidence, self._target) is not None

    def choose(self) -> Choice | None:
        """Return the next task; None if the interval decides, or no task of a suite is left."""
        trials = self.recorder.trials
        if not self.recorder.has_tasks:
            return None
        if self.recorder.predicts:  # what only reads a store chooses as the stored speed allows
            self.recorder.dynamics.thinking.measure(trials)
        if self.threshold is not None and any(trial.least > self.threshold for trial in trials):
            repeated = self._against_noise()
            if repeated is not None or self.is_falsified:
                return repeated
        if isinstance(self.options.kind, AnytimeAudit):
            return self._by_audit(self.options.kind)
        # The next test, if the last one held and more are missing: nothing needs to be searched for that.
        if self.tests and self.predicts and trials and trials == trials.completed and trials[-1].origin in DRAWN:
            predictions = self.recorder.dynamics.checked(trials)
            if predictions and predictions[-1].held(self.best) and missing_tests(predictions, self.tests):
                return self.test()
        if self._repeats_suffice():
            return None
        evidence = self._evidence()
        return self._by_distance() if evidence is None or self._fails(evidence) else self._by_dynamics(evidence)

    def _repeats_suffice(self) -> bool:
        """Return whether repeated executions of each task keep the limit; in a box, no task is repeated for that."""
        return False

    def test(self) -> Choice:
        """Return the next task that tests predictions where nobody chose to look; see ``prediction_tests``."""
        trials = self.recorder.trials
        # A hypercube that was begun is completed, because what a part of it shows must not decide that it is left.
        number, row = divmod(spread_tests(trials), TESTS)
        if (self.tests >= MANY or self._target.by_draws) and not row:
            return Choice.tested(self.recorder.draw(), "iid")
        if row:
            begun = (trial.note.hypercube for trial in reversed(trials))
            (chosen, _), note = next(filter(None, begun), (0, 1.0)), NO_NOTE
        else:
            chosen, share = self._hypercube(number)
            note = TrialNote(hypercube=(chosen, share))
        return replace(Choice.tested(self.recorder.draws.hypercube(number, chosen)[row], "spread"), note=note)

    def _hypercube(self, number: int) -> tuple[int, float]:
        """Return which of many hypercubes the next tests are from, and the share of those that are like it.

        It is the first one with half of its tests where large distances are predicted, or with the most such tests:
        small distances hardly test the dynamics.
        """
        learned, needed = self.recorder.dynamics.learned(self.recorder.trials), min(self.tests, TESTS)
        if learned is None:
            return 0, 1.0
        tasks = np.stack([self.recorder.draws.hypercube(number, k)[:needed] for k in range(SEARCH.hypercubes)])
        is_large = (
            learned.near_pool(tasks.reshape(-1, tasks.shape[2])) >= LIMITS.leverage * learned.worst_of_mean.highest
        )
        large = is_large.reshape(tasks.shape[:2]).sum(axis=1)
        alike = large >= min((needed + 1) // 2, large.max())
        return int(alike.argmax()), float(alike.mean())

    # The choices, in the order in which they are tried

    def _against_noise(self) -> Choice | None:
        """Return a task whose execution tells whether noise explains a distance above the limit, if there is one."""
        if self._target.by_draws or not self.predicts:
            return None
        trials, quantile = self.recorder.trials, self._target.quantile
        bets = bets_against(trials, self.limit, quantile)
        if bets is not None and bets.falsify(self.options.confidence):
            return None
        learned = self.recorder.dynamics.learned(trials)
        is_noisy = learned is not None and learned.noisy is not None and learned.noisy.is_noisy
        worst = trials.worst
        if learned is None or worst is None or (bets is None and not is_noisy):
            return None  # but a threshold that noise was predicted to exceed is falsified by repetitions alone
        alike = (trial for trial in trials if trial.distance is not None or trial.state == "open")
        # Times that a noisy task is repeated in any case if its distance exceeds the limit.
        if sum(np.abs(trial.unit_point - worst.unit_point).max() <= 1e-9 for trial in alike) <= 2:
            return Choice.tested(worst.unit_point)
        if not is_noisy:
            return None
        tasks = [worst.unit_point, learned.worst_of_mean.local_maxima[0]]
        noises = [None if (predicted := learned.predict(task)) is None else predicted.noise for task in tasks]
        chances = [0.0 if noise is None else noise.chance_of_more(self.limit) for noise in noises]
        likeliest = int(np.argmax(chances))
        return Choice.tested(tasks[likeliest]) if chances[likeliest] > 1 - quantile else None

    def _by_audit(self, kind: AnytimeAudit) -> Choice | None:
        """Return the next independent draw of an anytime audit, which may end whenever its bound suffices."""
        ended = self.recorder.trials.ended
        if any(trial.origin == "iid" for trial in ended):
            certificate = kind.certify(replace(Sample.of(ended), threshold=self.limit), self.options.confidence)
            if certificate.covers(self.limit, self.options.left_out):
                return None
        return Choice(self.recorder.draw(), "iid", planned_draws=0)

    def _by_distance(self) -> Choice | None:
        """Return the task that the posterior bound of the distance needs; None if it decides."""
        kind = self._without_dynamics
        # It does not bound a share of the tasks, no distance is known, all are 0, or each task of a suite is executed.
        if not isinstance(kind, DistanceBound) or not self.limit > 0:
            return self.test() if self._target.by_draws and self.recorder.trials else Choice(planned_draws=0)
        rule = StoppingRule(self.limit, self.options.confidence, kind.resolution)
        now = rule.decide(self.recorder.trials, self.budget - self.recorder.trials.executions)
        if not now.decided:
            # Whether the task is steady is not tested if there is no time for closed loops.
            rejected = 0 if self.recorder.dynamics.has_no_time(self.recorder.trials) else None
            return Choice(now.next_point, "covering", planned_draws=0, rejected=rejected)
        asked, sample = self.options.kind, Sample.of(self.recorder.trials.ended)
        return self.test() if isinstance(asked, Automatic) and asked.missing_tests(sample) else None

    def _by_dynamics(self, evidence: Evidence) -> Choice | None:
        """Return the task that the learned dynamics need, or that the posterior bound needs; None if one decides."""
        kind, confidence = self.options.kind, self.options.confidence
        dynamics, trials = self.recorder.dynamics, self.recorder.trials
        # The whole evidence may decide if no check is open that a few draws show.
        decides = not open_checks(evidence)
        if decides and evidence.unvisited_region is None and dynamics.kept_evidence(trials, confidence) is None:
            learned = dynamics.learned(trials)
            evidence = evidence if learned is None else replace(evidence, unvisited_region=learned.unvisited_region)
            decides = not open_checks(evidence)
        if decides:
            whole = dynamics.evidence(trials, confidence, keep=self.keeps)
            if whole is None:
                return self._by_distance() if dynamics.shortage is None else self._if_time_is_short()
            evidence = self._asked(whole)
            with suppress(CertificateError):
                sample = replace(Sample.of(trials.ended), threshold=self.limit)
                if certify_dynamics(sample, evidence).covers(self.limit, self.options.left_out):
                    return None
        remedy = next(iter(self._usable(evidence)), Remedy())
        if remedy.kind == "again":
            return Choice.tested(remedy.tasks[0][0])
        if remedy.kind == "drawn above" and (above := self._above(self.limit)) is not None:
            return above
        # For `auto`, the posterior bound of the distance is tried after many executions, besides tests, that decided
        # nothing, and earlier if they cover the tasks, as they soon do in few dimensions.
        lacks_tests = remedy.kind == "drawn"
        by_distances = kind.without_dynamics(evidence.target, self.recorder.validation.space.members)
        if isinstance(by_distances, DistanceBound):
            chosen = sum(trial.origin not in DRAWN for trial in trials)
            in_places = any(opened.code in ("unvisited_region", "untested_rest") for opened in open_checks(evidence))
            if chosen >= 16 and not lacks_tests and not in_places:
                return self._by_distance()
            covers = not evidence.negligible and covering(self._points(trials), by_distances.resolution, 0) is not None
            if covers and self._by_distance() is None:
                return None
        ledger = dynamics.ledger(trials)
        ledger.charge("loops", lambda costs: costs.next_task())
        with ledger.spending("loops"):
            return self.test() if lacks_tests else self._by_evidence(evidence)

    def _if_time_is_short(self) -> Choice | None:
        """Return the choice if there is no time for the bound; more executions do not help."""
        return None

    def _usable(self, evidence: Evidence) -> list[Remedy]:
        """Return what the open checks need that an execution can close."""
        found = remedies(evidence, len(self._known))
        return [each for each in found if "drawn" in each.kind or len(each.tasks)]

    def _above(self, threshold: float) -> Choice | None:
        """Return one of new random tasks whose predicted distance exceeds a threshold, for a bet; None without one."""
        recorder, trials = self.recorder, self.recorder.trials
        learned = recorder.dynamics.learned(trials)
        if learned is None or not isinstance(learned.search, learning.ShareSearch):
            return None
        tasks = recorder.draws.many(trials, round(SEARCH.above / (1 - self._target.share)))
        rows = np.flatnonzero(learned.expected(tasks) > threshold)
        if not len(rows):
            return None
        # The first of the tasks, which are in no order.
        stake = bet_on(learned.search.share_above(learned.drawn_from, threshold), self._target.share)
        note = TrialNote(predicted_above=(float(threshold), len(rows) / len(tasks), stake))
        return replace(Choice.tested(tasks[rows[0]]), note=note)

    def _by_evidence(self, evidence: Evidence) -> Choice:
        """Return the first new task that the open checks need."""
        trials, known, waiting = self.recorder.trials, self._known, self._points(self.recorder.trials.open)
        learned = self.recorder.dynamics.learned(trials)
        steady = DesignContinuity(self.recorder.dynamics.study.planner, None if learned is None else learned.expected)
        new = CandidateFilter(self._near, steady, *self._moving(learned))
        point = next_task(evidence, known, new)
        if len(waiting) and (point is None or np.abs(waiting - point)[:, new.seen].max(axis=1).min() <= NEAR):
            # It is being executed already. Another worker prepares for the results that are expected.
            best, limit = self.best, self.limit
            if learned is not None:
                expected = learned.expected(waiting)
                best = max(best, float(expected[np.isfinite(expected)].max(initial=0.0)))
                limit = (1 + self.within) * best if self.threshold is None else limit
            after = self.recorder.dynamics.screening(trials, pending=True)
            after = evidence if after is None else self._asked(after)
            known = self._points([*trials, *trials.in_state("failed")])
            point = next_task(replace(after, best=best, threshold=limit), known, new)
        return Choice(point, "covering", planned_draws=0, rejected=steady.rejected)

    # What is known

    def _evidence(self) -> Evidence | None:
        """Return what the store keeps, or what a few posterior samples say; None if the certificate uses neither."""
        trials, dynamics = self.recorder.trials, self.recorder.dynamics
        if not self.predicts:
            return None
        evidence = dynamics.kept_evidence(trials, self.options.confidence) or dynamics.screening(trials)
        return None if evidence is None else self._asked(evidence)

    def _asked(self, evidence: Evidence) -> Evidence:
        """Return evidence with the question that it shall answer."""
        needed, confidence = evidence.needing(self.tests), self.options.confidence
        return replace(needed, best=self.best, confidence=confidence, threshold=self.limit)

    @property
    def _known(self) -> Array:
        """The tasks that are not executed without a reason: ended ones, and failed ones twice.

        A start may jump next to a failed one.
        """
        trials = self.recorder.trials
        return self._points([*trials.ended, *trials.in_state("failed")])

    def _fails(self, evidence: Evidence) -> bool:
        """Return whether predictions fail so often that the dynamics cannot be learned."""
        # Earlier predictions may have failed before it was known that a history, noise or dry friction matters.
        known_since = evidence.target.is_noisy or evidence.lags > 0 or evidence.friction
        if known_since or isinstance(self.options.kind, Dynamics):
            return False
        bound = evidence.upper
        tolerated = max(min(bound, self.limit), self.limit - bound)  # as far as the margin to the limit allows
        return mostly_fail([prediction.held(tolerated) for prediction in evidence.predictions])

    @property
    def _target(self) -> Target:
        return self.options.kind.target

    @property
    def _without_dynamics(self) -> CertificateKind:
        """The kind that judges by distances alone."""
        return self.options.kind.without_dynamics(self._target, self.recorder.validation.space.members)

    def _moving(self, learned: LearnedDynamics | None) -> tuple[Any, ...]:
        """Return how new tasks are moved: those that differ only in parameters that change no prediction are one."""
        return () if learned is None else (learned.spread_unseen, learned.seen_parameters, learned.at_untested_rest)

    def _points(self, trials: Iterable[Trial]) -> Array:
        return Trials(trials).points(self.recorder.validation.space.dimension)

    @property
    def _near(self) -> float:
        """The largest change of each coordinate to a task that is no new one."""
        # A distance with kinks may be large in a few tasks only, which are next to others where it is 0.
        kinked = learning.is_kinked(self.recorder.validation.distance)
        return self.recorder.validation.space.near(0.1 * NEAR if kinked else NEAR)


def is_decisive(options: CertificateOptions) -> bool:
    """Return whether executions can be chosen for a certificate."""
    return isinstance(options.kind, Automatic | Dynamics | DistanceBound | AnytimeAudit | WholeSuite)


def require_decisive(options: CertificateOptions) -> None:
    """Refuse a certificate for which no executions can be chosen."""
    kind = options.kind
    if not is_decisive(options):
        raise InputError(
            "a campaign that decides needs one of the certificates auto, dynamics, posterior, anytime and suite, got "
            f"{kind.name!r}; --explore (explore=True in Python) executes the tasks of the search."
        )
    if isinstance(kind, AnytimeAudit) and not options.volume:
        raise InputError("a verdict by an anytime audit needs the volume that may exceed the threshold.")
