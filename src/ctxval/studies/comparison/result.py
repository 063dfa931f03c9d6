"""The result of a comparison: what is known of each candidate, and the decision on each pair."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ctxval._util.representation import ShortRepr, call
from ctxval.certificates.bounds import at_most
from ctxval.core.space import Point
from ctxval.studies.comparison.candidates import Question

# What each question is about, and the columns of the tables of candidates and of pairs.
WORDS: dict[Question, str] = {"worst": "largest distance d*", "mean": "expected distance"}
CANDIDATES = ("candidate", "executions", "shared", "largest distance", "bound on d*", "draws", "mean distance")
PAIRS = ("question", "smaller", "than", "difference", "interval", "tasks")


@dataclass(frozen=True)
class CandidateResult(ShortRepr):
    """What is known of one candidate; a value that is not known is None."""

    name: str
    executions: int  #: the number of executions that were made for it
    shared: int  #: the number of executions of other candidates that count for it too, because its controllers agree
    failed: int  #: how many of its executions failed
    largest: float | None  #: the largest executed distance, and the parameters of this task
    task: dict[str, Point] | None
    bound: float | None  #: what d* is at most, if a decision needed it
    draws: int  #: the number of its independent draws, and the mean of their distances
    mean: float | None

    @property
    def cells(self) -> tuple[str, ...]:
        """The row of the table of candidates."""
        bound = None if self.bound is None else float(at_most(self.bound))
        counts = str(self.executions), str(self.shared)
        return self.name, *counts, _number(self.largest), _number(bound), str(self.draws), _number(self.mean)


@dataclass(frozen=True)
class PairResult:
    """The decision on one question about two candidates."""

    question: Question
    first: str
    second: str
    smaller: str | None  #: the name of the one with the smaller value; None if this is not decided
    reason: str  #: why, or what is missing, in one sentence
    estimate: float | None = None  #: the expected distance of the first minus that of the second, and its interval
    low: float | None = None
    high: float | None = None
    tasks: int = 0  #: the number of tasks that both have executed for it
    variance_left: float | None = None  #: the variance that the predictions leave of the differences, as a share

    @property
    def larger(self) -> str:
        """The name of the one with the larger value, if this is decided."""
        return self.second if self.smaller == self.first else self.first

    @property
    def cells(self) -> tuple[str, ...]:
        """The row of the table of pairs; the difference is that of the smaller one minus the other one."""
        names = self.smaller or f"{self.first} ? {self.second}", self.larger if self.smaller else "undecided"
        if self.question != "mean":
            return WORDS[self.question], *names, "-", "-", "-"
        sign = -1 if self.smaller == self.second else 1
        ends = sorted(sign * end for end in (self.low, self.high) if end is not None)
        is_limited = len(ends) == 2 and np.isfinite(ends).any()
        interval = f"{_number(ends[0])} to {_number(ends[1])}" if is_limited else "-"
        estimate = _number(None if self.estimate is None else sign * self.estimate)
        return WORDS[self.question], *names, estimate, interval, str(self.tasks)

    def __repr__(self) -> str:
        return call(self, self.question, self.first, self.second, smaller=self.smaller, reason=self.reason)


@dataclass(frozen=True)
class Comparison:
    """The result of a comparison."""

    candidates: tuple[CandidateResult, ...]
    pairs: tuple[PairResult, ...]
    confidence: float  #: the probability with which all decisions and intervals hold together
    executions: int  #: the number of executions of the system, and the largest one; a shared one counts once
    budget: int
    units: str  #: the units of the distances
    assumptions: tuple[str, ...]  #: what the decisions assume, one sentence each

    @property
    def decided(self) -> bool:
        """Whether all pairs are decided, for all questions."""
        return all(pair.smaller is not None for pair in self.pairs)

    @property
    def questions(self) -> tuple[Question, ...]:
        """The questions, in their order."""
        return tuple(dict.fromkeys(pair.question for pair in self.pairs))

    def pair(self, question: Question, first: str, second: str) -> PairResult:
        """Return the decision on a pair, named in any order."""
        by_names = {(pair.question, frozenset((pair.first, pair.second))): pair for pair in self.pairs}
        return by_names[question, frozenset((first, second))]

    def ranking(self, question: Question) -> tuple[tuple[str, ...], ...]:
        """Return groups of candidates from the smallest value to the largest; all pairs between groups are decided."""
        smaller = {(pair.smaller, pair.larger) for pair in self.pairs if pair.question == question and pair.smaller}
        wins = {candidate.name: sum(first == candidate.name for first, _ in smaller) for candidate in self.candidates}
        ordered = sorted((candidate.name for candidate in self.candidates), key=lambda name: -wins[name])
        groups, start = list[tuple[str, ...]](), 0
        for end in range(1, len(ordered) + 1):
            if all((a, b) in smaller for a in ordered[start:end] for b in ordered[end:]):
                groups.append(tuple(ordered[start:end]))
                start = end
        return tuple(groups)

    def ranking_text(self, question: Question) -> str:
        """Return the ranking in one line, such as ``gp < fnn < linear``; ``?`` joins those that are not told apart."""
        return " < ".join(" ? ".join(group) for group in self.ranking(question))

    def to_json(self) -> dict[str, Any]:
        """Return everything in types that JSON has: an infinite end of an interval is None."""
        plain = asdict(self)
        for pair in plain["pairs"]:
            for end in ("low", "high"):
                pair[end] = pair[end] if pair[end] is not None and np.isfinite(pair[end]) else None
        return {**plain, "decided": self.decided, "rankings": {q: self.ranking(q) for q in self.questions}}

    def __repr__(self) -> str:
        known = {name: getattr(self, name) for name in ("confidence", "executions", "budget", "decided")}
        return call(self, *map(self.ranking_text, self.questions), **known)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if np.isfinite(value) else ("unlimited" if value > 0 else "-unlimited")
