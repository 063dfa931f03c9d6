"""Insights in words: what the trials show of M, of the controllers and of the tasks, each with its numbers."""

from __future__ import annotations

from ctxval.report.context import ReportContext
from ctxval.report.findings import Finding, Question, findings_of
from ctxval.report.insights_loops import components, converged, flips, goals, saturation, unusual_motion
from ctxval.report.insights_tasks import bias, explained, weak_region, weak_states

QUESTIONS: tuple[tuple[str, Question], ...] = (
    ("Where M is weak", weak_region),
    ("States visited there", weak_states),
    ("What errs, and when", components),
    ("Controllers of neighbouring tasks", flips),
    ("Inputs and their limits", saturation),
    ("Design of the controllers", converged),
    ("Motion of M", unusual_motion),
    ("Goals of M", goals),
    ("Bias across the tasks", bias),
    ("Corrected model", explained),
)
"""What is asked about every campaign, with the name of each question."""


def insights(context: ReportContext) -> list[Finding]:
    """Return what the trials show, one finding for each question that has an answer."""
    return findings_of(QUESTIONS, context)
