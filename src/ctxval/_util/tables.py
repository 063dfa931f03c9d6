"""The reader of CSV files, as programs and loggers write them.

The module ``csv`` splits rows. pandas and polars find neither the encoding nor a row of units, a repeated header or a
footer, and say no line of what they cannot read, so they would save no rule of this file. Every rule finds where the
table is. No rule changes a number: a cell that is used is a number, or the file is refused with its line.
"""

from __future__ import annotations

import codecs
import csv
import io
import itertools
import math
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import is_unit, named_unit, require_distinct
from ctxval._util.files import MOST_BYTES, open_regular
from ctxval._util.refusals import reworded
from ctxval._util.texts import number_in, unguarded
from ctxval.errors import InputError

_SEPARATORS = ("\t", ";", ",", "|", " ")  # the first of those that split most rows alike; a blank stands for several
_MARKS = (
    "nan na n/a null none - -- --- ? <null> #n/a #na #value! #div/0! #num! #ref! #null! missing bad nil "
    "-nan nan(ind) -nan(ind) 1.#ind -1.#ind 1.#qnan -1.#qnan 1.#snan -1.#snan 1.#inf -1.#inf"
)
_MISSING = frozenset(_MARKS.split())
_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?", re.ASCII)
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
_MOMENT = re.compile(
    r"(?:(?P<day>\d{1,4}([-/.])\d{1,2}\2\d{1,4})[T ,]+)?(?:(?P<h>\d{1,3}):)?(?P<m>\d{1,2}):(?P<s>\d\d)"
    r"(?P<part>[.,]\d+)?\s*(?P<half>[AP]M)?\s*(?:Z|UTC|GMT|[-+]\d\d:?\d\d)?",
    re.IGNORECASE,
)


def _western(error: UnicodeError) -> tuple[str, int]:
    """Decode bytes that are not UTF-8 as Windows writes them in western Europe, such as those of a degree sign."""
    if not isinstance(error, UnicodeDecodeError) or error.encoding.replace("_", "-").lower() not in ("utf-8", "utf8"):
        raise error
    return error.object[error.start : error.end].decode("cp1252"), error.end


codecs.register_error("ctxval-western", _western)


class _Layout(NamedTuple):
    """Where the table in a file is."""

    separator: str
    start: int  #: number of lines above the first row
    names: tuple[str, ...]  #: of the columns, with their units
    skipped: tuple[list[str], ...]  #: the header and the row of units, which loggers repeat


@dataclass(frozen=True)
class TableLimits:
    """What tables of strangers may hold, so that reading them takes bounded memory and time."""

    numbers: int = MOST_BYTES  # bytes of all numbers
    row: int = 2**20  # characters in a row
    head: int = 80  # lines in which the header is looked for, if they have less than half as many characters


