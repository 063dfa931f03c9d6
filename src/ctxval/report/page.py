"""The page of a report: one file with its style, its script and its data, which opens no connection."""

from __future__ import annotations

import base64
import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from markupsafe import Markup

from ctxval._util.files import write_text
from ctxval._util.refusals import reworded
from ctxval._util.texts import reason_of, visible
from ctxval._util.version import VERSION
from ctxval.errors import InputError
from ctxval.report.context import ReportContext
from ctxval.report.markup import element, joined, paragraph, text
from ctxval.report.sections.distances import convergence, distances
from ctxval.report.sections.repeat import for_the_file, repeat
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
    _Part("To repeat it", repeat),
    _Part("For the file", for_the_file),
)
"""The sections of every report, in their order."""


def page(context: ReportContext, sections: Sequence[Section] = ()) -> str:
    """Return a report as one HTML page; ``sections`` follow those that every report has and installed packages add."""
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
    style, script = (
        (files("ctxval.report") / "assets" / name).read_text("utf-8") for name in ("report.css", "report.js")
    )
    of_script, of_style = (
        base64.b64encode(hashlib.sha256(asset.encode()).digest()).decode() for asset in (script, style)
    )
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
    inside = (
        joined([head, shown])
        if first
        else element("details", element("summary", head), shown, open=None if folded else True)
    )
    return element("section", inside, id=f"section-{number}", aria_labelledby=label)


def now() -> str:
    """Return the present time in UTC, for the subtitle of a page."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
