"""Findings: what the trials show, each a sentence with its numbers and a light, which all outputs of a report share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from ctxval._util.representation import ShortRepr
from ctxval._util.texts import reason_of

if TYPE_CHECKING:
    from ctxval.report.context import ReportContext

Light = Literal["good", "note", "attention", "bad", "unknown"]
"""A traffic light: nothing speaks against M or the verdict; neither good nor bad; read it; it speaks against it; it is
not known."""

# The word of each light stands beside its colour.
WORDS: dict[Light, str] = {
    **{"good": "good", "note": "note", "attention": "attention"},
    **{"bad": "problem", "unknown": "not known"},
}


@dataclass(frozen=True)
class Finding(ShortRepr):
    """One thing that the trials show.

    Attributes:
        name: what it is about, in a few words.
        light: how it is to be taken.
        text: one or more sentences with the numbers.
        numbers: the same numbers for JSON, by name.
    """

    name: str
    light: Light
    text: str
    numbers: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes, ready for JSON."""
        return asdict(self)


Answer = tuple[Light, str, dict[str, Any]]
Question = Callable[["ReportContext"], Finding | None]
"""A function that looks for one thing; it returns None if there is nothing to say."""


def asks(name: str) -> Callable[[Callable[[ReportContext], Answer | None]], Question]:
    """Make a question of a function that returns the light, the text and the numbers of a finding.

    A question that fails is a finding that is not known, because one about odd data must not hide the other answers.
    """

    def decorate(answer: Callable[[ReportContext], Answer | None]) -> Question:
        @functools.wraps(answer)
        def question(context: ReportContext) -> Finding | None:
            try:
                answered = answer(context)
            except Exception as error:
                return Finding(name, "unknown", f"This could not be computed: {reason_of(error)}.")
            return None if answered is None else Finding(name, *answered)

        return question

    return decorate
