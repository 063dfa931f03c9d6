"""What the verdict rests on: assumptions, diagnostics, what was not tested, and the numbers of the certificate."""

from __future__ import annotations

from markupsafe import Markup

from ctxval._util.representation import ShortRepr
from ctxval.certificates import Certificate
from ctxval.certificates.bounds import as_text
from ctxval.report.context import ReportContext
from ctxval.report.diagnostics import diagnostics, not_tested
from ctxval.report.findings import WORDS, Finding
from ctxval.report.insights import insights
from ctxval.report.markup import UNCUT, bullets, details, element, heading, joined, paragraph, table, text

# A shape for each light, because colours alone tell nothing in grey print.
_SHAPES = {"good": "\u25cf", "note": "\u25c6", "attention": "\u25b2", "bad": "\u25a0", "unknown": "\u25cb"}


class BasisSection(ShortRepr):
    """What the verdict rests on, and what would speak against it."""

    title = "Assumptions and diagnostics"

    def render(self, context: ReportContext) -> Markup:
        """Return the assumptions, the diagnostics and what was not tested."""
        rests_on = None if context.verdict is None else context.verdict.rests_on
        return joined(
            [
                *([] if context.certificate is None else _assumptions(context.certificate)),
                *([] if rests_on is None else [paragraph(text(rests_on, UNCUT))]),
                heading("Diagnostics"),
                lights(diagnostics(context)),
                heading("What was not tested"),
                bullets(not_tested(context)),
            ]
        )


class InsightsSection(ShortRepr):
    """What the trials show of M, of the controllers and of the tasks."""

    title = "Insights"

    def render(self, context: ReportContext) -> Markup:
        """Return the insights; what is as it should be has none."""
        return lights(insights(context))


def _assumptions(certificate: Certificate) -> list[Markup]:
    rows = ((name.replace("_", " "), as_text(value)) for name, value in certificate.numbers.items())
    return [
        heading(f"What the certificate {certificate.kind} assumes"),
        paragraph(certificate.statement if certificate.doubt is None else f"It is withdrawn: {certificate.doubt}."),
        bullets(text(f"{words[:1].upper()}{words[1:]}.", UNCUT) for words in certificate.assumptions),
        details("Numbers of the certificate", table("Numbers of the certificate", ("Name", "Value"), rows)),
    ]


def lights(findings: list[Finding]) -> Markup:
    """Return findings as a list with their lights: a shape, a colour and a word."""
    if not findings:
        return paragraph("Nothing is unusual.")
    items = []
    for finding in findings:
        shape = element("span", _SHAPES[finding.light], class_="shape", aria_hidden="true")
        word = element("span", shape, " ", WORDS[finding.light], class_=f"light {finding.light}")
        items.append(element("li", word, " ", element("strong", f"{finding.name}."), " ", finding.text))
    return element("ul", *items, class_="lights")
