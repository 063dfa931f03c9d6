"""The verdict in one sentence, the diagnostics, and what was not tested."""

from __future__ import annotations

from markupsafe import Markup

from ctxval._util.representation import call, counted
from ctxval.certificates.bounds import as_text, at_most, with_error
from ctxval.report.context import ReportContext, distance_of
from ctxval.report.diagnostics import diagnostics, not_tested
from ctxval.report.findings import WORDS, Finding
from ctxval.report.markup import bullets, details, element, heading, joined, number, paragraph, quantity, table
from ctxval.storage.other_stores import other_stores

_SHAPES = {"good": "\u25cf", "note": "\u25c6", "attention": "\u25b2", "bad": "\u25a0", "unknown": "\u25cb"}
"""A shape for each light, because colours alone tell nothing in grey print."""


_STORES = 5
"""Largest number of other stores that are named."""


class VerdictSection:
    """The verdict, with what it rests on."""

    title = "Verdict"

    def render(self, context: ReportContext) -> Markup:
        """Return the sentence, the facts, the diagnostics and what was not tested."""
        return joined(
            [
                paragraph(element("strong", _answer(context)), " ", _sentence(context), class_="verdict"),
                _facts(context),
                _other_stores(context),
                heading("Diagnostics"),
                lights(diagnostics(context)),
                heading("What was not tested"),
                bullets(not_tested(context)),
                _assumptions(context),
            ]
        )

    __repr__ = call


def _answer(context: ReportContext) -> str:
    return "No verdict." if context.verdict is None else f"{context.verdict.answer.capitalize()}."


def _sentence(context: ReportContext) -> str:
    """Return the verdict in one sentence."""
    verdict = context.verdict
    if verdict is None:
        worst = context.worst_first[0] if context.worst_first else None
        largest = "no distance is known" if worst is None else f"the largest executed distance is {_of(context)}"
        return f"No threshold was given; {largest}."
    without = len(context.failed)
    lost = "each gave a distance" if not without else f"{without} of the trials have no distance"
    effort = f"{context.executions} executions were spent, and {lost}."
    reason = f"{verdict.reason[:1].upper()}{verdict.reason[1:]} {effort}"
    return reason if verdict.rests_on is None else f"{reason} {verdict.rests_on}"


def _of(context: ReportContext) -> str:
    worst = context.worst_first[0]
    return f"{quantity(distance_of(worst), context.labels.units)} in trial {worst.number}"


def _facts(context: ReportContext) -> Markup:
    verdict, certificate, units = context.verdict, context.certificate, context.labels.units
    failed = len(context.failed)
    rows: list[tuple[str, object]] = [
        ("Experiment", context.name or "without a name"),
        ("Threshold", None if verdict is None else quantity(verdict.threshold, units)),
        ("Largest executed distance", _of(context) if context.worst_first else None),
        ("Executions", f"{context.executions}" + ("" if context.budget is None else f" of {context.budget}")),
        ("Executions without a distance", str(failed)),
    ]
    if certificate is not None:
        rows += [
            ("Certificate", certificate.kind + (" (withdrawn)" if certificate.doubt is not None else "")),
            ("Bound", f"{with_error(certificate.upper_bound, certificate.error)} {units}".rstrip()),
            ("Confidence", number(certificate.confidence)),
            ("Volume left out", f"{at_most(100 * certificate.volume, 3)} %"),
        ]
    if verdict is not None and verdict.expected is not None:
        rows.append(("Forecast", str(verdict.expected)))
    facts = table("The verdict in numbers", ("Quantity", "Value"), rows, class_="facts")
    if not context.missing:
        return facts
    return joined([facts, paragraph(f"The experiment is not loaded: {context.missing}", class_="note")])


def _other_stores(context: ReportContext) -> Markup:
    """Return a warning if the folder has other campaigns of the same experiment."""
    others = [] if context.store.path is None else other_stores(context.store.path)
    if not others:
        return Markup("")
    count = counted(len(others), "other store")
    return paragraph(
        f"The folder contains {count} of this experiment: {', '.join(other.name for other in others[:_STORES])}. The "
        "best result of several campaigns is wrong more often than its confidence states."
    )


def _assumptions(context: ReportContext) -> Markup:
    certificate = context.certificate
    if certificate is None:
        return Markup("")
    return joined(
        [
            heading("What the certificate assumes"),
            paragraph(certificate.statement) if certificate.doubt is None else Markup(""),
            bullets(f"{one[:1].upper()}{one[1:]}." for one in certificate.assumptions),
            details("Numbers of the certificate", _numbers(certificate.numbers)),
        ]
    )


def _numbers(numbers: dict[str, object]) -> Markup:
    rows = ((name.replace("_", " "), as_text(value)) for name, value in numbers.items())
    return table("Numbers of the certificate", ("Name", "Value"), rows)


def lights(findings: list[Finding]) -> Markup:
    """Return findings as a list with their lights: a shape, a colour and a word."""
    return element("ul", *map(_light, findings), class_="lights")


def _light(finding: Finding) -> Markup:
    shape = element("span", _SHAPES[finding.light], class_="shape", aria_hidden="true")
    word = element("span", shape, " ", WORDS[finding.light], class_=f"light {finding.light}")
    return element("li", word, " ", element("strong", f"{finding.name}."), " ", finding.text)
