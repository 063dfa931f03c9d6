"""What to execute next in a suite of tasks, which are executed one by one, and the entry for all task spaces."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ctxval.campaign.choices import Choice
from ctxval.campaign.interval_search import SEARCH, IntervalSearch, is_decisive
from ctxval.campaign.proposals import spread_tests
from ctxval.campaign.trials import TrialRecorder
from ctxval.certificates import CertificateOptions, Evidence, Learned, Sample, Verdict
from ctxval.certificates.automatic import Automatic, WholeSuite
from ctxval.certificates.bounds import with_units
from ctxval.certificates.checks import Remedy
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.options import WITHIN
from ctxval.certificates.prediction_tests import TESTS
from ctxval.certificates.remaining import RemainingTasks
from ctxval.errors import CertificateError

if TYPE_CHECKING:
    from ctxval.learning import LearnedDynamics


class SuiteIntervalSearch(IntervalSearch):
    """Chooses the next task of a suite. None is executed again, but as often as the suite repeats its tasks."""

    def test(self) -> Choice:
        """Return the next task that tests predictions."""
        number, row = divmod(spread_tests(self.recorder.trials), TESTS)
        return Choice.tested(self.recorder.draws.hypercube(number)[row], "spread")

    def _repeats_suffice(self) -> bool:
        """Return whether the tasks of a suite were executed so often that a quantile of each keeps the limit."""
        space, trials = self.recorder.validation.space, self.recorder.trials.ended
        if space.repeats == 1 or not trials:
            return False
        sample = replace(Sample.of(trials), suite=space.members, repeats=space.repeats)
        with suppress(CertificateError):
            whole = WholeSuite(self.options.kind.quantile).certify(sample, self.options.confidence)
            return whole.covers(self.limit)
        return False

    def _against_noise(self) -> Choice | None:
        return None

    def _if_time_is_short(self) -> Choice | None:
        return self._by_distance()  # which ends if all tasks are executed

    def _usable(self, evidence: Evidence) -> list[Remedy]:
        return [each for each in super()._usable(evidence) if each.kind != "again"]

    def _moving(self, learned: LearnedDynamics | None) -> tuple[Any, ...]:
        return ()

    def _by_distance(self) -> Choice | None:
        kind = self._without_dynamics
        if isinstance(kind, WholeSuite) and isinstance(self.options.kind, Automatic):
            return self._by_law(kind)
        return super()._by_distance()

    def _by_law(self, kind: WholeSuite) -> Choice | None:
        """Return the task that a law of the distances of a suite needs; None if it decides, or learned dynamics may."""
        recorder, trials = self.recorder, self.recorder.trials
        searched = Choice(planned_draws=0)
        if trials.in_state("failed") or len(trials.ended) <= LIMITS.freedom or not self.limit > 0:
            return searched
        learned = Learned(suite=recorder.dynamics.runs_of_suite(trials))
        space = recorder.validation.space
        sample = replace(Sample.of(trials.ended), suite=space.members, repeats=space.repeats, learned=learned)
        left = RemainingTasks(sample, kind.tests)
        if not left.can_be_bounded:
            return searched
        if kind.certify(sample, self.options.confidence).covers(self.limit):
            decides = recorder.dynamics.evidence(trials, self.options.confidence, keep=self.keeps) is None
            return None if decides else searched
        row = left.next_row(self.limit)
        return (
            Choice.tested(recorder.draws.left(trials), "spread")
            if row is None
            else Choice.tested(left.sample.members[row])
        )


def interval_search(
    recorder: TrialRecorder,
    options: CertificateOptions,
    budget: int,
    threshold: float | None = None,
    within: float = WITHIN,
    *,
    keeps: bool = True,
) -> IntervalSearch:
    """Return the choices of a campaign for its task space; the arguments are those of :class:`IntervalSearch`."""
    kind = IntervalSearch if recorder.validation.space.members is None else SuiteIntervalSearch
    return kind(recorder, options, budget, threshold, within, keeps)


def with_next_task(verdict: Verdict, recorder: TrialRecorder, options: CertificateOptions) -> Verdict:
    """Return a verdict; if it is undecided and learned dynamics choose the next task, with this task."""
    if verdict.answer != "undecided" or recorder.trials.in_state("failed") or not is_decisive(options):
        return verdict
    search = interval_search(recorder, options, recorder.trials.executions + 1, verdict.threshold, keeps=False)
    evidence = search._evidence()
    choice = None if evidence is None or search._fails(evidence) else search.choose()
    if choice is None or choice.unit_point is None:
        return verdict
    space = recorder.validation.space
    point = space.from_unit(space.rounded(choice.unit_point))
    task, learned = with_units(space.labelled(point)), recorder.dynamics.learned(recorder.trials)
    far = SEARCH.far * max(search.best, search.limit)
    if learned is not None and not learned.expected(choice.unit_point[None])[0] <= far:
        task = f"(caution: its predicted run goes far beyond all others; be ready to stop it) {task}"
    reason = f"{verdict.reason.removesuffix('.')}; next task: {task}."
    return replace(verdict, reason=reason, next_task=space.describe_point(point))
