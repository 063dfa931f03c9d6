"""The sections of a report: each is a small class with a title and a method ``render``."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Protocol, runtime_checkable

from ctxval._util.texts import reason_of
from ctxval.errors import InputError
from ctxval.report.context import ReportContext
from ctxval.report.sections.appendix import AppendixSection
from ctxval.report.sections.basis import BasisSection, InsightsSection
from ctxval.report.sections.convergence import ConvergenceSection
from ctxval.report.sections.repeat import RepeatSection
from ctxval.report.sections.tasks import TasksSection
from ctxval.report.sections.trials import TrialsSection
from ctxval.report.sections.verdict import VerdictSection

GROUP = "ctxval.report_sections"
"""Group of the entry points by which installed packages add sections: each is a class or an object of a section."""


@runtime_checkable
class Section(Protocol):
    """A section of a report.

    Attributes:
        title: its heading.
    """

    title: str

    def render(self, context: ReportContext) -> str:
        """Return the content: ``Markup`` stays as it is, any other text becomes one escaped paragraph.

        A section that raises an exception does not prevent the report: it shows the reason instead.
        """


SECTIONS: tuple[Section, ...] = (
    VerdictSection(),
    BasisSection(),
    InsightsSection(),
    TasksSection(),
    TrialsSection(),
    ConvergenceSection(),
    RepeatSection(),
    AppendixSection(),
)
"""The sections of every report, in their order."""


def all_sections(added: Sequence[Section]) -> list[Section]:
    """Return the sections of every report, those of installed packages, and those that the user adds."""
    installed: list[Section] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        try:
            loaded = point.load()
            installed.append(loaded() if isinstance(loaded, type) else loaded)
        except Exception as error:  # another package's code
            raise InputError(f"the section {point.name!r} cannot be loaded: {reason_of(error)}.") from error
    sections = [*SECTIONS, *installed, *added]
    for section in sections:
        if not isinstance(section, Section) or not isinstance(section.title, str):
            raise InputError(f"a section must have a title and a method render(context), got {section!r}.")
    return sections
