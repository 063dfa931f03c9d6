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
    ("Controllers flip", flips),
    ("Inputs saturate", saturation),
    ("Designs converge", converged),
    ("Motion of M", unusual_motion),
    ("M reaches its goals", goals),
    ("Bias across the tasks", bias),
    ("Corrected model", explained),
)
"""What is asked about every campaign, with the name of each question."""


def insights(context: ReportContext) -> list[Finding]:
    """Return what the trials show, one finding for each question that has an answer."""
    return findings_of(QUESTIONS, context)
