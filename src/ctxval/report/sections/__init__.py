"""The sections of a report: each is a small class with a title and a method ``render``."""

from __future__ import annotations

from ctxval.report.sections.appendix import AppendixSection
from ctxval.report.sections.base import Section, sections_of
from ctxval.report.sections.basis import BasisSection
from ctxval.report.sections.convergence import ConvergenceSection
from ctxval.report.sections.insights import InsightsSection
from ctxval.report.sections.repeat import RepeatSection
from ctxval.report.sections.tasks import TasksSection
from ctxval.report.sections.trials import TrialsSection
from ctxval.report.sections.verdict import VerdictSection

SECTIONS: tuple[Section, ...] = (
    VerdictSection(),
    BasisSection(),
    InsightsSection(),
    TasksSection(),
    TrialsSection(),
    ConvergenceSection(),
    RepeatSection(),
    AppendixSection(),
)
"""The sections of every report, in their order."""

__all__ = [
    "SECTIONS",
    "AppendixSection",
    "BasisSection",
    "ConvergenceSection",
    "InsightsSection",
    "RepeatSection",
    "Section",
    "TasksSection",
    "TrialsSection",
    "VerdictSection",
    "sections_of",
]
