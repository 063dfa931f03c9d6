"""Findings of a report: one sentence with its numbers, and a light."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from ctxval._util.representation import record
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
class Finding:
    """One thing that the trials show.

    Attributes:
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

    __repr__ = record


Question = Callable[[ReportContext], Finding | None]
"""A function that looks for one thing; it returns None if there is nothing to say."""


def findings_of(questions: Iterable[tuple[str, Question]], context: ReportContext) -> list[Finding]:
    """Return what questions find; a question that fails is a finding that is not known."""
    findings = []
    for name, question in questions:
        try:
            finding = question(context)
        except Exception as error:  # one question about odd data must not hide the answers to the others
            finding = Finding(name, "unknown", f"This could not be computed: {reason_of(error)}.")
        if finding is not None:
            findings.append(finding)
    return findings
