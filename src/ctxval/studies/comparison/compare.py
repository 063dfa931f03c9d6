"""``ctxval.compare``: which of several models, controllers or distances is better on one system."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from ctxval._util.checked import NonNegativeInt, PositiveFloat, PositiveInt, Probability, checked, require
from ctxval._util.progress import advance, progress_shown, stage
from ctxval.campaign.campaign import Campaign
from ctxval.certificates.options import CONFIDENCE, Confidence
from ctxval.core.experiment import Experiment
from ctxval.core.task_distribution import distribution_text
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.searches import Auto
from ctxval.studies.comparison.candidates import Candidate, Executions, OnTrial, Question, require_comparable
from ctxval.studies.comparison.questions import MeanQuestion, WorstQuestion
from ctxval.studies.comparison.result import CandidateResult, Comparison

BUDGET = 100  #: default of the largest number of executions

Compared = Validation | Experiment | Campaign


@checked
def compare(
    candidates: Mapping[str, Compared],
    *,
    question: Literal["worst", "mean", "both"] = "both",
    budget: PositiveInt = BUDGET,
    confidence: Probability = CONFIDENCE,
    seed: NonNegativeInt = 0,
    stores: str | Path | None = None,
    largest_possible: PositiveFloat | None = None,
    stochastic: bool = False,
    on_trial: OnTrial | None = None,
    progress: bool | None = None,
) -> Comparison:
    """Compare models, controllers or distances on one system, with as few executions of it as possible.

    Two questions can be asked: which candidate has the smaller largest distance d*, and which has the smaller expected
    distance over the distribution of tasks of the task space. The comparison stops when all pairs are decided, or when
    the budget is spent. It can be interrupted, and continues from the stores.

    An execution counts once, and is recorded for all candidates whose controllers would have given the same inputs.
    All executions teach the dynamics of the system to all candidates.

    Args:
        candidates: the candidates by name. They must have the same system and the same tasks. A campaign keeps its
            search and its store.
        question: ``worst`` for d*, ``mean`` for the expected distance, or ``both``; for a suite of tasks, which has no
            random draws, ``both`` is ``worst``.
        budget: the largest total number of executions, including earlier ones in the stores.
        confidence: the probability with which all decisions hold together; it is divided between pairs and questions.
        stores: the folder of the stores, one for each candidate; in memory by default.
        largest_possible: a number that no distance can exceed, if one is known. Decisions on expected distances are
            then valid for any number of tasks; otherwise they are asymptotic. A failed execution counts as this
            distance.
        stochastic: whether two executions of one task may differ; then only the question ``mean`` can be asked.
        on_trial: called with the name of the candidate and each trial that has ended.
        progress: whether to show the progress on standard error; None to show it at a terminal and in a notebook.

    Raises:
        InputError: if the question does not fit a stochastic system or a suite.
    """
    if stochastic and question != "mean":
        raise InputError(
            f"question must be mean for a stochastic system, got {question!r}: an execution may have a larger "
            "distance than the largest expected one, so executed distances do not tell which d* is larger."
        )
    require("confidence", Confidence, confidence)

    def campaign(name: str, compared: Compared) -> Campaign:
        if isinstance(compared, Campaign):
            return compared
        validation = compared.validation if isinstance(compared, Experiment) else compared
        path = None if stores is None else Path(stores) / f"{store_name(name)}.sqlite"
        return Campaign(validation, search=Auto(thinking="fast"), store=path, seed=seed, name=name)

    made = [Candidate(str(name), campaign(str(name), compared), seed) for name, compared in candidates.items()]
    require_comparable({candidate.name: candidate.campaign.validation for candidate in made})
    possible: tuple[Question, ...] = ("worst", "mean")
    if made[0].campaign.validation.space.members is not None:
        possible = ("worst",)
    if question == "mean" and question not in possible:
        raise InputError("question must be worst for a suite of tasks, which has no random draws, got 'mean'.")
    questions: tuple[Question, ...] = possible if question == "both" else (question,)
    each = 1 - (1 - confidence) / len(questions)
    executions = Executions(made, largest_possible, on_trial or (lambda name, trial: None))
    worst, mean = WorstQuestion(executions, each, budget), MeanQuestion(executions, each, seed)
    executions.require_possible()
    with progress_shown(progress), ExitStack() as stack:
        for candidate in made:
            stack.enter_context(candidate.campaign.store.sole_writer())
        with stage("comparing", budget, "executions", done=executions.count):
            executions.resume()
            while _step(questions, worst, mean, budget):
                advance()
    return Comparison(
        tuple(_result(candidate, worst, mean) for candidate in made),
        tuple((worst if name == "worst" else mean).pair(*pair) for name in questions for pair in combinations(made, 2)),
        confidence,
        executions.count,
        budget,
        made[0].campaign.validation.labels.units,
        tuple(_assumptions(questions, worst, stochastic)),
    )


def store_name(name: str) -> str:
    """Return the name of a candidate as a part of a file name."""
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name).strip(".") or "candidate"


def _step(questions: tuple[Question, ...], worst: WorstQuestion, mean: MeanQuestion, budget: int) -> bool:
    """Execute the task that is expected to decide most; return False if nothing is left to do.

    It follows from the stores alone, so that a comparison can be interrupted.
    """
    executions = worst.executions
    executions.require_possible()
    if (left := budget - executions.count) <= 0:
        return False
    of_worst, of_mean = "worst" in questions and bool(worst.undecided), "mean" in questions
    noted = [pair for candidate in executions.candidates for pair in candidate.noted]
    spent = sum(trial.executed and note.shared is None and note.question == "worst" for trial, note in noted)
    # The question about d* has half of the budget before the other one is answered.
    if of_worst and (not of_mean or spent < 0.5 * budget) and worst.step():
        return True
    return of_mean and (mean.step(left) or (of_worst and worst.step()))


def _result(candidate: Candidate, worst: WorstQuestion, mean: MeanQuestion) -> CandidateResult:
    largest = candidate.campaign.worst
    bounds = [decision.bound for decision in worst.decisions if decision.smaller == candidate.name]
    drawn = [trial.distance for trial, _ in mean.draws_of(candidate).values() if trial.distance is not None]
    return CandidateResult(
        candidate.name,
        len(candidate.executed()),
        len(candidate.executed(shared=True)),
        len(candidate.campaign.failed),
        None if largest is None else largest.distance,
        None if largest is None else largest.parameters,
        min(bounds, default=None),
        len(drawn),
        float(np.mean(drawn)) if drawn else None,
    )


def _assumptions(questions: tuple[Question, ...], worst: WorstQuestion, stochastic: bool) -> Iterator[str]:
    yield "the candidates were fixed before the comparison, and the system does not change during it"
    if "worst" in questions:
        yield (
            f"each bound on d* holds with confidence {worst.options.confidence:.6g} under the prior that its "
            "certificate states (dynamics or posterior); it is a probability given the executions, so neither the "
            "changing threshold nor the time of stopping costs confidence"
        )
    if "mean" in questions:
        most, described = worst.executions.most, worst.candidates[0].campaign.validation.space.distribution
        over = "uniform over the task space" if described is None else distribution_text(described.describe())
        yield f"tasks are independent draws ({over})"
        yield (
            f"no distance can exceed {most:g}; the decisions on expected distances are then valid for any number of "
            "tasks"
            if most is not None
            else "no largest possible distance is stated, so the decisions on expected distances are exact only if "
            "corrected differences are symmetric about their mean, and asymptotic otherwise: rare large distances "
            "that were not drawn can make them wrong"
        )
    if stochastic:
        yield "executions of one task may differ, and the questions are about expected distances of tasks"
