"""The first screen: the verdict, the distance over the tasks and what to do next; and what the verdict rests on."""

from __future__ import annotations

import shlex

from markupsafe import Markup

from ctxval._util.representation import counted
from ctxval._util.texts import as_text
from ctxval.certificates.bounds import at_most, with_error
from ctxval.report import markup
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import distance_of
from ctxval.report.findings import WORDS, Finding
from ctxval.report.markup import UNCUT, bullets, element, heading, joined, paragraph, percent, quantity, table, text
from ctxval.report.sections.distances import envelope, over_tasks
from ctxval.report.sections.repeat import command_of, command_snippet, path_of
from ctxval.report.sections.trials import task_of

# A shape for each verdict and each light, because colours alone tell nothing in grey print.
_SHAPES = {
    **{"validated": "\u2714", "falsified": "\u2718", "undecided": "?", "no verdict": "\u2013"},
    **{"good": "\u25cf", "note": "\u25c6", "attention": "\u25b2", "bad": "\u25a0", "unknown": "\u25cb"},
}


def verdict(context: ReportContext) -> Markup:
    """Return the first screen: the verdict, its sentence, the picture, the next step and the numbers."""
    answer = "no verdict" if context.verdict is None else context.verdict.answer
    word = element("p", _shape(answer), " ", answer.capitalize(), class_="word")
    picture = element("div", over_tasks(context) or paragraph("No distance is known yet."), class_="picture")
    advice, command = _next(context)
    block = markup.code(command, "Next command") if command else None
    beside = element("div", heading("What next"), paragraph(advice), block, _facts(context), *_remarks(context))
    stated = "No threshold was given." if context.verdict is None else markup.sentence(context.verdict.reason)
    head = element("div", word, paragraph(stated, class_="sentence"), class_=f"answer {answer}")
    return joined([head, element("div", picture, beside, class_="first"), envelope(context)])


def _shape(answer: str) -> Markup:
    return element("span", _SHAPES[answer], class_="shape", aria_hidden="true")


def _next(context: ReportContext) -> tuple[str, str]:
    """Return what to do next, and the command that does it; empty if there is none."""
    verdict, path = context.verdict, str(path_of(context))
    if not context.executions:
        return "Execute tasks.", command_of(context)
    if verdict is None:
        advice = "State the threshold that the distance must keep. The recorded trials are then judged."
        return advice, shlex.join(["ctxval", "report", path, "--threshold", "VALUE"])
    if verdict.answer == "validated":
        advice = (
            "Use the model for these tasks. Validate it again if the system, the model, the design of the controllers "
            "or the tasks change."
        )
        tests = {} if verdict.certificate is None else verdict.certificate.details.get("tests", {})
        most = 22  # tests are advised if an error would be costly
        drawn = tests.get("drawn", most)
        budget = max(context.budget or 0, context.executions + most - drawn)
        command = command_of(context, budget, "--tests", str(most), "--store", path)
        if not command or drawn >= most:
            return advice, ""
        return f"{advice} If an error would be costly, test the predictions at {most} drawn tasks:", command
    if verdict.answer == "falsified":
        largest = quantity(distance_of(context.worst_first[0]), context.labels.units)
        advice = (
            f"Do not rely on the model at this threshold. Improve it, narrow the tasks, or accept {largest} or more."
        )
        if not context.settings:
            return advice, ""
        if context.envelope is None:
            advice += " `ctxval run --envelope` finds the tasks on which the model keeps it."
        better = "This learns a better model from the recorded executions, and validates it:"
        return f"{advice} {better}", shlex.join(["ctxval", "refine", path])
    by_hand = any(trial.told for trial in context.trials)
    if context.failed:
        number, again = context.failed[0].number, command_snippet(context, context.failed[0])
        if not by_hand:
            budget = context.executions + len(context.failed)
            again = command_of(context, budget, "--again-failed", "what was changed", "--store", path)
        return f"Find out why trial {number} has no distance, and execute its task again.", again
    expected = None if verdict.expected is None else verdict.expected.executions
    advice = f"about {expected} are expected to decide" if expected else "how many will decide cannot be forecast"
    # A search that explores may never execute what the certificate lacks.
    decide = ["--decide"] if getattr(verdict.certificate, "kind", "") in ("dynamics", "posterior") else []
    command = command_of(context, context.executions + (expected or 10), *decide, "--store", path)
    return f"Execute more tasks: {advice}.", shlex.join(["ctxval", "ask", path]) if by_hand else command


