"""Which candidate has the smaller largest distance d*: executed facts against certified bounds.

An executed distance bounds d* from below, and is a fact. A certificate bounds it from above. If the bound of one
candidate is at most an executed distance of another, it has the smaller d*. So the candidate that seems worse is
executed only until its fact is large enough, and the better one only until its bound is at most this fact.

The threshold of the bound changes with the facts. This costs no confidence: the bounds are probabilities given all
executions so far, whatever rule chose them and whenever the comparison stops.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.choices import Choice
from ctxval.campaign.dynamics import NEAR
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.certificates import CertificateOptions
from ctxval.certificates.automatic import Automatic
from ctxval.certificates.bounds import ERRORS
from ctxval.certificates.dynamics_diagnostics import TESTED
from ctxval.comparison.candidates import Candidate, TrialNote
from ctxval.comparison.executions import Executions
from ctxval.comparison.predictions import Predictions

# So many more executions than the better candidate the worse one may have to come near its predicted largest one.
_INSIST = 3


@dataclass(frozen=True)
class WorstDecision:
    """A decision that one candidate has the smaller d*.

    Attributes:
        smaller, larger: the names of the candidates.
        bound: what d* of the smaller one is at most.
        distance: the executed distance of the larger one that this bound does not exceed.
        certificate: the kind of the certificate of the bound.
        executions: the number of executions of all candidates, when it was decided.
    """

    smaller: str
    larger: str
    bound: float
    distance: float
    certificate: str
    executions: int

    @classmethod
    def of(cls, kept: Mapping[str, Any]) -> WorstDecision | None:
        """Return the decision that a trial's note has; None if it is none."""
        try:
            names, bounds = (str(kept["smaller"]), str(kept["larger"])), (float(kept["bound"]), float(kept["distance"]))
            return cls(*names, *bounds, str(kept["certificate"]), int(kept["executions"]))
        except (KeyError, TypeError, ValueError):
            return None


