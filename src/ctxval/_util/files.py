"""Bounded reading of files from elsewhere, and writing of files that are complete or missing.

Only regular files are read, and only up to a stated number of bytes.

A FIFO would wait for its writer, a device such as ``/dev/zero`` never ends, and a few crafted bytes can unpack to many.
The message of an error of reading is only the reason; the caller puts the name of the file before it.
"""

from __future__ import annotations

import json
import os
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO

from ctxval.errors import InputError

MOST_BYTES = 256 * 2**20  # largest size of a file in bytes, enough for 33 million numbers of a trajectory

MOST_JSON = 16 * 2**20  # largest size of a JSON file in bytes; reading it takes twenty times as much memory

MADE_BY = "Made by ctxval"
"""What every file contains that an option of a command names, so that the next run may replace it."""


def why_not_regular(mode: int) -> str:
    """Return what a file of a mode is; empty if it is a regular file."""
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return "it is a folder" if stat.S_ISDIR(mode) else ""
    kinds = {stat.S_IFIFO: "FIFO", stat.S_IFSOCK: "socket", stat.S_IFLNK: "link"}
    return f"it is a {kinds.get(stat.S_IFMT(mode), 'device')} and not a regular file"


def open_regular(path: str | Path, most: int = MOST_BYTES) -> BinaryIO:
    """Open a regular file for reading, also through a symbolic link; never block."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:  # a ValueError for a NUL in the name
        folder = os.path.isdir(path)  # which Windows does not open
        raise InputError("it is a folder" if folder else str(getattr(error, "strerror", None) or error)) from error
    status = os.fstat(descriptor)
    reason = why_not_regular(status.st_mode)
    if not reason and status.st_size > most:
        reason = f"it has {status.st_size} bytes, and at most {most} are read"
    if reason:
        os.close(descriptor)
        raise InputError(reason)
    return os.fdopen(descriptor, "rb")


def require_regular_file(path: str | Path) -> None:
    open_regular(path).close()


def read_bytes(path: str | Path, most: int = MOST_BYTES) -> bytes:
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
    content = read_bytes(path, MOST_JSON)
    try:
        return json.loads(content.decode("utf-8"))
    except RecursionError as error:
        raise InputError("it is nested too deeply") from error
    except ValueError as error:
        raise InputError(f"it is not JSON: {error}") from error


def require_made_by_us(path: Path, mark: bytes = MADE_BY.encode()) -> None:
    """Check that ctxval wrote a file, if there is one, so that it may be replaced."""
    try:
        known = not path.exists() or mark in read_bytes(path, 2**32)
    except InputError as error:
        raise InputError(f"{path} cannot be written: {error}.") from error
    if not known:
        advice = "give another name, or --force to replace it"
        raise InputError(f"{path} is there already, and ctxval did not write it: {advice}.")


def make_folder_of(path: str | Path) -> None:
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


@contextmanager
def written_whole(path: str | Path, *, text: bool = False) -> Iterator[IO[Any]]:
    """Yield a file to write to, which gets its name at the end: it is complete or, after an error or a kill, missing.

    Two processes may write the same file at once: one of the two complete files stays.
    """
    target, header = Path(os.path.realpath(path)), b""  # a link stays a link
    with suppress(InputError, OSError), open_regular(target, sys.maxsize) as present:
        header = present.read(16)
    if header == b"SQLite format 3\0":
        raise InputError(f"{path} is a store or another database, which is never replaced.")
    beside = target.with_name(f"{target.name}.{secrets.token_hex(4)}.part")
    try:
        with beside.open("x", encoding="utf-8", newline="") if text else beside.open("x+b") as file:
            yield file
        beside.replace(target)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="ctxval-", ignore_cleanup_errors=True) as name:
        yield Path(name).resolve()


def write_text(path: str | Path, content: str) -> Path:
    """Write a text; its folder is made if there is none."""
    make_folder_of(path)
    with written_whole(path, text=True) as file:
        file.write(content)
    return Path(path)
