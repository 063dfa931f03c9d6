"""Bounded reading of files from elsewhere, and writing of files that are complete or missing.

Only regular files are read, and only up to a stated number of bytes.

A FIFO would wait for its writer, a device such as ``/dev/zero`` never ends, and a few crafted bytes can unpack to many.
The message of an error of reading is only the reason; the caller puts the name of the file before it.
"""

from __future__ import annotations

import csv
import io
import json
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from ctxval.errors import InputError

MOST_BYTES = 256 * 2**20
"""Largest size of a file in bytes, enough for 33 million numbers of a trajectory."""

MOST_JSON = 16 * 2**20
"""Largest size of a JSON file in bytes; reading it takes twenty times as much memory."""

MOST_ROW = 2**20
"""Largest number of characters in a row of a CSV file."""

_KINDS = {
    stat.S_IFDIR: "it is a folder",
    stat.S_IFIFO: "it is a FIFO and not a regular file",
    stat.S_IFSOCK: "it is a socket and not a regular file",
    stat.S_IFCHR: "it is a device and not a regular file",
    stat.S_IFBLK: "it is a device and not a regular file",
}


def open_regular(path: str | Path, most: int = MOST_BYTES) -> BinaryIO:
    """Open a regular file for reading, also through a symbolic link; never block.

    Args:
        path: the file.
        most: largest size of the file in bytes.

    Raises:
        InputError: if the file does not exist, is not a regular file (a FIFO, a device), or is too large.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:  # a ValueError for a NUL in the name
        raise InputError(_why_not_opened(path, error)) from error
    status = os.fstat(descriptor)
    reason = _KINDS.get(stat.S_IFMT(status.st_mode), "")
    if not reason and status.st_size > most:
        reason = f"it has {status.st_size} bytes, and at most {most} are read"
    if reason:
        os.close(descriptor)
        raise InputError(reason)
    return os.fdopen(descriptor, "rb")


def _why_not_opened(path: str | Path, error: OSError | ValueError) -> str:
    if os.path.isdir(path):  # Windows does not open folders
        return _KINDS[stat.S_IFDIR]
    return str(getattr(error, "strerror", None) or error)


def require_regular_file(path: str | Path) -> None:
    """Check that a path names a regular file that can be opened.

    Raises:
        InputError: if the file does not exist, is not a regular file, or cannot be opened.
    """
    open_regular(path).close()


def read_bytes(path: str | Path, most: int = MOST_BYTES) -> bytes:
    """Return the content of a regular file.

    Raises:
        InputError: if the file cannot be opened or read, or has more bytes than ``most``.
    """
    with open_regular(path, most) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            content = file.read(size + 1)
        except OSError as error:
            raise InputError(error.strerror or str(error)) from error
    if len(content) > size:
        raise InputError("it grew while it was read")
    return content


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        InputError: if the file cannot be read, is not JSON in UTF-8, is too large, or is nested too deeply.
    """
    content = read_bytes(path, MOST_JSON)
    try:
        return json.loads(content.decode("utf-8"))
    except RecursionError as error:
        raise InputError("it is nested too deeply") from error
    except ValueError as error:
        raise InputError(f"it is not JSON: {error}") from error


def make_folder_of(path: str | Path) -> None:
    """Make the folder of a file that will be written, if there is none.

    Raises:
        InputError: if it cannot be made; the message names the file.
    """
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


@contextmanager
def written_whole(path: str | Path) -> Iterator[BinaryIO]:
    """Yield a file to write to, which gets its name at the end: it is complete or, after an error or a kill, missing.

    Two processes may write the same file at once: one of the two complete files stays.

    Raises:
        InputError: if the file cannot be written; the message names it.
    """
    target = Path(os.path.realpath(path))  # a link stays a link
    beside = target.with_name(f"{target.name}.{secrets.token_hex(4)}.part")
    try:
        with beside.open("xb") as file:
            yield file
        beside.replace(target)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


def csv_rows(path: str | Path, most: int = MOST_BYTES) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a CSV file that are not blank, each with the number of its last line.

    Raises:
        InputError: if the file cannot be read, is not CSV in UTF-8, or has a row that is too long.
    """
    with open_regular(path, most) as file, io.TextIOWrapper(file, encoding="utf-8-sig", newline="") as text:
        lines = _Lines(text, most)
        reader = csv.reader(lines)
        try:
            for row in reader:
                lines.in_row = 0
                if row:
                    yield reader.line_num, row
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise InputError(str(error)) from error


class _Lines:
    """The lines of a text; a row of CSV may extend over several lines.

    Attributes:
        in_row: number of characters since the end of the last row; the reader of rows resets it to 0.
    """

    def __init__(self, text: io.TextIOWrapper, most: int) -> None:
        self.text, self.left, self.in_row = text, most, 0

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        line = self.text.readline(MOST_ROW + 1)
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
