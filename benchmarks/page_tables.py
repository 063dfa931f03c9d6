"""Pages that are generated from stored results, with long tables in files of ``docs/tables``."""

from __future__ import annotations

import csv
import io
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from scipy.stats import beta

DOCS = Path(__file__).parents[1] / "docs"

Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""A header, and rows of cells."""


@dataclass(frozen=True)
class GeneratedPage:
    """A page of the manual and the tables beside it.

    Attributes:
        name: the page's path in ``docs``.
        text: its content, which links to each table.
        tables: by the names of their files in ``docs/tables``, without the ending.
    """

    name: str
    text: str
    tables: Mapping[str, Table] = field(default_factory=dict)

    def files(self) -> dict[Path, str]:
        """Return the content of each file."""
        tables = {DOCS / "tables" / f"{name}.csv": csv_text(table) for name, table in self.tables.items()}
        return {DOCS / self.name: self.text, **tables}

    def write(self) -> None:
        """Write all files."""
        for path, content in self.files().items():
            path.parent.mkdir(exist_ok=True)
            path.write_text(content)
        print(f"page: docs/{self.name}")

    def outdated(self) -> list[str]:
        """Return the names of the files that differ from the stored results, and of tables without a link."""
        differing = [path.name for path, text in self.files().items() if not path.exists() or path.read_text() != text]
        return differing + [name for name in self.tables if f"(tables/{name}.csv)" not in self.text]


def reflowed(text: str) -> str:
    """Return a page whose paragraphs and lists have lines of at most 120 characters."""
    blocks = re.split(r"(\n\n+|(?:^|\n)```.*?```|\n(?=(?:- |\d+\. )))", text, flags=re.DOTALL)
    return "".join(block if _is_kept(block) else _filled(block) for block in blocks)


def _is_kept(block: str) -> bool:
    return not block.strip() or block.lstrip("\n").startswith(("|", "#", "![", "```", "<", "$$"))


def _filled(block: str) -> str:
    indent = " " * len(match[0]) if (match := re.match(r"- |\d+\. ", block)) else ""
    end = "\n" if block.endswith("\n") else ""
    kept = re.sub(r"`[^`]+`|\$[^$]+\$|\d %", lambda found: found[0].replace(" ", "\0"), " ".join(block.split()))
    filled = textwrap.fill(kept, 120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return filled.replace("\0", " ") + end


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(line) + " |" for line in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])


def included(name: str) -> str:
    """Return what shows a file of ``docs/tables`` as a table of the manual, and a link to it for other readers."""
    return f"```{{csv-table}}\n:file: tables/{name}.csv\n:header-rows: 1\n```\n\n([as a file](tables/{name}.csv))"


def csv_text(table: Table) -> str:
    """Return a table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([table[0], *table[1]])
    return text.getvalue()


def interval(missed: int, total: int) -> tuple[float, float]:
    """Return the 95 % Clopper-Pearson interval of a coverage in per cent."""
    low = beta.ppf(0.025, total - missed, missed + 1) if missed < total else 0.0
    high = beta.ppf(0.975, total - missed + 1, missed) if missed else 1.0
    return 100 * float(low), 100 * float(high)


def share_of(count: int, total: int) -> str:
    """Return a count with its share and the upper limit of this share, with confidence 97.5 %."""
    most = 100 - interval(count, total)[0]
    return f"{count} of {total} ({100 * count / total:.2g} %, at most {most:.2g} %)" if total else "-"
