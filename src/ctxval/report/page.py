"""The page of a report: one file that opens no connection; and the same report as JSON, JUnit and Markdown."""

from __future__ import annotations

import base64
import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from xml.etree import ElementTree

import numpy as np
from markupsafe import Markup

from ctxval._util.describe import describe
from ctxval._util.files import MADE_BY, write_text
from ctxval._util.refusals import reworded
from ctxval._util.texts import markdown_text, reason_of, shortened, visible
from ctxval._util.version import VERSION
from ctxval.errors import InputError
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import distance_of
from ctxval.report.findings import WORDS, Finding
from ctxval.report.markup import UNCUT, element, joined, number, paragraph, quantity, text
from ctxval.report.sections import repeat
from ctxval.report.sections.distances import convergence, distances
from ctxval.report.sections.trials import trials
from ctxval.report.sections.verdict import basis, lights, verdict

GROUP = "ctxval.report_sections"
"""Group of the entry points by which installed packages add sections: each is a class or an object of a section."""


@runtime_checkable
class Section(Protocol):
    """A section of a report."""

    title: str  #: its heading

    def render(self, context: ReportContext) -> str:
        """Return the content: ``Markup`` stays as it is, any other text becomes one escaped paragraph.

        A section that raises an exception does not prevent the report: it shows the reason instead.
        """


@dataclass
class _Part:
    title: str
    render: Callable[[ReportContext], str]


SECTIONS: tuple[Section, ...] = (
    _Part("Verdict", verdict),
    _Part("Assumptions and diagnostics", basis),
    _Part("Insights", lambda context: lights(context.insights)),
    _Part("Distance over the tasks", distances),
    _Part("Trials", trials),
    _Part("Convergence", convergence),
    _Part("To repeat it", repeat.repeat),
)
"""The sections of every report, in their order."""


def page(context: ReportContext, sections: Sequence[Section] = ()) -> str:
    """Return a report as one HTML page; ``sections`` follow those that every report has and installed packages add.

    Raises:
        InputError: if a section has no title or no ``render``.
    """
    installed: list[Section] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        with reworded(f"the section {point.name!r} cannot be loaded"):  # another package's code
            loaded = point.load()
            installed.append(loaded() if isinstance(loaded, type) else loaded)
    parts = []
    for section in (*SECTIONS, *installed, *sections):
        if not isinstance(section, Section) or not isinstance(section.title, str):
            raise InputError(f"a section must have a title and a method render(context), got {section!r}.")
        parts.append((section.title, functools.partial(section.render, context)))
    name = visible(context.name) or "campaign"
    return framed(f"Validation of {name}", f"Store {context.store.name}; report made {now()}.", parts, folded=True)


def write_page(context: ReportContext, path: str | Path, sections: Sequence[Section] = ()) -> Path:
    """Write a report as one HTML file; see :func:`page`."""
    return write_text(path, page(context, sections))


