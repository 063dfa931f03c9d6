"""The page of a report: one file with its style, its script and its data, which opens no connection."""

from __future__ import annotations

import base64
import functools
import hashlib
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from markupsafe import Markup

from ctxval._util.files import write_text
from ctxval._util.texts import reason_of, visible
from ctxval._util.version import VERSION
from ctxval.report.context import ReportContext
from ctxval.report.markup import paragraph, text
from ctxval.report.sections import Section, all_sections

if TYPE_CHECKING:
    import jinja2


class Rendered(NamedTuple):
    """A section with its content."""

    title: Markup
    content: Markup


def page(context: ReportContext, sections: Sequence[Section] = ()) -> str:
    """Return a report as one HTML page; ``sections`` follow those that every report has."""
    with np.errstate(all="ignore"):  # a store may have any numbers
        whole = all_sections(sections)
        parts = [rendered(section.title, functools.partial(section.render, context)) for section in whole]
    name = visible(context.name) or "campaign"
    return framed(f"Validation of {name}", f"Store {context.store.name}; report made {now()}.", parts, folded=True)


def write_page(context: ReportContext, path: str | Path, sections: Sequence[Section] = ()) -> Path:
    """Write a report as one HTML file; see :func:`page`."""
    return write_text(path, page(context, sections))


def rendered(title: str, render: Callable[[], object]) -> Rendered:
    """Return a section with its content; one that fails says why, and the others are shown."""
    try:
        content = render()
    except Exception as error:  # a user's own section, or odd data
        content = paragraph(f"This section cannot be shown: {reason_of(error)}.")
    return Rendered(text(title, 200), text(content) if hasattr(content, "__html__") else paragraph(str(content)))


def framed(title: str, subtitle: str, sections: Sequence[Rendered], *, folded: bool = False) -> str:
    """Return sections in the frame of every page; ``folded`` folds all but the first one."""
    style, script = map(_asset, ("report.css", "report.js"))
    digests = [base64.b64encode(hashlib.sha256(asset.encode()).digest()).decode() for asset in (style, script)]
    # Nothing but the style and the script of this page runs, and only data images are shown.
    policy = (
        f"default-src 'none'; script-src 'sha256-{digests[1]}'; style-src 'sha256-{digests[0]}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    return _template().render(
        title=text(title, 200),
        subtitle=text(subtitle, 600),
        policy=policy,
        style=Markup(style),
        script=Markup(script),
        sections=sections,
        folded=folded,
        version=VERSION,
    )


def now() -> str:
    """Return the present time in UTC, for the subtitle of a page."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def _asset(name: str) -> str:
    return (files("ctxval.report") / "assets" / name).read_text(encoding="utf-8")


@functools.cache
def _template() -> jinja2.Template:
    import jinja2  # imported here, because no other command needs it

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(_asset("page.html"))