def _facts(context: ReportContext) -> Markup:
    verdict, certificate, units = context.verdict, context.certificate, context.labels.units
    rows: list[tuple[str, object]] = []
    if context.worst_first:
        worst = context.worst_first[0]
        at = f"{quantity(distance_of(worst), units)} at {task_of(context, worst)} (trial {worst.number})"
        rows.append(("Largest executed", at))
    if certificate is not None:
        how = "withdrawn" if certificate.doubt is not None else f"{percent(certificate.confidence)} confidence"
        bound = f"{with_error(certificate.upper_bound, certificate.error)} {units}".rstrip()
        share = certificate.details.get("share")
        tasks = "all tasks" if share is None else f"{100 * share:.4g} % of the tasks"
        rows.append((f"Bound on {tasks}", f"{bound} ({certificate.kind}, {how})"))
        if certificate.volume and share is None:
            rows.append(("Tasks left out", f"{at_most(100 * certificate.volume, 3)} %"))
    if verdict is not None:
        rows.append(("Threshold", quantity(verdict.threshold, units)))
    without = f", {len(context.failed)} without a distance" if context.failed else ""
    total = "" if context.budget is None else f" of at most {context.budget}"
    rows.append(("Executions", f"{context.executions}{total}{without}"))
    return table("In numbers", ("Quantity", "Value"), rows, class_="facts")


def _remarks(context: ReportContext) -> list[Markup]:
    """Return what must not be overlooked in what is folded below, and around the store."""
    remarks = [paragraph(element("strong", "Why M fails. "), context.cause)] if context.cause else []
    # The sentence of the verdict says why a certificate is refused or withdrawn.
    findings = [finding for finding in [*context.diagnostics, *context.insights] if finding.name != "Certificate"]
    for light in ("bad", "attention"):
        if names := [finding.name for finding in findings if finding.light == light]:
            word = element("span", WORDS[light].capitalize(), class_=f"light {light}")
            remarks.append(paragraph(word, f" {'; '.join(names)} (below)", class_="remark"))
    if context.missing:
        remarks.append(paragraph(f"The experiment is not loaded: {context.missing}", class_="note"))
    others = context.provenance.beside
    if others:
        count, first = counted(len(others), "other store"), ", ".join(other.path.name for other in others[:5])
        sentence = (
            f"The folder contains {count} of this experiment: {first}. The best result of several campaigns is wrong "
            "more often than its confidence states."
        )
        remarks.append(paragraph(sentence, class_="note"))
    return remarks


def basis(context: ReportContext) -> Markup:
    """Return what the verdict rests on: the assumptions, the diagnostics and what was not tested."""
    parts, certificate = list[Markup](), context.certificate
    if certificate is not None:
        rows = ((name.replace("_", " "), as_text(value)) for name, value in certificate.numbers.items())
        stated = certificate.statement if certificate.doubt is None else f"It is withdrawn: {certificate.doubt}."
        parts += [
            heading(f"What the certificate {certificate.kind} assumes"),
            paragraph(stated),
            bullets(text(f"{markup.sentence(words)}.", UNCUT) for words in certificate.assumptions),
            markup.details("Numbers of the certificate", table("Numbers of the certificate", ("Name", "Value"), rows)),
        ]
    if context.verdict is not None and context.verdict.rests_on is not None:
        parts.append(paragraph(text(context.verdict.rests_on, UNCUT)))
    parts += [heading("Diagnostics"), lights(context.diagnostics)]
    return joined([*parts, heading("What was not tested"), bullets(context.not_tested)])


def lights(findings: list[Finding]) -> Markup:
    """Return findings as a list with their lights: a shape, a colour and a word."""
    if not findings:
        return paragraph("Nothing is unusual.")
    items = []
    for finding in findings:
        word = element("span", _shape(finding.light), " ", WORDS[finding.light], class_=f"light {finding.light}")
        items.append(element("li", word, " ", element("strong", f"{finding.name}."), " ", finding.text))
    return element("ul", *items, class_="lights")
