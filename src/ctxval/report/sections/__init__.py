"""The sections of a report: each has a title and a method ``render``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol, runtime_checkable

from ctxval._util.refusals import reworded
from ctxval.errors import InputError
from ctxval.report.context import ReportContext
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


def all_sections(added: Sequence[Section]) -> list[Section]:
    """Return the sections of every report, those of installed packages, and those that the user adds."""
    installed: list[Section] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        with reworded(f"the section {point.name!r} cannot be loaded"):  # another package's code
            loaded = point.load()
            installed.append(loaded() if isinstance(loaded, type) else loaded)
    sections = [*SECTIONS, *installed, *added]
    for section in sections:
        if not isinstance(section, Section) or not isinstance(section.title, str):
            raise InputError(f"a section must have a title and a method render(context), got {section!r}.")
    return sections
