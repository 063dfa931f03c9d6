"""The one reader of CSV files: a header, and rows with as many cells as it has.

Columns are separated by commas, semicolons or tabs. With semicolons and tabs, numbers may have decimal commas.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import require_distinct
from ctxval._util.files import MOST_BYTES, open_regular
from ctxval._util.texts import unguarded
from ctxval.errors import InputError

MOST_ROW = 2**20  # largest number of characters in a row


class CsvTable:
    """The cells of a CSV file of at most so many bytes, and the names of its columns, empty ones where it has none."""

    def __init__(self, path: str | Path, most: int = MOST_BYTES) -> None:
        self.path, self._most, self._separator = path, most, ","
        self._marks: dict[str, int] = {}
        first = next(self._cells(), (0, list[str]()))[1]
        self.names = tuple(unguarded(name).strip() for name in first)
        require_distinct(str(path), self.names)

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the rows below the header that are not blank, each with the number of its last line.

        Only the last row may be shorter than the header, because a trajectory has no inputs at its last time.
        """
        width, short = len(self.names), ""
        for line, row in itertools.islice(self._cells(), 1, None):
            if len(row) != width and not short:
                short = f"{self.path}, line {line}: the row must have {width} cells, as the header has, got {len(row)}."
                if len(row) < width:
                    yield line, row + [""] * (width - len(row))
                    continue
                if self._separator == ",":
                    short += " If commas are decimal commas, semicolons must separate the columns."
            if short:
                raise InputError(short)
            yield line, row

    def columns(
        self, names: Sequence[str], *, missing: Sequence[str] = (), last: Sequence[str] = (), most: int | None = None
    ) -> dict[str, Array]:
        places = {name: place for place, name in enumerate(self.names)}
        columns = {name: array("d") for name in names}
        wrong: InputError | None = None
        for count, (line, row) in enumerate(self.rows(), 1):
            if wrong is not None:
                raise wrong
            if most is not None and count > most:
                raise InputError(f"{self.path} must have {most} rows below its header, and has more.")
            if 8 * len(names) * count > MOST_BYTES:
                raise InputError(f"{self.path} has too many numbers: {MOST_BYTES} bytes may be read.")
            for name, numbers in columns.items():
                cell = row[places[name]]
                try:
                    empty = name in missing and cell.strip().lower() in ("", "nan", "na", "null", "none", "-")
                    numbers.append(math.nan if empty else self.number(line, name, cell))
                except InputError as error:
                    if name not in last:
                        raise
                    wrong = wrong or error
                    numbers.append(math.nan)
        return {name: np.array(numbers) for name, numbers in columns.items()}

    def texts(self, name: str) -> Array:
        place = self.names.index(name)
        return np.array([row[place].strip() for _, row in self.rows()])

    def number(self, line: int, name: str, cell: str) -> float:
        text = cell
        if self._separator != ",":
            mark = "," if "," in cell else "." if "." in cell else ""
            if mark:
                self._marks.setdefault(mark, line)
            if len(self._marks) > 1:
                commas, points = f"commas (line {self._marks[',']})", f"points (line {self._marks['.']})"
                raise InputError(f"{self.path} has decimal {commas} and {points} in numbers: use one mark.")
            text = cell.replace(",", ".")
        try:
            if "_" in text:
                raise ValueError
            return float(text)
        except ValueError:
            shown = f"got {cell[:60]!r}" if cell.strip() else "and the cell is empty"
            raise InputError(f"{self.path}, line {line}: {name} must be a number, {shown}.") from None

    def _cells(self) -> Iterator[tuple[int, list[str]]]:
        try:
            with (
                open_regular(self.path, self._most) as file,
                io.TextIOWrapper(file, encoding="utf-8-sig", newline="") as text,
            ):
                lines = _Lines(text, self._most)
                head = [*itertools.takewhile(lambda line: not line.strip(), lines), lines.last]
                unquoted = re.sub('"[^"]*"', "", lines.last)
                self._separator = next((mark for mark in ("\t", ";") if mark in unquoted), ",")
                reader = csv.reader(itertools.chain(head, lines), delimiter=self._separator)
                for row in reader:
                    lines.in_row = 0
                    if len(row) > 1 or (row and row[0].strip()):
                        yield reader.line_num, row
        except (InputError, OSError, UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{self.path} cannot be read as CSV: {str(error).removesuffix('.')}.") from error


class _Lines:
    """The lines of a text; ``in_row`` counts the characters since the end of the last row."""

    def __init__(self, text: io.TextIOWrapper, most: int) -> None:
        self.text, self.left, self.in_row, self.last = text, most, 0, ""

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        line = self.last = self.text.readline(MOST_ROW + 1)
        if not line:
            raise StopIteration
        self.in_row += len(line)
        self.left -= len(line)
        if self.in_row > MOST_ROW:
            raise InputError(f"it has a row of more than {MOST_ROW} characters")
        if self.left < 0:
            raise InputError("it grew while it was read")
        if "\0" in line:
            raise InputError("it is not text in UTF-8: it has NUL bytes")
        return line