@dataclass(eq=False)
class WorstQuestion:
    """Decides which candidates have the smaller d*, and chooses the executions for it."""

    executions: Executions
    predictions: Mapping[str, Predictions]
    confidence: float
    budget: int
    stochastic: bool = False
    _decided: dict[tuple[str, str], WorstDecision] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.executions.kept = self.kept
        for candidate in self.candidates:
            for trial in candidate.trials:
                for kept in (TrialNote.of(trial) or TrialNote(0, "worst")).decided:
                    decision = WorstDecision.of(kept)
                    if decision is not None:
                        self._decided[decision.smaller, decision.larger] = decision

    @property
    def candidates(self) -> Sequence[Candidate]:
        """All candidates."""
        return self.executions.candidates

    @property
    def options(self) -> CertificateOptions:
        """The certificate of one candidate.

        A decision is false only if the bound of its smaller candidate is. The candidate that has the smallest d* can
        cause no false decision, so the error is divided among all others.
        """
        share = (1 - self.confidence) / max(1, len(self.candidates) - 1)
        return CertificateOptions(Automatic(self.stochastic), 1 - share)

    @property
    def decisions(self) -> tuple[WorstDecision, ...]:
        """All decisions that no executed distance contradicts."""
        largest = {candidate.name: candidate.largest for candidate in self.candidates}
        return tuple(
            decision for decision in self._decided.values() if largest.get(decision.smaller, np.inf) <= decision.bound
        )

    @property
    def undecided(self) -> list[tuple[Candidate, Candidate]]:
        """The pairs that are not decided, each in both orders."""
        known = {frozenset((decision.smaller, decision.larger)) for decision in self.decisions}
        return [(a, b) for a, b in permutations(self.candidates, 2) if frozenset((a.name, b.name)) not in known]

    def step(self) -> bool:
        """Execute the task that is expected to decide first; return False if all pairs are decided."""
        while self.undecided:
            expected = self._expected()
            better, worse = max(
                self.undecided, key=lambda pair: expected[pair[1].name][0] / max(expected[pair[0].name][0], 1e-300)
            )
            if self._needs_fact(better, worse, expected):
                value, task = expected[worse.name]
                known = np.array([trial.unit_point for trial in worse.trials])
                if task is None or (len(known) and np.abs(known - task).max(axis=1).min() <= NEAR):
                    self._execute(worse, Choice())  # no new task: the choice of the search
                else:
                    self._execute(worse, Choice(task, "covering"), value)
                return True
            rule = IntervalSearch(better.recorder, self.options, self.budget, worse.largest)
            choice = rule.choose()
            if choice is None and self._certified(better):
                continue
            self._execute(better, choice or Choice())
            return True
        return False

    def _expected(self) -> dict[str, tuple[float, Array | None]]:
        """Return, for each candidate, the largest executed or predicted distance, and the task if it is predicted."""
        known = [(trial.unit_point, trajectory) for trial, trajectory in self.executions.history()]
        expected: dict[str, tuple[float, Array | None]] = {}
        for candidate in self.candidates:
            highest = self.predictions[candidate.name].highest(known)
            value, task = (0.0, None) if highest is None or not _trusted(candidate) else highest
            expected[candidate.name] = (max(value, candidate.largest), task if value > candidate.largest else None)
        return expected

    def _needs_fact(
        self, better: Candidate, worse: Candidate, expected: Mapping[str, tuple[float, Array | None]]
    ) -> bool:
        """Return whether the candidate that seems worse is executed, to raise its largest executed distance."""
        others = len(_worst_trials(better))
        # So far above that its bound is worth executions.
        if worse.largest <= 1.02 * max(better.largest, expected[better.name][0]):
            return len(_worst_trials(worse)) <= others  # neither is clearly worse: they are executed in turn
        untested = worse.largest < TESTED * expected[worse.name][0]
        insisted = len(_worst_trials(worse)) >= _INSIST + others
        return untested and not insisted

    def _certified(self, better: Candidate) -> bool:
        """Keep all decisions by the certificate of a candidate; return whether there is a new one."""
        above = [other for one, other in self.undecided if one is better and other.largest > max(better.largest, 0.0)]
        new = False
        for other in above:
            verdict = better.campaign.verdict(other.largest, certificate=self.options, progress=False)
            if verdict.answer == "validated" and verdict.certificate is not None:
                names, certificate = (better.name, other.name), verdict.certificate
                bound = certificate.upper_bound + ERRORS * certificate.error
                executions = self.executions.count
                self._decided[names] = WorstDecision(*names, bound, other.largest, certificate.kind, executions)
                new = True
        return new

    def _execute(self, candidate: Candidate, choice: Choice, predicted: float | None = None) -> None:
        note = TrialNote(self.executions.steps, "worst", predicted=predicted)
        rule = IntervalSearch(candidate.recorder, self.options, self.budget)
        self.executions.execute(candidate, choice, note, predicts=rule.predicts)

    def kept(self) -> tuple[dict[str, Any], ...]:
        """Return all decisions as the note of the next trial keeps them."""
        return tuple(dict(vars(decision)) for decision in self._decided.values())


def _trusted(candidate: Candidate) -> bool:
    """Return whether one of the last executions that were to raise the largest distance came near its prediction."""
    notes = [(TrialNote.of(trial), trial.distance) for trial in candidate.trials]
    raised = [
        (distance or 0.0) / note.predicted
        for note, distance in notes
        if note is not None and note.question == "worst" and note.predicted
    ]
    return len(raised) < _INSIST or max(raised[-_INSIST:]) >= TESTED


def _worst_trials(candidate: Candidate) -> list[TrialNote]:
    notes = [TrialNote.of(trial) for trial in candidate.trials]
    return [note for note in notes if note is not None and note.question == "worst" and note.shared is None]
