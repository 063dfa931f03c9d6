"""Bounded reading of files from elsewhere, writing of files that are complete or missing, and locks of files.

Only regular files are read, and only up to a stated number of bytes.

A FIFO would wait for its writer, a device such as ``/dev/zero`` never ends, and a few crafted bytes can unpack to many.
The message of an error of reading is only the reason; the caller puts the name of the file before it.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import secrets
import sqlite3
import stat
import sys
import tempfile
import tomllib
import warnings
import weakref
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from ctxval._util.refusals import reworded
from ctxval.errors import InputError

MOST_BYTES = 256 * 2**20  # largest size of a file in bytes, enough for 33 million numbers of a trajectory


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
    # Largest size of a JSON file in bytes; reading it takes twenty times as much memory.
    content = read_bytes(path, 16 * 2**20)
    try:
        return json.loads(content.decode("utf-8"))
    except RecursionError as error:
        raise InputError("it is nested too deeply") from error
    except ValueError as error:
        raise InputError(f"it is not JSON: {error}") from error


def read_toml(path: str | Path) -> dict[str, Any]:
    with reworded(f"{path} cannot be read", InputError):
        content = read_bytes(path)
    with reworded(f"{path} is not valid TOML", ValueError, RecursionError):
        return tomllib.loads(content.decode("utf-8"))


def require_made_by_us(path: Path, mark: bytes = MADE_BY.encode()) -> None:
    """Check that ctxval wrote a file, if there is one, so that it may be replaced."""
    with reworded(f"{path} cannot be written", InputError):
        known = not path.exists() or mark in read_bytes(path, 2**32)
    if not known:
        advice = "give another name, or --force to replace it"
        raise InputError(f"{path} is there already, and ctxval did not write it: {advice}.")


def make_folder_of(path: str | Path) -> None:
    with reworded(f"{path} cannot be written", OSError):
        Path(path).parent.mkdir(parents=True, exist_ok=True)


@contextmanager
def written_whole(path: str | Path, *, text: bool = False) -> Iterator[IO[Any]]:
    """Yield a file that gets its name at the end: it is complete or missing, also if two processes write it."""
    target, header = Path(os.path.realpath(path)), b""  # a link stays a link
    with suppress(InputError, OSError), open_regular(target, sys.maxsize) as present:
        header = present.read(16)
    if header == b"SQLite format 3\0":
        raise InputError(f"{path} is a store or another database, which is never replaced.")
    beside = target.with_name(f"{target.name}.{secrets.token_hex(4)}.part")
    try:
        with reworded(f"{path} cannot be written", OSError):
            with beside.open("x", encoding="utf-8", newline="") if text else beside.open("x+b") as file:
                yield file
            beside.replace(target)
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


# Locks that are released when their process ends, however it ends. The lock is exclusive, whatever path the file is
# opened by, and a forked process does not inherit it. ``filelock`` does not serve here: it closes the file at each
# release, which releases this process's own locks of a database in use.


LOCKS_FILE_ITSELF = sys.platform == "linux"
"""Whether a file can be locked while SQLite uses it. On Linux ``flock`` does not interfere with the locks of SQLite."""


class LockedError(OSError):
    """The lock is held already, by this process or another one."""


if sys.platform == "linux":
    import fcntl

    class FileLock:
        """The lock of a file, which is created if it does not exist."""

        def __init__(self, path: str | Path) -> None:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            self.close = weakref.finalize(self, os.close, self._file)  # which releases the lock
            _open.add(self)

        def acquire(self) -> None:
            """Take the lock; it is held until it is released or the process ends."""
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise LockedError("the lock is held") from None

        def release(self) -> None:
            """Release the lock. The file stays open: closing it would release this process's SQLite locks of it."""
            fcntl.flock(self._file, fcntl.LOCK_UN)

    _open: weakref.WeakSet[FileLock] = weakref.WeakSet()
    os.register_at_fork(after_in_child=lambda: [lock.close() for lock in list(_open)])
else:

    class FileLock:
        """The lock of a file that has no other use: a transaction of SQLite."""

        def __init__(self, path: str | Path) -> None:
            try:
                self._connection = sqlite3.connect(path, isolation_level=None, timeout=0, check_same_thread=False)
            except sqlite3.DatabaseError as error:
                raise OSError(str(error)) from error
            self.close = self._connection.close

        def acquire(self) -> None:
            try:
                self._connection.execute("BEGIN EXCLUSIVE")
            except sqlite3.DatabaseError as error:
                raise LockedError("the lock is held") if "locked" in str(error) else OSError(str(error)) from error

        def release(self) -> None:
            self._connection.execute("ROLLBACK")


# NPZ files: ``numpy.load`` takes as much memory as a header asks for, and raises many kinds of exceptions.


class Archive:
    """The arrays of an NPZ file. An array is read when it is requested, and nothing in the file is ever run.

    The message of every error is only the reason; the caller puts the name of the file before it. At most so many bytes
    of arrays are read, with each number as a float64.
    """

    def __init__(self, content: bytes, most: int = MOST_BYTES) -> None:
        if content.count(b"PK\x01\x02") > 1000:  # the mark of an entry; each entry takes memory
            raise InputError("it has more than 1000 entries")
        with _damage():
            self._zip = zipfile.ZipFile(io.BytesIO(content))
        entries = (info for info in self._zip.infolist() if info.filename.endswith(".npy"))
        self._entries = {info.filename.removesuffix(".npy"): info for info in entries}
        self.names = tuple(self._entries)
        self._left = most

    def numbers(self, name: str) -> npt.NDArray[np.float64]:
        shape, dtype = self.header(name)
        if dtype.kind not in "fiub" or dtype.itemsize > 8:
            raise InputError(f"its array {name} must be real numbers")
        return np.asarray(self._array(name, shape, 8 * math.prod(shape)), dtype=np.float64)

    def text(self, name: str) -> str:
        shape, dtype = self.header(name)
        if dtype.kind not in "US" or math.prod(shape) != 1:
            raise InputError(f"its array {name} must be one text")
        # Surrogates are replaced, because no file or terminal can hold them.
        order = {"<": "little", ">": "big"}.get(dtype.byteorder, sys.byteorder)
        encoding = "utf-8" if dtype.kind == "S" else f"utf-32-{order[0]}e"
        return self._array(name, shape, 2 * dtype.itemsize).tobytes().decode(encoding, "replace").rstrip("\0")

    def header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Return the shape and the type of an array whose entry is as long as its header states."""
        if name not in self._entries:
            raise InputError(f"it has no array {name}")
        entry = self._entries[name]
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError("its compression method must be one that numpy writes, stored or deflated")
        with _damage(), self._zip.open(entry) as file:
            # The third version differs from the second in names of fields only.
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)
            if dtype.kind not in "fiubUS":
                raise InputError(f"its array {name} holds neither real numbers nor text")
            if entry.file_size != file.tell() + math.prod(shape) * dtype.itemsize:
                raise InputError(f"its array {name} is not as long as its header states")
        return shape, dtype

    def _array(self, name: str, shape: tuple[int, ...], size: int) -> npt.NDArray[Any]:
        """Return an array whose numbers or text take so many bytes in memory."""
        if size > self._left:
            raise InputError(f"its array {name} of shape {shape} is too large: {self._left} bytes may be read")
        self._left -= size
        with _damage(), self._zip.open(self._entries[name]) as file:
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


@contextlib.contextmanager
def _damage() -> Iterator[None]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that Python 2 wrote
            yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"it is not a complete NPZ archive ({type(error).__name__})") from error