class CsvTable:
    """The cells of a CSV file of at most so many bytes, and the names of its columns, empty ones where it has none.

    A name has the unit in brackets that a row below the header states. In a ``plain`` table, each row below the header
    counts; else lines that begin with # or %, repeated headers and lines without numbers at the end are left out.
    """

    limits = TableLimits()

    def __init__(self, path: str | Path, most: int = MOST_BYTES, *, plain: bool = False) -> None:
        self.path, self._most, self._plain = path, most, plain
        self._marks: dict[str, int] = {}
        self.remarks: list[str] = []  #: what was left out, one sentence each, after the rows were read
        with self._lines() as lines:
            self._layout = _layout(list(_first(lines, self.limits)), plain)
        self.names = self._layout.names
        require_distinct(str(path), self.names)

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the rows of the table that are not blank, with their line numbers; the last may be shorter."""
        width, repeated = len(self.names), 0
        wrong, ending = "", list[int]()  # why no row may follow, and the lines of a footer
        for line, row in self._cells():
            if not self._plain and row in self._layout.skipped:
                repeated += 1
                continue
            if wrong:
                raise InputError(wrong)
            if len(row) > width and not any(cell.strip() for cell in row[width:]):
                row = row[:width]  # a separator ends the row
            if len(row) != width:
                wrong = f"{self.path}, line {line}: the row must have {width} cells, as the header has, got {len(row)}."
                if not self._plain and not any(map(_reads, row)):
                    ending.append(line)
                    continue
                if len(row) > width:
                    if self._layout.separator == ",":
                        wrong += " If commas are decimal commas, semicolons must separate the columns."
                    raise InputError(wrong)
                row = row + [""] * (width - len(row))
            yield line, row
        if repeated and (text := f"{self.path} repeats its header, which is left out") not in self.remarks:
            self.remarks.append(text)
        if ending and (text := f"{self.path}, line {ending[0]}: text below the table is left out") not in self.remarks:
            self.remarks.append(text)

    def columns(
        self, names: Sequence[str], *, missing: Sequence[str] = (), last: Sequence[str] = (), most: int | None = None
    ) -> dict[str, Array]:
        """Return columns of numbers; cells of those in ``missing`` may be empty, and the last ones of ``last``."""
        places = {name: place for place, name in enumerate(self.names)}
        columns = {name: array("d") for name in names}
        wrong: InputError | None = None
        for count, (line, row) in enumerate(self.rows(), 1):
            if wrong is not None:
                raise wrong
            if most is not None and count > most:
                raise InputError(f"{self.path} must have {most} rows below its header, and has more.")
            if 8 * len(names) * count > self.limits.numbers:
                raise InputError(f"{self.path} has too many numbers: {self.limits.numbers} bytes may be read.")
            for name, numbers in columns.items():
                cell = row[places[name]]
                try:
                    numbers.append(math.nan if name in missing and _is_missing(cell) else self.number(line, name, cell))
                except InputError as error:
                    if name not in last:
                        raise
                    wrong = wrong or error
                    numbers.append(math.nan)
        return {name: np.array(numbers) for name, numbers in columns.items()}

    def texts(self, name: str) -> Array:
        place = self.names.index(name)
        return np.array([row[place].strip() for _, row in self.rows()])

    def clock_times(self, name: str) -> Array | None:
        """Return the seconds since midnight before the first of dates or clock times in a column; None for numbers."""
        place, times, days = self.names.index(name), array("d"), array("d")
        for line, row in self.rows():
            cell = row[place]
            matched = _MOMENT.fullmatch(cell.strip())
            if matched is None and not _is_missing(cell):
                if np.isnan(times).all():
                    return None
                raise InputError(f"{self.path}, line {line}: {name} must be a time, got {cell[:60]!r}.")
            where = f"{self.path}, line {line}: {name}"
            times.append(math.nan if matched is None else _seconds(where, matched))
            days.append(math.nan if matched is None else _day(where, matched))
        seconds, dates = np.array(times), np.array(days)
        if not (known := np.isfinite(seconds)).any():
            return None
        if not dates[known].all():  # there are clock times without a date, which go on over midnight
            seconds[known] = np.unwrap(seconds[known], period=86400.0)
        # Seconds since 1970 would be rounded to 0.2 microseconds.
        return np.asarray(86400.0 * (dates - dates[known][0]) + seconds)

    def number(self, line: int, name: str, cell: str) -> float:
        mark = "," if "," in cell else "." if "." in cell else ""
        try:
            if mark == self._layout.separator and _THOUSANDS.fullmatch(cell.strip()):
                raise ValueError
            value = number_in(cell.replace(",", ".").strip() if mark == "," else cell.strip(), float)
        except ValueError:
            shown = f"got {cell[:60]!r}" if cell.strip() else "and the cell is empty"
            raise InputError(f"{self.path}, line {line}: {name} must be a number, {shown}.") from None
        if mark:
            self._marks.setdefault(mark, line)
        if len(self._marks) > 1:
            commas, points = f"commas (line {self._marks[',']})", f"points (line {self._marks['.']})"
            raise InputError(f"{self.path} has decimal {commas} and {points} in numbers: use one mark.")
        return value

    def _cells(self) -> Iterator[tuple[int, list[str]]]:
        separator, start = self._layout.separator, self._layout.start
        with self._lines() as lines:
            below = itertools.islice(lines, start, None)
            reader = _reader(("\n" if _mark(line, self._plain) else line for line in below), separator)
            for row in reader:
                lines.in_row = 0
                if len(row) > 1 or (row and row[0].strip()):
                    yield start + reader.line_num, row

    @contextmanager
    def _lines(self) -> Iterator[_Lines]:
        with (
            reworded(f"{self.path} cannot be read as CSV", InputError, OSError, UnicodeError, csv.Error),
            open_regular(self.path, self._most) as file,
        ):
            first = file.read(2)
            file.seek(0)
            wide = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
            encoding = wide.get(first, "utf-16-le" if first[1:] == b"\0" and first[:1] != b"\0" else "utf-8-sig")
            errors = "ctxval-western" if encoding == "utf-8-sig" else "strict"
            with io.TextIOWrapper(file, encoding=encoding, errors=errors, newline="") as text:
                yield _Lines(text, self._most, self.limits.row)


class _Lines(Iterator[str]):
    """The lines of a text, of which only so many characters are read, in the whole and in one row."""

    def __init__(self, text: io.TextIOWrapper, most: int, most_in_row: int) -> None:
        self._text, self._left, self._most_in_row, self.in_row = text, most, most_in_row, 0

    def __next__(self) -> str:
        if not (line := self._text.readline(self._most_in_row + 1)):
            raise StopIteration
        self.in_row += len(line)
        self._left -= len(line)
        if self.in_row > self._most_in_row:
            raise InputError(f"it has a row of more than {self._most_in_row} characters")
        if self._left < 0:
            raise InputError("it grew while it was read")
        if "\0" in line:
            raise InputError("it is not text in UTF-8: it has NUL bytes")
        return line


# Where the table is

_Row = tuple[int, list[str], bool]  # the number of its last line, its cells, and whether it is a comment


def _first(lines: _Lines, limits: TableLimits) -> Iterator[str]:
    """Yield the first lines; the first rows of a wide table are fewer."""
    for line in itertools.islice(lines, limits.head):
        yield line
        if lines.in_row > limits.row // 2:
            return


def _layout(head: list[str], plain: bool) -> _Layout:
    """Return where the table is, from the first lines of a file."""
    start = 0
    if not plain:  # files of LabVIEW
        start = max((k + 1 for k, line in enumerate(head) if line.startswith("***End_of_Header***")), default=0)
    stated = re.match(r'\s*"?sep=([;,|:\t ])"?\s*$', head[start], re.IGNORECASE) if head[start:] else None
    start += stated is not None
    rows = {mark: _split(head[start:], mark, plain) for mark in ([stated[1]] if stated else _SEPARATORS)}
    usual = {mark: _usual_width(of) for mark, of in rows.items()}
    separator = max(rows, key=lambda mark: usual[mark][1])
    if not usual[separator][1] and not stated:
        separator = ","
    width, table = usual[separator][0], [row for row in rows[separator] if any(cell.strip() for cell in row[1])]
    header, units, end = _header(table, width, plain)
    names = [unguarded(name).strip() for name in header]
    if start and names[-1:] == ["Comment"] and width == len(names) - 1:
        names.pop()  # the rows of LabVIEW end before it
    for place, unit in enumerate(units[: len(names)]):
        bare = unit.strip().strip("[]()").strip()
        if names[place] and bare not in ("", "-") and not named_unit(names[place])[1]:
            names[place] = f"{names[place]} [{bare}]"
    return _Layout(separator, start + end, tuple(names), tuple(filter(None, (header, units))))


def _header(rows: Sequence[_Row], width: int, plain: bool) -> tuple[list[str], list[str], int]:
    """Return the cells of the header and of the row of units, and the number of the line in which these end."""
    of_data = (k for k, (_, cells, comment) in enumerate(rows) if not comment and len(cells) == width)
    first = next((k for k in of_data if _has_numbers(rows[k][1])), None)
    above = [k for k in range(len(rows) if first is None else first) if len(rows[k][1]) == width]
    whole = [k for k, row in enumerate(rows) if not row[2]]
    rather = [k for k in above if not rows[k][2]]
    # A header is the first row of the width of the table that has no number; numpy and rostopic write it as a comment.
    texts = [k for k in rather or above if not any(_NUMBER.fullmatch(cell.strip()) for cell in rows[k][1])]
    if first is None:
        texts = rather
    if not (number := (texts or rather or whole)[:1]):
        return [], [], 0
    header = rows[number[0]]
    for row in rows[number[0] + 1 : first] if first is not None and not plain else ():
        stated = [cell.strip().strip("[]()").strip() for cell in row[1]]
        texts_of = [cell for cell in stated if cell not in ("", "-", "1")]
        units = len(row[1]) == width and texts_of and not any(map(_NUMBER.fullmatch, texts_of))
        if units and 2 * sum(map(is_unit, texts_of)) >= len(texts_of):
            return header[1], row[1], row[0]
    return header[1], [], header[0]


def _split(lines: Sequence[str], separator: str, plain: bool) -> list[_Row]:
    reader = _reader(("\n" if _mark(line, plain) else line for line in lines), separator)
    rows = [(reader.line_num, row, False) for row in reader if row]
    for number, line in enumerate(lines, 1):
        if mark := _mark(line, plain):
            rows += [(number, row, True) for row in _reader([line.lstrip().lstrip(mark).lstrip(" ")], separator)]
    return sorted(rows, key=lambda row: row[0])


def _usual_width(rows: Sequence[_Row]) -> tuple[int, int]:
    """Return the number of cells that most rows have, and how many rows have it; none if that is a single cell."""
    counted = Counter(len(cells) for _, cells, comment in rows if not comment and len(cells) > 1)
    return counted.most_common(1)[0] if counted else (1, 0)


def _reader(lines: Iterable[str], separator: str) -> Any:
    if separator == " ":
        lines = (line.replace("\t", " ").rstrip() + "\n" for line in lines)
    return csv.reader(lines, delimiter=separator, skipinitialspace=separator == " ")


def _mark(line: str, plain: bool) -> str:
    """Return the mark with which a comment begins; empty if the line is none."""
    first = line.lstrip()[:1]
    return first if first in ("#", "%") and not plain else ""


def _has_numbers(cells: Sequence[str]) -> bool:
    return bool(cells) and (_reads(cells[0]) or 2 * sum(map(_reads, cells)) > len(cells))


def _reads(cell: str) -> bool:
    text = cell.strip()
    return bool(_NUMBER.fullmatch(text) or _MOMENT.fullmatch(text) or text.casefold() in _MISSING - {"-"})


def _is_missing(cell: str) -> bool:
    return not (text := cell.strip().casefold()) or text in _MISSING


def _seconds(where: str, moment: re.Match[str]) -> float:
    """Return the seconds of a clock time. 12:03 is a time of the day, and 12:03.5 is one of an hour."""
    first, second, third = moment["h"], int(moment["m"]), int(moment["s"])
    if first is None and moment["part"] is None:
        first, second, third = second, third, 0
    hour = int(first or 0)
    if moment["half"]:
        hour = hour % 12 + 12 * (moment["half"].upper() == "PM")
    seconds = 3600.0 * hour + 60 * second + third + float((moment["part"] or ".0").replace(",", "."))
    if second > 59 or third > 60:
        raise InputError(f"{where} must be a time, got {moment[0][:60]!r}.")
    return seconds


def _day(where: str, moment: re.Match[str]) -> float:
    """Return the number of the day, 0 if no date is given; 05/06/2024 is in May, and 05.06.2024 is in June."""
    if moment["day"] is None:
        return 0.0
    a, b, c = (int(part) for part in re.split("[-/.]", moment["day"]))
    year, month, day = (a, b, c) if a > 31 else (c, b, a) if "." in moment["day"] or a > 12 else (c, a, b)
    with reworded(f"{where} has no such day, {moment['day']}", ValueError):
        return float(date(year, month, day).toordinal())
