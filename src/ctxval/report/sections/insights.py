"""Insights in words, each with its numbers."""

from __future__ import annotations

from markupsafe import Markup

from ctxval._util.representation import ShortRepr
from ctxval.report.context import ReportContext
from ctxval.report.insights import insights
from ctxval.report.markup import paragraph
from ctxval.report.sections.basis import lights


class InsightsSection(ShortRepr):
    """What the trials show of M, of the controllers and of the tasks."""

    title = "Insights"

    def render(self, context: ReportContext) -> Markup:
        """Return the insights, which say nothing of what is as it should be."""
        found = insights(context)
        return lights(found) if found else paragraph("Nothing is unusual.")
