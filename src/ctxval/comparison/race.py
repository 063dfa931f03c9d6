"""The loop of a comparison: it executes the task that is expected to decide most, until all is decided."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import combinations
from typing import Literal

import numpy as np

from ctxval._util.checked import NonNegativeInt, PositiveFloat, PositiveInt, Probability, checked
from ctxval._util.progress import advance, stage
from ctxval.certificates.options import require_confidence
from ctxval.comparison.candidates import Candidate, Question, TrialNote, require_comparable
from ctxval.comparison.executions import Executions, OnTrial
from ctxval.comparison.expected import MeanQuestion
from ctxval.comparison.predictions import Predictions
from ctxval.comparison.result import CandidateResult, Comparison, PairResult
from ctxval.comparison.worst import WorstQuestion
from ctxval.core.task_distribution import distribution_text
from ctxval.core.trial import Trial
from ctxval.errors import InputError

Asked = Literal["worst", "mean", "both"]


@checked
class Race:
    """A comparison in progress. What it does next follows from the stores alone, so it can be interrupted.

    Its arguments are those of :func:`ctxval.compare`, with candidates that have campaigns.
    """

    def __init__(
        self,
        candidates: Sequence[Candidate],
        question: Asked,
        *,
        budget: PositiveInt,
        confidence: Probability,
        seed: NonNegativeInt,
        largest_possible: PositiveFloat | None = None,
        stochastic: bool = False,
        on_trial: OnTrial | None = None,
    ) -> None:
        if stochastic and question != "mean":
            raise InputError(
                f"question must be mean for a stochastic system, got {question!r}: an execution may have a larger "
                "distance than the largest expected one, so executed distances do not tell which d* is larger."
            )
        require_confidence(confidence)
        require_comparable({candidate.name: candidate.campaign.validation for candidate in candidates})
        self.questions: tuple[Question, ...] = ("worst", "mean") if question == "both" else (question,)
        self.candidates, self.budget, self.confidence = candidates, budget, confidence
        self.stochastic = stochastic
        self.executions = Executions(candidates, self._note_for, on_trial)
        predictions = {candidate.name: Predictions(candidate, seed) for candidate in candidates}
        each = 1 - (1 - confidence) / len(self.questions)
        self.worst = WorstQuestion(self.executions, predictions, each, budget, stochastic)
        self.mean = MeanQuestion(self.executions, predictions, each, seed, largest_possible)
        self._require_possible()

    def _note_for(self, candidate: Candidate, trial: Trial, note: TrialNote) -> TrialNote:
        if note.question == "mean":
            return self.mean.note_of(candidate, note, trial.unit_point)
        return replace(note, predicted=None)

    def run(self) -> Comparison:
        """Execute tasks until all pairs are decided or the budget is spent."""
        with ExitStack() as stack:
            for candidate in self.candidates:
                stack.enter_context(candidate.campaign.store.sole_writer())
            with stage("comparing", self.budget, "executions", done=self.executions.count):
                self.executions.resume()
                while self._step():
                    advance()
        return self.result()

    def _step(self) -> bool:
        """Execute one task; return False if nothing is left to do."""
        self._require_possible()
        left = self.budget - self.executions.count
        if left <= 0:
            return False
        worst = "worst" in self.questions and bool(self.worst.undecided)
        notes = [TrialNote.of(trial) for candidate in self.candidates for trial in candidate.executed]
        spent = sum(note is not None and note.question == "worst" for note in notes)
        last = "mean" not in self.questions
        # Share of the budget before the other question is answered.
        if worst and (last or spent < 0.5 * self.budget) and self.worst.step():
            return True
        if not last and self.mean.step(left):
            return True
        return worst and not last and self.worst.step()

    def _require_possible(self) -> None:
        """Check that no executed distance refutes the stated largest one, with which decisions would be false."""
        largest = max(candidate.largest for candidate in self.candidates)
        if self.mean.most is not None and largest > self.mean.most:
            raise InputError(f"largest_possible is {self.mean.most:g}, but a distance of {largest:.6g} was executed.")

    # Results

    def result(self) -> Comparison:
        """Return what is decided so far."""
        decide = {"worst": self._worst_pair, "mean": self._mean_pair}
        pairs = [decide[question](*pair) for question in self.questions for pair in combinations(self.candidates, 2)]
        return Comparison(
            tuple(map(self._candidate, self.candidates)),
            tuple(pairs),
            self.confidence,
            self.executions.count,
            self.budget,
            self.candidates[0].campaign.validation.labels.units,
            self._assumptions(),
        )

    def _candidate(self, candidate: Candidate) -> CandidateResult:
        worst = candidate.campaign.worst
        bounds = [decision.bound for decision in self.worst.decisions if decision.smaller == candidate.name]
        drawn = [trial.distance for trial, _ in self.mean.draws_of(candidate).values() if trial.distance is not None]
        return CandidateResult(
            candidate.name,
            len(candidate.executed),
            len(candidate.shared),
            len(candidate.campaign.failed),
            None if worst is None else worst.distance,
            None if worst is None else worst.parameters,
            min(bounds, default=None),
            len(drawn),
            float(np.mean(drawn)) if drawn else None,
        )

    def _worst_pair(self, a: Candidate, b: Candidate) -> PairResult:
        names = {a.name, b.name}
        decision = next((kept for kept in self.worst.decisions if {kept.smaller, kept.larger} == names), None)
        if decision is None:
            reason = (
                f"the largest executed distances are {a.largest:.4g} ({a.name}) and {b.largest:.4g} ({b.name}), and no "
                "bound separates them"
            )
            return PairResult("worst", a.name, b.name, None, reason)
        reason = (
            f"d* of {decision.smaller} is at most {decision.bound:.4g} by the {decision.certificate} bound, and an "
            f"executed distance of {decision.larger} is {decision.distance:.4g}; decided after {decision.executions} "
            "executions"
        )
        return PairResult("worst", a.name, b.name, decision.smaller, reason)

    def _mean_pair(self, a: Candidate, b: Candidate) -> PairResult:
        mean = self.mean.difference(a, b)
        smaller = None
        if mean.sign:
            smaller = b.name if mean.sign > 0 else a.name
            reason = (
                f"the expected distance of {a.name} minus that of {b.name} is between {mean.low:.3g} and "
                f"{mean.high:.3g}; decided after {mean.decided_after} tasks"
            )
        else:
            undecided = f"after {mean.tasks} tasks the confidence sequence of the difference contains 0"
            reason = self.mean.lost(a, b) or undecided
        interval = mean.estimate, mean.low, mean.high, mean.tasks, mean.variance_left
        return PairResult("mean", a.name, b.name, smaller, reason, *interval)

    def _assumptions(self) -> tuple[str, ...]:
        assumed = ["the candidates were fixed before the comparison, and the system does not change during it"]
        if "worst" in self.questions:
            assumed.append(
                f"each bound on d* holds with confidence {self.worst.options.confidence:.6g} under the prior that its "
                "certificate states (dynamics or posterior); it is a probability given the executions, so neither the "
                "changing threshold nor the time of stopping costs confidence"
            )
        if "mean" in self.questions:
            described = self.candidates[0].campaign.validation.space.distribution
            over = "uniform over the task space" if described is None else distribution_text(described.describe())
            assumed.append(f"tasks are independent draws ({over})")
            assumed.append(
                f"no distance can exceed {self.mean.most:g}; the decisions on expected distances are then valid for "
                "any number of tasks"
                if self.mean.most is not None
                else "no largest possible distance is stated, so the decisions on expected distances are exact only if "
                "corrected differences are symmetric about their mean, and asymptotic otherwise: rare large distances "
                "that were not drawn can make them wrong"
            )
        if self.stochastic:
            assumed.append("executions of one task may differ, and the questions are about expected distances of tasks")
        return tuple(assumed)
