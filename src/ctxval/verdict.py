"""The three-valued answer: may M be trusted up to a threshold?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ctxval.errors import InputError
from ctxval.trial import Trial

Answer = Literal["validated", "falsified", "undecided"]


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the trials say about d* <= tau.

    Attributes:
        answer: falsified is an executed fact, validated a statement with a confidence, undecided the rest.
        threshold: tau.
        reason: one sentence.
        witness: the executed trial with d(p) > tau, if falsified.
    """

    answer: Answer
    threshold: float
    reason: str
    witness: Trial | None = None

    def __str__(self) -> str:
        return f"{self.answer}: {self.reason}"


def require_threshold(threshold: float) -> float:
    """Return a threshold tau.

    Raises:
        InputError: it is not a positive number.
    """
    if not isinstance(threshold, int | float) or not threshold > 0 or threshold == float("inf"):
        raise InputError(f"the threshold must be a positive number, got {threshold!r}.")
    return float(threshold)


def judge(worst: Trial | None, executions: int, failed: int, threshold: float) -> Verdict:
    """Return the verdict from the worst completed trial.

    Raises:
        InputError: the threshold is not a positive number.
    """
    tau = require_threshold(threshold)
    if worst is not None and worst.distance is not None and worst.distance > tau:
        reason = f"trial {worst.number} was executed and its distance {worst.distance:.4g} exceeds {tau:g}."
        return Verdict("falsified", tau, reason, worst)
    unknown = f", and {failed} failed, of whose distance nothing is known" if failed else ""
    reason = f"no distance above {tau:g} in {executions} executions{unknown}; that alone bounds nothing."
    return Verdict("undecided", tau, reason)
