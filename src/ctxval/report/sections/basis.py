"""What the verdict rests on: assumptions, diagnostics, what was not tested, and the numbers of the certificate."""

from __future__ import annotations

from markupsafe import Markup

from ctxval._util.representation import call
from ctxval.certificates import Certificate
from ctxval.certificates.bounds import as_text
from ctxval.report.context import ReportContext
from ctxval.report.diagnostics import diagnostics, not_tested
from ctxval.report.findings import WORDS, Finding
from ctxval.report.markup import UNCUT, bullets, details, element, heading, joined, paragraph, table, text

_SHAPES = {"good": "\u25cf", "note": "\u25c6", "attention": "\u25b2", "bad": "\u25a0", "unknown": "\u25cb"}
"""A shape for each light, because colours alone tell nothing in grey print."""


class BasisSection:
    """What the verdict rests on, and what would speak against it."""

    title = "Assumptions and diagnostics"

    def render(self, context: ReportContext) -> Markup:
        """Return the assumptions, the diagnostics and what was not tested."""
        found, rests_on = diagnostics(context), None if context.verdict is None else context.verdict.rests_on
        return joined(
            [
                *([] if context.certificate is None else _assumptions(context.certificate)),
                *([] if rests_on is None else [paragraph(text(rests_on, UNCUT))]),
                heading("Diagnostics"),
                lights(found) if found else paragraph("Nothing is unusual."),
                heading("What was not tested"),
                bullets(not_tested(context)),
            ]
        )

    __repr__ = call


def _assumptions(certificate: Certificate) -> list[Markup]:
    rows = ((name.replace("_", " "), as_text(value)) for name, value in certificate.numbers.items())
    return [
        heading(f"What the certificate {certificate.kind} assumes"),
        paragraph(certificate.statement if certificate.doubt is None else f"It is withdrawn: {certificate.doubt}."),
        bullets(text(f"{sentence[:1].upper()}{sentence[1:]}.", UNCUT) for sentence in certificate.assumptions),
        details("Numbers of the certificate", table("Numbers of the certificate", ("Name", "Value"), rows)),
    ]


def lights(findings: list[Finding]) -> Markup:
    """Return findings as a list with their lights: a shape, a colour and a word."""
    rows = []
    for finding in findings:
        shape = element("span", _SHAPES[finding.light], class_="shape", aria_hidden="true")
        word = element("span", shape, " ", WORDS[finding.light], class_=f"light {finding.light}")
        rows.append(element("li", word, " ", element("strong", f"{finding.name}."), " ", finding.text))
    return element("ul", *rows, class_="lights")
