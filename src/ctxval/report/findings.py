"""Findings of a report: one sentence with its numbers, and a light."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from ctxval._util.representation import ShortRepr
from ctxval._util.texts import reason_of
from ctxval.report.context import ReportContext

Light = Literal["good", "note", "attention", "bad", "unknown"]
"""A traffic light: nothing speaks against M or the verdict; neither good nor bad; read it; it speaks against it; it is
not known."""

WORDS: dict[Light, str] = {
    "good": "good",
    "note": "note",
    "attention": "attention",
    "bad": "problem",
    "unknown": "not known",
}
"""The word of each light, which stands beside its colour."""


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

    def unless(self, doubt: str | None) -> Finding:
        """Return this finding, which is not good if there is a doubt about what it concludes."""
        if self.light != "good" or doubt is None:
            return self
        text = f"{self.text} But {doubt}: tasks between the executed ones may be unlike them."
        return replace(self, light="attention", text=text)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes, ready for JSON."""
        return {"name": self.name, "light": self.light, "text": self.text, "numbers": self.numbers}


Question = Callable[[ReportContext], Finding | None]
"""A function that looks for one thing; it returns None if there is nothing to say."""


def findings_of(questions: Iterable[tuple[str, Question]], context: ReportContext) -> list[Finding]:
    """Return what questions find; a question that fails is a finding that is not known."""
    findings: list[Finding | None] = []
    for name, question in questions:
        try:
            findings.append(question(context))
        except Exception as error:  # one question about odd data must not hide the answers to the others
            findings.append(Finding(name, "unknown", f"This could not be computed: {reason_of(error)}."))
    return [finding for finding in findings if finding is not None]
