"""The result of a comparison: what is known of each candidate, and the decision on each pair."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval._util.representation import ShortRepr, call, line, lines
from ctxval._util.representation import table as html_table
from ctxval.comparison.candidates import Question
from ctxval.core.space import Point

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS: dict[Question, str] = {"worst": "largest distance d*", "mean": "expected distance"}
"""What each question is about."""


@dataclass(frozen=True)
class CandidateResult(ShortRepr):
    """What is known of one candidate.

    Attributes:
        name: its name.
        executions: the number of executions with its controllers that were made for it.
        shared: the number of executions of other candidates that count for it too, because its controllers agree.
        failed: the number of executions that failed.
        largest: the largest executed distance; None if there is none.
        task: the parameters of this task, by name.
        bound: what d* is at most, if a decision needed it.
        draws: the number of its independent draws.
        mean: the mean of the distances of these draws; None if there is none.
    """

    name: str
    executions: int
    shared: int
    failed: int
    largest: float | None
    task: dict[str, Point] | None
    bound: float | None
    draws: int
    mean: float | None


@dataclass(frozen=True)
class PairResult:
    """The decision on one question about two candidates.

    Attributes:
        question: ``worst`` for d*, or ``mean`` for the expected distance.
        first, second: the names of the two.
        smaller: the name of the one with the smaller value; None if this is not decided.
        reason: why, or what is missing, in one sentence.
        estimate: the estimated expected distance of the first minus that of the second; None for other questions.
        low, high: the ends of its confidence sequence; infinite if nothing is known.
        tasks: the number of tasks that both have executed for it.
        variance_left: the variance that the predictions leave of the differences, as a share; None if not known.
    """

    question: Question
    first: str
    second: str
    smaller: str | None
    reason: str
    estimate: float | None = None
    low: float | None = None
    high: float | None = None
    tasks: int = 0
    variance_left: float | None = None

    @property
    def larger(self) -> str:
        """The name of the one with the larger value, if this is decided."""
        return self.second if self.smaller == self.first else self.first

    @property
    def answer(self) -> str:
        """The answer in a few words."""
        if self.smaller is None:
            return f"{self.first} or {self.second}: undecided"
        return f"{self.smaller} has a smaller {WORDS[self.question]} than {self.larger}"

    def __repr__(self) -> str:
        return lines(call(self, self.question, self.first, self.second, smaller=self.smaller), line(self.reason))


@dataclass(frozen=True)
class Comparison:
    """The result of a comparison.

    Attributes:
        candidates: what is known of each candidate.
        pairs: the decision on each pair, for each question.
        confidence: the probability with which all decisions and intervals hold together.
        executions: the number of executions of the system; a shared execution counts once.
        budget: the largest number of executions.
        units: the units of the distances.
        assumptions: what the decisions assume, one sentence each.
    """

    candidates: tuple[CandidateResult, ...]
    pairs: tuple[PairResult, ...]
    confidence: float
    executions: int
    budget: int
    units: str
    assumptions: tuple[str, ...]

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
        for pair in self.pairs:
            if pair.question == question and {pair.first, pair.second} == {first, second}:
                return pair
        raise KeyError(f"{question}: {first}, {second}")

    def ranking(self, question: Question) -> tuple[tuple[str, ...], ...]:
        """Return the candidates from the smallest value to the largest; those that are not told apart are together.

        A candidate stands in an earlier group than another one only if all pairs between the groups are decided.
        """
        smaller = {(pair.smaller, pair.larger) for pair in self.pairs if pair.question == question and pair.smaller}
        wins = {candidate.name: sum(first == candidate.name for first, _ in smaller) for candidate in self.candidates}
        ordered = sorted((candidate.name for candidate in self.candidates), key=lambda name: -wins[name])
        groups: list[tuple[str, ...]] = []
        start = 0
        for end in range(1, len(ordered) + 1):
            if all((a, b) in smaller for a in ordered[start:end] for b in ordered[end:]):
                groups.append(tuple(ordered[start:end]))
                start = end
        return tuple(groups)

    def ranking_text(self, question: Question) -> str:
        """Return the ranking in one line, such as ``gp < fnn < linear``; ``?`` joins those that are not told apart."""
        return " < ".join(" ? ".join(group) for group in self.ranking(question))

    def to_dict(self) -> dict[str, Any]:
        """Return everything in types that JSON has: an infinite end of an interval is None."""
        plain = asdict(self)
        for pair in plain["pairs"]:
            for end in ("low", "high"):
                pair[end] = pair[end] if pair[end] is not None and np.isfinite(pair[end]) else None
        return {**plain, "decided": self.decided, "rankings": {q: self.ranking(q) for q in self.questions}}

    def to_markdown(self) -> str:
        """Return the tables and the assumptions as Markdown."""
        from ctxval.comparison.tables import markdown

        return markdown(self)

    def plot(self) -> Figure:
        """Return a figure with a panel for each question: executed distances, bounds and intervals."""
        from ctxval.comparison.picture import picture

        return picture(self)

    def __repr__(self) -> str:
        head = call(
            self, confidence=self.confidence, executions=self.executions, budget=self.budget, decided=self.decided
        )
        return lines(head, *(f"{WORDS[question]}: {line(self.ranking_text(question))}" for question in self.questions))

    def _repr_html_(self) -> str:
        return html_table(
            "Comparison",
            [
                *((WORDS[question], self.ranking_text(question)) for question in self.questions),
                *((f"{pair.first}, {pair.second}", pair.reason) for pair in self.pairs),
                ("executions", f"{self.executions} of at most {self.budget}"),
                ("confidence of all decisions together", self.confidence),
                *(("assumes", assumption) for assumption in self.assumptions),
            ],
        )