def framed(
    title: str, subtitle: str, sections: Sequence[tuple[str, Callable[[], object]]], *, folded: bool = False
) -> str:
    """Return sections, each a title and a function that renders it, in the frame of every page.

    A section that fails says why, and the others are shown; ``folded`` folds all but the first one.
    """
    assets = files("ctxval.report") / "assets"
    charts, own, script = ((assets / name).read_text("utf-8") for name in ("charts.css", "report.css", "report.js"))
    style = charts + own
    digests = (hashlib.sha256(asset.encode()).digest() for asset in (script, style))
    of_script, of_style = (base64.b64encode(digest).decode() for digest in digests)
    # Nothing but the style and the script of this page runs, and only data images are shown.
    policy = (
        f"default-src 'none'; script-src 'sha256-{of_script}'; style-src 'sha256-{of_style}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    heading, made = text(title, 200), "This file contains everything that it shows and opens no connection."
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", name="referrer", content="no-referrer"),
        element("title", heading),
        element("style", Markup(style)),
    )
    with np.errstate(all="ignore"):  # a store may have any numbers
        shown = [_section(place, *titled, folded=folded) for place, titled in enumerate(sections, start=1)]
    body = element(
        "body",
        element("header", element("h1", heading), paragraph(text(subtitle, 600), class_="note")),
        element("main", *shown),
        element("footer", paragraph(f"Made by ctxval {VERSION}. {made}", class_="note")),
        element("script", Markup(script)),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _section(number: int, title: str, render: Callable[[], object], *, folded: bool) -> Markup:
    try:
        content = render()
    except Exception as error:  # a user's own section, or odd data
        content = paragraph(f"This section cannot be shown: {reason_of(error)}.")
    shown = content if hasattr(content, "__html__") else paragraph(str(content))
    first, label = folded and number == 1, f"heading-{number}"
    head = element("h2", text(title, 200), id=label, class_="hidden" if first else None)
    folds = element("details", element("summary", head), shown, open=None if folded else True)
    inside = joined([head, shown]) if first else folds
    return element("section", inside, id=f"section-{number}", aria_labelledby=label)


def now() -> str:
    """Return the present time in UTC, for the subtitle of a page."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def to_json(context: ReportContext) -> dict[str, Any]:
    """Return the verdict, the findings, the worst tasks and what repeats them, ready for JSON."""
    verdict, certificate = context.verdict, context.certificate
    with np.errstate(all="ignore"):  # a store may have any numbers
        report = {
            "name": context.name,
            **({} if verdict is None else verdict.to_json()),
            "units": context.labels.units,
            "executions": context.executions,
            "failed": context.failed.numbers,
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
                    "python": repeat.python_snippet(context, trial),
                    "command": repeat.command_snippet(context, trial),
                }
                for trial in context.worst_tasks()
            ],
            "command": repeat.repeating_command(context) or None,
            "identity": repeat.identity(context),
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


def picture(context: ReportContext) -> str:
    """Return the executed distances and the threshold as a chart in Mermaid, which GitHub and GitLab draw.

    With one task parameter, the distances are in its order; otherwise in the order of execution. Of many, the largest
    40 are shown. It is empty if no distance is known.
    """
    trials = sorted(context.worst_first[:40], key=lambda trial: trial.number)
    along = context.axes == 1
    names = [str(trial.number) for trial in trials]
    if along:
        trials.sort(key=lambda trial: float(trial.unit_point[0]))
        names = [number(place) for place in context.coordinates(trials)[:, 0]]
    if not trials:
        return ""

    def quoted(words: str) -> str:
        return '"' + "".join(" " if letter in '"`<>;' else letter for letter in visible(words)) + '"'

    shown, tau = [f"{distance_of(trial):.6g}" for trial in trials], context.threshold
    limits = [] if tau is None else [f"  line [{', '.join([f'{tau:.6g}'] * len(shown))}]"]
    top = 1.05 * max(float(context.distances.max()), tau or 0.0) or 1.0
    lines = [
        "```mermaid",
        "xychart-beta",
        f"  x-axis {quoted(context.task_labels[0] if along else 'trial')} [{', '.join(map(quoted, names))}]",
        f"  y-axis {quoted(context.distance_label)} 0 --> {top:.4g}",
        f"  bar [{', '.join(shown)}]",
        *limits,
        "```",
    ]
    return "\n".join(lines)


def markdown(context: ReportContext) -> str:
    """Return the report as Markdown with one :func:`picture`; texts of the store cannot become markup."""
    units, verdict, known = context.labels.units, context.verdict, context.envelope
    answer = "No verdict: no threshold was given." if verdict is None else f"{verdict}"
    trials = context.worst_tasks()
    rows = []
    for trial, task in zip(trials, context.tasks_of(trials), strict=True):
        values = (value if isinstance(value, str) else number(value) for value in task)
        cells = (str(trial.number), quantity(distance_of(trial), units), *values)
        rows.append(f"| {' | '.join(map(markdown_text, cells))} |")

    def items(findings: list[Finding]) -> list[str]:
        texts = ((WORDS[each.light], markdown_text(each.name), markdown_text(each.text)) for each in findings)
        return [f"- {light}: **{name}.** {text}" for light, name, text in texts] or ["Nothing is unusual."]

    head = f"| trial | distance | {' | '.join(map(markdown_text, context.task_labels))} |"
    parts = {
        "Diagnostics": items(context.diagnostics),
        "Insights": items(context.insights),
        "What was not tested": [f"- {markdown_text(sentence)}" for sentence in context.not_tested],
        "Worst tasks": [head, f"|{'---|' * (2 + len(context.task_labels))}", *rows],
    }
    blocks = [
        f"# Validation of {markdown_text(context.name) or 'campaign'}",
        f"**{markdown_text(answer)}**",
        f"{context.executions} executions, {len(context.failed)} without a distance.",
        *filter(None, [picture(context)]),
        *([] if known is None else [markdown_text(f"{known.statement} {known.words}", UNCUT)]),
        *(block for title, lines in parts.items() for block in (f"## {title}", "\n".join(lines))),
        f"<!-- {MADE_BY} -->",
    ]
    return "\n\n".join(blocks) + "\n"
