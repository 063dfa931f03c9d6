"""The two questions of a comparison: which candidate has the smaller largest distance, and the smaller expected one.

An executed distance bounds d* from below, and is a fact. A certificate bounds it from above. If the bound of one
candidate is at most an executed distance of another, it has the smaller d*. So the candidate that seems worse is
executed only until its fact is large enough, and the better one only until its bound is at most this fact.

The threshold of the bound changes with the facts. This costs no confidence: the bounds are probabilities given all
executions so far, whatever rule chose them and whenever the comparison stops.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.choices import Choice
from ctxval.campaign.dynamics import NEAR
from ctxval.campaign.suite_intervals import interval_search
from ctxval.certificates import CertificateOptions, judge
from ctxval.certificates.automatic import Automatic
from ctxval.certificates.bounds import ERRORS
from ctxval.certificates.difference import MeanDifference, PairedDifferences, mean_difference
from ctxval.certificates.limits import LIMITS
from ctxval.core.trial import Trial
from ctxval.studies.comparison.candidates import Candidate, ComparisonNote, Decision, Executions
from ctxval.studies.comparison.result import PairResult


@dataclass(eq=False)
class WorstQuestion:
    """Decides which candidates have the smaller d*, and chooses the executions for it."""

    executions: Executions
    confidence: float
    budget: int
    insist: int = 3  # executions that the worse candidate may have beyond the better one, to come near its prediction

    def __post_init__(self) -> None:
        self.candidates = self.executions.candidates
        # A decision is false only if the bound of its smaller candidate is. The candidate that has the smallest d* can
        # cause no false decision, so the error is divided among all others.
        share = (1 - self.confidence) / max(1, len(self.candidates) - 1)
        self.options = CertificateOptions(Automatic(tests=0), 1 - share)

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """All decisions that no executed distance contradicts."""
        largest = {candidate.name: candidate.largest for candidate in self.candidates}
        decided = self.executions.decided.values()
        return tuple(decision for decision in decided if largest.get(decision.smaller, np.inf) <= decision.bound)

    @property
    def undecided(self) -> list[tuple[Candidate, Candidate]]:
        """The pairs that are not decided, each in both orders."""
        decided = {frozenset((decision.smaller, decision.larger)) for decision in self.decisions}
        return [(a, b) for a, b in permutations(self.candidates, 2) if frozenset((a.name, b.name)) not in decided]

    def step(self) -> bool:
        """Execute the task that is expected to decide first; return False if all pairs are decided."""
        while self.undecided:
            pairs = [pair for pair in self.undecided if any(each.recorder.has_tasks for each in pair)]
            if not pairs:  # all tasks of a suite were executed
                for candidate in self.candidates:
                    self._certified(candidate)
                return False
            expected = self._expected()
            better, worse = max(pairs, key=lambda p: expected[p[1].name][0] / max(expected[p[0].name][0], 1e-300))
            if self._needs_fact(better, worse, expected) and worse.recorder.has_tasks:
                value, task = expected[worse.name]
                points = np.array([trial.unit_point for trial in worse.recorder.trials])
                near = self.candidates[0].campaign.validation.space.near(NEAR)
                if task is None or (len(points) and np.abs(points - task).max(axis=1).min() <= near):
                    self._execute(worse, Choice())  # no new task: the choice of the search
                else:
                    self._execute(worse, Choice(task, "covering"), value)
                return True
            choice = interval_search(better.recorder, self.options, self.budget, worse.largest).choose()
            if choice is None and self._certified(better):
                continue
            self._execute(better if better.recorder.has_tasks else worse, choice or Choice())
            return True
        return False

    def pair(self, a: Candidate, b: Candidate) -> PairResult:
        """Return what is decided of a pair."""
        names = {a.name, b.name}
        for known in self.decisions:
            if {known.smaller, known.larger} == names:
                reason = (
                    f"d* of {known.smaller} is at most {known.bound:.4g} by the {known.certificate} bound, and an "
                    f"executed distance of {known.larger} is {known.distance:.4g}; decided after {known.executions} "
                    "executions"
                )
                return PairResult("worst", a.name, b.name, known.smaller, reason)
        reason = (
            f"the largest executed distances are {a.largest:.4g} ({a.name}) and {b.largest:.4g} ({b.name}), and no "
            "bound separates them"
        )
        return PairResult("worst", a.name, b.name, None, reason)

    def _expected(self) -> dict[str, tuple[float, Array | None]]:
        """Return, by name, the largest executed or predicted distance, and its task if it is predicted."""
        history = self.executions.history()
        expected: dict[str, tuple[float, Array | None]] = {}
        for candidate in self.candidates:
            highest = candidate.highest(history)
            noted = [pair for pair in candidate.noted if pair[1].question == "worst" and pair[1].predicted]
            raised = [(trial.distance or 0.0) / (note.predicted or 1.0) for trial, note in noted]
            # A prediction is used if one of the last executions that were to raise the largest distance came near it.
            trusted = len(raised) < self.insist or max(raised[-self.insist :]) >= LIMITS.tested
            value, task = highest if highest is not None and trusted else (0.0, None)
            expected[candidate.name] = (max(value, candidate.largest), task if value > candidate.largest else None)
        return expected

    def _needs_fact(self, better: Candidate, worse: Candidate, expected: dict[str, tuple[float, Array | None]]) -> bool:
        """Return whether the candidate that seems worse is executed, to raise its largest executed distance."""
        count, others = (
            sum(note.question == "worst" and note.shared is None for _, note in candidate.noted)
            for candidate in (worse, better)
        )
        # So far above that its bound is worth executions.
        if worse.largest <= 1.02 * max(better.largest, expected[better.name][0]):
            return count <= others  # neither is clearly worse: they are executed in turn
        return worse.largest < LIMITS.tested * expected[worse.name][0] and count < self.insist + others

    def _certified(self, better: Candidate) -> bool:
        """Keep all decisions by the certificate of a candidate; return whether there is a new one."""
        new = False
        for other in [worse for first, worse in self.undecided if first is better and worse.largest > better.largest]:
            # Nobody has stated this threshold to the campaign.
            known = better.campaign.provenance_for(self.options, other.largest)
            verdict = judge(better.campaign.trials, other.largest, self.options, known)
            if verdict.answer == "validated" and verdict.certificate is not None:
                names, certificate = (better.name, other.name), verdict.certificate
                bound, count = certificate.upper_bound + ERRORS * certificate.error, self.executions.count
                self.executions.decided[names] = Decision(*names, bound, other.largest, certificate.kind, count)
                new = True
        return new

    def _execute(self, candidate: Candidate, choice: Choice, predicted: float | None = None) -> None:
        note = ComparisonNote(self.executions.steps, "worst", predicted=predicted)
        predicts = interval_search(candidate.recorder, self.options, self.budget).predicts
        self.executions.execute(candidate, choice, note, predicts=predicts)


@dataclass(eq=False)
class MeanQuestion:
    """Decides which candidates have the smaller expected distance, and executes the draws for it.

    Each task is drawn from the distribution of tasks and executed with every candidate that is in an undecided pair.
    Before its draw, the distance of each candidate is predicted from all executions so far.
    """

    executions: Executions
    confidence: float
    seed: int

    def __post_init__(self) -> None:
        self.candidates = self.executions.candidates

    def draws_of(self, candidate: Candidate) -> dict[int, tuple[Trial, ComparisonNote]]:
        """Return the trials of the draws that have ended, by the number of the draw."""
        ended = [(trial, note) for trial, note in candidate.noted if trial.state != "open"]
        return {note.draw: (trial, note) for trial, note in ended if note.draw is not None}

    def step(self, left: int) -> bool:
        """Execute the next draw with one candidate; return False if there is nothing to execute."""
        pairs = combinations(self.candidates, 2)
        undecided = [pair for pair in pairs if not self._difference(*pair).sign and not self._lost(*pair)]
        active = [candidate for candidate in self.candidates if any(candidate in pair for pair in undecided)]
        if not active:
            return False
        draws = [self.draws_of(candidate) for candidate in self.candidates]
        draw = last = max((draw for drawn in draws for draw in drawn), default=0)
        waiting = [candidate for candidate in active if draw not in self.draws_of(candidate)]
        if not waiting:
            draw, waiting = draw + 1, active
        # The number of executions that the last draw took; that of all candidates if there was none.
        usual = sum(drawn[last][1].shared is None for drawn in draws if last in drawn) or len(active)
        if len(waiting) == len(active) and left < min(len(active), usual):
            return False
        candidate = waiting[0]
        # The draw depends on all models, so that a model that is learned again with the draws is not judged by them; a
        # number identifies the random stream, which is none of those of trials.
        models = [candidate.recorder.draws.of_model() for candidate in self.candidates]
        rng = np.random.default_rng([self.seed, draw, 0x6472, *models])
        space = candidate.campaign.validation.space
        point = np.asarray(space.rounded(space.unit_draws(1, rng)[0]))
        note = self.executions.predicted(candidate, ComparisonNote(self.executions.steps, "mean", draw), point)
        self.executions.execute(candidate, Choice(point, "iid"), note, predicts=False)
        return True

    def pair(self, a: Candidate, b: Candidate) -> PairResult:
        """Return what is decided of a pair."""
        mean = self._difference(a, b)
        smaller = (b.name if mean.sign > 0 else a.name) if mean.sign else None
        reason = (
            f"the expected distance of {a.name} minus that of {b.name} is between {mean.low:.3g} and {mean.high:.3g}; "
            f"decided after {mean.decided_after} tasks"
        )
        if smaller is None:
            undecided = f"after {mean.tasks} tasks the confidence sequence of the difference contains 0"
            reason = self._lost(a, b) or undecided
        interval = mean.estimate, mean.low, mean.high, mean.tasks, mean.variance_left
        return PairResult("mean", a.name, b.name, smaller, reason, *interval)

    def _difference(self, a: Candidate, b: Candidate) -> MeanDifference:
        """Return the difference by the draws that both have, up to the first one without a usable distance."""
        first, second = self.draws_of(a), self.draws_of(b)
        values, predicted, count = [], [], len(self.candidates)
        for draw in sorted(first.keys() & second.keys()):
            x, y = self._measured(*first[draw]), self._measured(*second[draw])
            if x is None or y is None:
                break
            values.append(x[0] - y[0])
            predicted.append(x[1] - y[1])
        paired = PairedDifferences(np.array(values), np.array(predicted), self.executions.most)
        return mean_difference(paired, (1 - self.confidence) / (count * (count - 1) / 2))

    def _measured(self, trial: Trial, note: ComparisonNote) -> tuple[float, float] | None:
        """Return the distance of a draw, and its prediction minus its mean; None if there is no distance."""
        distance = self.executions.most if trial.state == "failed" else trial.distance
        if distance is None:
            return None
        return distance, 0.0 if note.predicted is None or note.centre is None else note.predicted - note.centre

    def _lost(self, *pair: Candidate) -> str | None:
        """Return why the difference of a pair cannot be known any more; None if it can."""
        for candidate in pair:
            for trial, note in self.draws_of(candidate).values():
                if self._measured(trial, note) is None:
                    return (
                        f"trial {trial.number} of {candidate.name} has no distance, so the expected distance is not "
                        "known; with a stated largest possible distance, a failure would count as that"
                    )
        return None
