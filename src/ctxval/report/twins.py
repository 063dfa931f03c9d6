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

_WORST = 5


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
                for trial in context.worst_tasks(_WORST)
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
    checks = diagnostics(context)
    cases = [_verdict_case(context), *(_case(finding) for finding in checks)]
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


def _verdict_case(context: ReportContext) -> ElementTree.Element:
    case = ElementTree.Element("testcase", classname="ctxval", name="verdict")
    verdict = context.verdict
    if verdict is None:
        ElementTree.SubElement(case, "skipped", message="no threshold was given")
    elif verdict.answer != "validated":
        tag = "failure" if verdict.answer == "falsified" else "skipped"
        ElementTree.SubElement(case, tag, message=_xml_text(str(verdict)))
    return case


def _case(finding: Finding) -> ElementTree.Element:
    case = ElementTree.Element("testcase", classname="ctxval.diagnostics", name=_xml_text(finding.name))
    if finding.light in ("bad", "unknown"):
        tag = "failure" if finding.light == "bad" else "skipped"
        ElementTree.SubElement(case, tag, message=_xml_text(finding.text))
    else:
        ElementTree.SubElement(case, "system-out").text = _xml_text(finding.text)
    return case


def _xml_text(words: str) -> str:
    """Return a text that XML can hold: control characters are written out."""
    return shortened(visible(words).replace("\ufffe", "").replace("\uffff", ""))


def markdown(context: ReportContext) -> str:
    """Return the report without its charts as Markdown; texts of the store cannot become markup."""
    units, verdict = context.labels.units, context.verdict
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
        *(f"- {markdown_text(one)}" for one in not_tested(context)),
        "",
        "## Worst tasks",
        "",
        f"| trial | distance | {' | '.join(map(markdown_text, context.space.labels))} |",
        f"|{'---|' * (2 + context.space.dimension)}",
        *_worst_rows(context, units),
        "",
        "## For the file",
        "",
        *(
            f"- **{markdown_text(one.term)}** ({one.standard}): {markdown_text(one.content, UNCUT)}"
            for one in appendix(context)
        ),
        "",
        f"<!-- {MADE_BY} -->",
        "",
    ]
    return "\n".join(lines)


def _items(findings: list[Finding]) -> list[str]:
    return [f"- {WORDS[one.light]}: **{markdown_text(one.name)}.** {markdown_text(one.text)}" for one in findings] or [
        "Nothing is unusual."
    ]


def _worst_rows(context: ReportContext, units: str) -> list[str]:
    trials = context.worst_tasks(_WORST)
    return [
        f"| {trial.number} | {markdown_text(quantity(distance_of(trial), units))} | {' | '.join(map(number, point))} |"
        for trial, point in zip(trials, context.coordinates(trials).tolist(), strict=True)
    ]
