"""The same report for programs: JSON, JUnit for continuous integration, and Markdown."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ctxval._util.describe import describe
from ctxval._util.files import MADE_BY
from ctxval._util.texts import markdown_text, shortened, visible
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import distance_of
from ctxval.report.findings import WORDS, Finding
from ctxval.report.markup import UNCUT, number, quantity
from ctxval.report.sections.repeat import appendix, command_snippet, identity, python_snippet, repeating_command


def to_json(context: ReportContext) -> dict[str, Any]:
    """Return the verdict, the findings, the worst tasks, what repeats them, and the appendix, ready for JSON."""
    verdict, certificate = context.verdict, context.certificate
    with np.errstate(all="ignore"):  # a store may have any numbers
        report = {
            "name": context.name,
            **({} if verdict is None else verdict.to_json()),
            "units": context.labels.units,
            "executions": context.executions,
            "failed": [trial.number for trial in context.failed],
            "certificate": None if certificate is None else certificate.to_json(),
            "envelope": None if context.envelope is None else context.envelope.to_json(),
            "missing": context.missing or None,
            "diagnostics": [asdict(finding) for finding in context.diagnostics],
            "insights": [asdict(finding) for finding in context.insights],
            "not_tested": context.not_tested,
            "worst": [
                {
                    "trial": trial.number,
                    "task": trial.parameters,
                    "distance": distance_of(trial),
                    "python": python_snippet(context, trial),
                    "command": command_snippet(context, trial),
                }
                for trial in context.worst_tasks()
            ],
            "command": repeating_command(context) or None,
            "identity": identity(context),
            "appendix": [entry._asdict() for entry in appendix(context)],
        }
        plain: dict[str, Any] = json.loads(json.dumps(describe(report, depth=12), allow_nan=False))
    return plain


def junit(context: ReportContext) -> str:
    """Return the verdict and the diagnostics as JUnit XML: one test for each.

    The verdict fails if M is falsified, and is skipped if it is undecided. A diagnostic fails if it speaks against the
    verdict, and is skipped if it is not known.
    """

    def xml_text(words: str) -> str:  # control characters are written out
        return shortened(visible(words).replace("\ufffe", "").replace("\uffff", ""))

    suite = ElementTree.Element("testsuite", name=xml_text(f"ctxval {context.name}"))
    kinds = {"falsified": "failure", "bad": "failure", "undecided": "skipped", "unknown": "skipped"}

    def add(classname: str, name: str, result: str, text: str) -> None:
        case = ElementTree.SubElement(suite, "testcase", classname=classname, name=xml_text(name))
        if result in kinds:
            ElementTree.SubElement(case, kinds[result], message=xml_text(text))
        elif text:
            ElementTree.SubElement(case, "system-out").text = xml_text(text)

    verdict = context.verdict
    answer, reason = ("undecided", "no threshold was given") if verdict is None else (verdict.answer, str(verdict))
    add("ctxval", "verdict", answer, "" if answer == "validated" else reason)
    for finding in context.diagnostics:
        add("ctxval.diagnostics", finding.name, finding.light, finding.text)
    failures, skipped = (len(suite.findall(f"testcase/{tag}")) for tag in ("failure", "skipped"))
    seconds = f"{sum(trial.seconds or 0.0 for trial in context.trials):.3f}"
    counts = {"tests": len(suite), "failures": failures, "skipped": skipped, "errors": 0, "time": seconds}
    suite.attrib |= {name: str(value) for name, value in counts.items()}
    ElementTree.indent(suite)
    content = ElementTree.tostring(suite, encoding="unicode")
    return f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {MADE_BY} -->\n{content}\n'


def markdown(context: ReportContext) -> str:
    """Return the report without its charts as Markdown; texts of the store cannot become markup."""
    units, verdict, known = context.labels.units, context.verdict, context.envelope
    answer = "No verdict: no threshold was given." if verdict is None else f"{verdict}"
    trials = context.worst_tasks()
    rows = []
    for trial, task in zip(trials, context.tasks_of(trials), strict=True):
        values = (value if isinstance(value, str) else number(value) for value in task)
        cells = (str(trial.number), quantity(distance_of(trial), units), *values)
        rows.append(f"| {' | '.join(map(markdown_text, cells))} |")
    entries = [
        f"- **{markdown_text(entry.term)}** ({entry.standard}): {markdown_text(entry.content, UNCUT)}"
        for entry in appendix(context)
    ]

    def items(findings: list[Finding]) -> list[str]:
        texts = ((WORDS[each.light], markdown_text(each.name), markdown_text(each.text)) for each in findings)
        return [f"- {light}: **{name}.** {text}" for light, name, text in texts] or ["Nothing is unusual."]

    head = f"| trial | distance | {' | '.join(map(markdown_text, context.task_labels))} |"
    parts = {
        "Diagnostics": items(context.diagnostics),
        "Insights": items(context.insights),
        "What was not tested": [f"- {markdown_text(sentence)}" for sentence in context.not_tested],
        "Worst tasks": [head, f"|{'---|' * (2 + len(context.task_labels))}", *rows],
        "For the file": entries,
    }
    blocks = [
        f"# Validation of {markdown_text(context.name) or 'campaign'}",
        f"**{markdown_text(answer)}**",
        f"{context.executions} executions, {len(context.failed)} without a distance.",
        *([] if known is None else [markdown_text(f"{known.statement} {known.words}", UNCUT)]),
        *(block for title, lines in parts.items() for block in (f"## {title}", "\n".join(lines))),
        f"<!-- {MADE_BY} -->",
    ]
    return "\n\n".join(blocks) + "\n"
