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
from ctxval.report.context import ReportContext, distance_of
from ctxval.report.diagnostics import diagnostics, not_tested
from ctxval.report.findings import WORDS, Finding
from ctxval.report.insights import insights
from ctxval.report.markup import UNCUT, number, quantity
from ctxval.report.sections.appendix import appendix
from ctxval.report.sections.repeat import command_snippet, identity, python_snippet, repeating_command


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
            "missing": context.missing or None,
            "diagnostics": [finding.to_json() for finding in diagnostics(context)],
            "insights": [finding.to_json() for finding in insights(context)],
            "not_tested": not_tested(context),
            "worst": [
                {
                    "trial": trial.number,
                    "task": trial.parameters,
                    "distance": distance_of(trial),
                    "python": python_snippet(context, trial),
                    "command": command_snippet(context, trial),
                }
                for trial in context.worst_tasks(5)
            ],
            "command": repeating_command(context) or None,
            "identity": identity(context),
            "appendix": [asdict(entry) for entry in appendix(context)],
        }
        plain: dict[str, Any] = json.loads(json.dumps(describe(report, depth=12), allow_nan=False))
    return plain


def junit(context: ReportContext) -> str:
    """Return the verdict and the diagnostics as JUnit XML: one test for each.

    The verdict fails if M is falsified, and is skipped if it is undecided. A diagnostic fails if it speaks against the
    verdict, and is skipped if it is not known.
    """
    answers = {"validated": None, "falsified": "failure", "undecided": "skipped"}
    if context.verdict is None:
        cases = [_case("ctxval", "verdict", "skipped", "no threshold was given")]
    else:
        tag = answers[context.verdict.answer]
        cases = [_case("ctxval", "verdict", tag, "" if tag is None else str(context.verdict))]
    lights = {"bad": "failure", "unknown": "skipped"}
    for finding in diagnostics(context):
        cases.append(_case("ctxval.diagnostics", finding.name, lights.get(finding.light), finding.text))
    counts = {kind: sum(case.find(kind) is not None for case in cases) for kind in ("failure", "skipped")}
    suite = ElementTree.Element(
        "testsuite",
        name=_xml_text(f"ctxval {context.name}"),
        tests=str(len(cases)),
        failures=str(counts["failure"]),
        skipped=str(counts["skipped"]),
        errors="0",
        time=f"{sum(trial.seconds or 0.0 for trial in context.trials):.3f}",
    )
    suite.extend(cases)
    ElementTree.indent(suite)
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {MADE_BY} -->\n'
        + ElementTree.tostring(suite, encoding="unicode")
        + "\n"
    )


def _case(group: str, name: str, tag: str | None, message: str) -> ElementTree.Element:
    """Return one test, which has passed unless there is a tag that says how it ended."""
    case = ElementTree.Element("testcase", classname=group, name=_xml_text(name))
    if tag is not None:
        ElementTree.SubElement(case, tag, message=_xml_text(message))
    elif message:
        ElementTree.SubElement(case, "system-out").text = _xml_text(message)
    return case


def _xml_text(words: str) -> str:
    """Return a text that XML can hold: control characters are written out."""
    return shortened(visible(words).replace("\ufffe", "").replace("\uffff", ""))


def markdown(context: ReportContext) -> str:
    """Return the report without its charts as Markdown; texts of the store cannot become markup."""
    units, verdict, worst = context.labels.units, context.verdict, context.worst_tasks(5)
    rows = [
        f"| {trial.number} | {markdown_text(quantity(distance_of(trial), units))} | {' | '.join(map(number, point))} |"
        for trial, point in zip(worst, context.coordinates(worst).tolist(), strict=True)
    ]
    answer = "No verdict: no threshold was given." if verdict is None else f"{verdict}"
    lines = [
        f"# Validation of {markdown_text(context.name) or 'campaign'}",
        "",
        f"**{markdown_text(answer)}**",
        "",
        f"{context.executions} executions, {len(context.failed)} without a distance.",
        "",
        "## Diagnostics",
        "",
        *_items(diagnostics(context)),
        "",
        "## Insights",
        "",
        *_items(insights(context)),
        "",
        "## What was not tested",
        "",
        *(f"- {markdown_text(sentence)}" for sentence in not_tested(context)),
        "",
        "## Worst tasks",
        "",
        f"| trial | distance | {' | '.join(map(markdown_text, context.space.labels))} |",
        f"|{'---|' * (2 + context.space.dimension)}",
        *rows,
        "",
        "## For the file",
        "",
        *(
            f"- **{markdown_text(entry.term)}** ({entry.standard}): {markdown_text(entry.content, UNCUT)}"
            for entry in appendix(context)
        ),
        "",
        f"<!-- {MADE_BY} -->",
        "",
    ]
    return "\n".join(lines)


def _items(findings: list[Finding]) -> list[str]:
    return [
        f"- {WORDS[finding.light]}: **{markdown_text(finding.name)}.** {markdown_text(finding.text)}"
        for finding in findings
    ] or ["Nothing is unusual."]
