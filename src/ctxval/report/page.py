"""The page of a report: one file with its style, its script and its data, which opens no connection."""

from __future__ import annotations

import base64
import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
from markupsafe import Markup

from ctxval._util.files import write_text
from ctxval._util.texts import reason_of, visible
from ctxval.report.context import ReportContext
from ctxval.report.markup import paragraph, text
from ctxval.report.sections import SECTIONS, Section, sections_of
from ctxval.version import VERSION

if TYPE_CHECKING:
    import jinja2


Context = TypeVar("Context", contravariant=True)


class SectionOf(Protocol[Context]):
    """A section that is made from something: its heading, and its content."""

    @property
    def title(self) -> str:
        """The heading."""

    def render(self, context: Context) -> str:
        """Return the content."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """A section with its content."""

    title: str
    content: Markup


def page(context: ReportContext, sections: Sequence[Section] = ()) -> str:
    """Return a report as one HTML page; further sections follow those that every report has.

    Raises:
        InputError: if a section is none.
    """
    with np.errstate(all="ignore"):  # a store may have any numbers
        rendered = [rendered_section(section, context) for section in sections_of(SECTIONS, sections)]
    name = visible(context.name) or "campaign"
    made = f"Store {context.store.name}; report made {now()}."
    return framed(f"Validation of {name}", made, rendered, folded=True)


def framed(title: str, subtitle: str, sections: Sequence[Rendered], *, folded: bool = False) -> str:
    """Return sections in the frame of every page; ``folded`` folds all but the first one."""
    style, script = _asset("report.css"), _asset("report.js")
    return _template().render(
        title=text(title, 200),
        subtitle=text(subtitle, 600),
        # Nothing but the style and the script of this page, and data images.
        policy=f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'",
        style=Markup(style),
        script=Markup(script),
        sections=sections,
        folded=folded,
        version=VERSION,
    )


def now() -> str:
    """Return the present time in UTC, for the subtitle of a page."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def write_page(context: ReportContext, path: str | Path, sections: Sequence[Section] = ()) -> Path:
    """Write a report as one HTML file.

    Raises:
        InputError: if the file cannot be written or is a store, or a section is none.
    """
    return write_text(path, page(context, sections))


def rendered_section(section: SectionOf[Context], context: Context) -> Rendered:
    """Return a section with its content; one that fails says why, and the others are shown."""
    title = text(section.title, 200)
    try:
        content = section.render(context)
    except Exception as error:  # a user's own section, or odd data
        return Rendered(title, paragraph(f"This section cannot be shown: {reason_of(error)}."))
    whole = content.__html__() if hasattr(content, "__html__") else None
    return Rendered(title, Markup(whole) if whole is not None else paragraph(str(content)))


def _hash(content: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}"


def _asset(name: str) -> str:
    return (files("ctxval.report") / "assets" / name).read_text(encoding="utf-8")


@functools.cache
def _template() -> jinja2.Template:
    import jinja2  # imported here, because no other command needs it

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(_asset("page.html"))
