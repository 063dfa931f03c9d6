"""``ctxval.compare``: which of several models, controllers or distances is better on one system."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ctxval._util.checked import NonNegativeInt, PositiveFloat, PositiveInt, checked
from ctxval._util.progress_display import progress_shown
from ctxval.campaign import Campaign
from ctxval.certificates.options import CONFIDENCE
from ctxval.comparison.candidates import Candidate
from ctxval.comparison.executions import OnTrial
from ctxval.comparison.race import Asked, Race
from ctxval.comparison.result import Comparison
from ctxval.core.experiment import Experiment
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.searches import Auto

BUDGET = 100
"""Default of the largest number of executions."""

Compared = Validation | Experiment | Campaign


@checked
def compare(
    candidates: Mapping[str, Compared],
    *,
    question: Asked = "both",
    budget: PositiveInt = BUDGET,
    confidence: float = CONFIDENCE,
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
        question: ``worst`` for d*, ``mean`` for the expected distance, or ``both``.
        budget: the largest total number of executions, including earlier ones in the stores.
        confidence: the probability with which all decisions hold together; it is divided between pairs and questions.
        seed: the seed of the random numbers.
        stores: the folder of the stores, one for each candidate; in memory by default.
        largest_possible: a number that no distance can exceed, if one is known. Decisions on expected distances are
            then valid for any number of tasks; otherwise they are asymptotic. A failed execution counts as this
            distance.
        stochastic: whether two executions of one task may differ; then only the question ``mean`` can be asked.
        on_trial: called with the name of the candidate and each trial that has ended.
        progress: whether to show the progress on standard error; None to show it at a terminal and in a notebook.

    Raises:
        InputError: if a value cannot be used, the candidates differ in the system, the tasks or the unit, or a distance
            exceeds ``largest_possible``.
        StoreError: if a store cannot be used, or another experiment made it.
        ModelError, DesignError, DistanceError: as in :meth:`ctxval.Campaign.run`; what was executed is stored.
    """
    made = [Candidate(str(name), _campaign(str(name), one, stores, seed)) for name, one in candidates.items()]
    race = Race(
        made,
        question,
        budget=budget,
        confidence=confidence,
        seed=seed,
        largest_possible=largest_possible,
        stochastic=stochastic,
        on_trial=on_trial,
    )
    with progress_shown(progress):
        return race.run()


def _campaign(name: str, candidate: Compared, stores: str | Path | None, seed: int) -> Campaign:
    if isinstance(candidate, Campaign):
        return candidate
    validation = candidate.validation if isinstance(candidate, Experiment) else candidate
    if not isinstance(validation, Validation):
        raise InputError(f"candidate {name} must be a Validation, an Experiment or a Campaign, got {candidate!r}.")
    path = None if stores is None else Path(stores) / f"{store_name(name)}.sqlite"
    return Campaign(validation, search=Auto(thinking="fast"), store=path, seed=seed, name=name)


def store_name(name: str) -> str:
    """Return the name of a candidate as a part of a file name."""
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name).strip(".") or "candidate"
