"""The contract of a section, and the sections that installed packages add."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Protocol, runtime_checkable

from ctxval._util.texts import reason_of
from ctxval.errors import InputError
from ctxval.report.context import ReportContext

GROUP = "ctxval.report_sections"
"""Group of the entry points by which installed packages add sections: each is a class or an object of a section."""


@runtime_checkable
class Section(Protocol):
    """A section of a report."""

    title: str

    def render(self, context: ReportContext) -> str:
        """Return the content: ``Markup`` stays as it is, any other text becomes one escaped paragraph.

        A section that raises an exception does not prevent the report: it shows the reason instead.
        """


def sections_of(own: Sequence[Section], added: Sequence[Section]) -> list[Section]:
    """Return the sections of a report: the own ones, those of installed packages, and those that are added."""
    installed: list[Section] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        try:
            loaded = point.load()
            installed.append(loaded() if isinstance(loaded, type) else loaded)
        except Exception as error:  # another package's code
            raise InputError(f"the section {point.name!r} cannot be loaded: {reason_of(error)}.") from error
    sections = [*own, *installed, *added]
    for section in sections:
        if not isinstance(section, Section) or not isinstance(section.title, str):
            raise InputError(f"a section must have a title and a method render(context), got {section!r}.")
    return sections
