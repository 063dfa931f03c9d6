"""Reports of a campaign: one HTML page for people, and JSON, JUnit and Markdown for programs.

A report reads and never executes: neither the system, nor code that a store names.

>>> from ctxval import report  # doctest: +SKIP
>>> report.write(campaign, "report.html", threshold=0.5)  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctxval.campaign.campaign import Campaign
from ctxval.certificates import CertificateOptions, Verdict
from ctxval.report.card import Card, CardVerdict, card
from ctxval.report.charts import Axis, Chart
from ctxval.report.context import ReportContext, context_of_campaign, context_of_store
from ctxval.report.findings import Finding
from ctxval.report.markup import bullets, element, heading, joined, paragraph, table
from ctxval.report.page import SECTIONS, Section, junit, markdown, page, picture, to_json, write_page

__all__ = [
    "SECTIONS",
    "Axis",
    "Card",
    "CardVerdict",
    "Chart",
    "Finding",
    "ReportContext",
    "Section",
    "bullets",
    "card",
    "context_of_campaign",
    "context_of_store",
    "element",
    "heading",
    "joined",
    "junit",
    "markdown",
    "page",
    "paragraph",
    "picture",
    "table",
    "to_json",
    "write",
    "write_page",
]


def write(
    campaign: Campaign,
    path: str | Path,
    *,
    threshold: float | None = None,
    verdict: Verdict | None = None,
    certificate: CertificateOptions | None = None,
    sections: Sequence[Section] = (),
) -> Path:
    """Write the report of a campaign as one HTML file at a path, and return the path. Its system is not executed.

    Args:
        threshold: tau, for the verdict; without it and without ``verdict`` there is no verdict.
        verdict: the verdict, if it was computed before.
        certificate: the kind and the options of the certificate, as in :meth:`ctxval.Campaign.verdict`.
        sections: sections of your own, which follow the others.
    """
    context = context_of_campaign(campaign, verdict, threshold=threshold, certificate=certificate)
    return write_page(context, path, sections)
