"""Safe reading of NPZ files from elsewhere: the header of an array is checked before its numbers are read.

``numpy.load`` takes as much memory as a header asks for, evaluates the header as a literal of Python, and raises many
kinds of exceptions for damaged bytes. Here a header is matched by regular expressions, never evaluated.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

import numpy as np
import numpy.typing as npt

from ctxval.errors import InputError

MOST_BYTES = 256 * 2**20
"""Largest total size in bytes of the arrays that are read from one file, with each number as a float64."""

_MOST_ARRAYS = 1000
_MOST_HEADER = 10_000
"""Largest size of a header in bytes, as in numpy."""

_DTYPE = re.compile(r"""['"]descr['"]\s*:\s*['"](?:([<>|=]?[fiub])([1248])|([<>|=]?U|\|?S)(\d{1,9}))['"]""")
_ORDER = re.compile(r"""['"]fortran_order['"]\s*:\s*(True|False)""")
_SHAPE = re.compile(r"""['"]shape['"]\s*:\s*\(([\dL,\s]*)\)""")


@dataclass(frozen=True)
class _Header:
    """The header of an array; ``length`` is its size in bytes."""

    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    order: str
    length: int

    @property
    def count(self) -> int:
        return math.prod(self.shape)


class Archive:
    """The arrays of an NPZ file. An array is read when it is requested, and nothing in the file is ever run.

    The message of every error is only the reason; the caller puts the name of the file before it.

    Args:
        content: the bytes of the file.
        most: largest total size in bytes of the arrays that are read, with each number as a float64.

    Attributes:
        names: the names of the arrays.
    """

    def __init__(self, content: bytes, most: int = MOST_BYTES) -> None:
        if content.count(b"PK\x01\x02") > _MOST_ARRAYS:  # the mark of an entry; each entry takes memory
            raise InputError(f"it has more than {_MOST_ARRAYS} entries")
        with _damage():
            self._zip = zipfile.ZipFile(io.BytesIO(content))
        self._entries = {
            info.filename.removesuffix(".npy"): info for info in self._zip.infolist() if info.filename.endswith(".npy")
        }
        self._headers: dict[str, _Header] = {}
        self._left = most

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the arrays."""
        return tuple(self._entries)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array, without reading its numbers."""
        return self._header(name).shape

    def numbers(self, name: str) -> npt.NDArray[np.float64]:
        """Return an array of real numbers."""
        header = self._header(name)
        if header.dtype.kind not in "fiub":
            raise InputError(f"its array {name} must be real numbers")
        self._take(name, 8 * header.count)
        with _damage():
            flat = np.frombuffer(self._data(name, header), dtype=header.dtype)
            shaped = flat.reshape(header.shape, order="F" if header.order == "F" else "C")
            return np.asarray(shaped, dtype=np.float64)

    def text(self, name: str) -> str:
        """Return an array that is one text."""
        header = self._header(name)
        if header.dtype.kind not in "US" or header.count != 1:
            raise InputError(f"its array {name} must be one text")
        self._take(name, 2 * header.dtype.itemsize)
        with _damage():
            data = bytes(self._data(name, header))
        # Surrogates are replaced, because no file or terminal can hold them.
        order = {"<": "little", ">": "big"}.get(header.dtype.byteorder, sys.byteorder)
        encoding = "utf-8" if header.dtype.kind == "S" else f"utf-32-{order[0]}e"
        return data.decode(encoding, "replace").rstrip("\0")

    def _header(self, name: str) -> _Header:
        if name not in self._entries:
            raise InputError(f"it has no array {name}")
        if name not in self._headers:
            with _damage(), self._opened(name) as file:
                self._headers[name] = _read_header(name, file)
        return self._headers[name]

    def _opened(self, name: str) -> IO[bytes]:
        info = self._entries[name]
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError("its compression method must be one that numpy writes, stored or deflated")
        return self._zip.open(info)

    def _take(self, name: str, size: int) -> None:
        """Count these bytes as read; refuse the array if they are more than are left."""
        if size > self._left:
            raise InputError(
                f"its array {name} of shape {self._headers[name].shape} is too large: {self._left} bytes may be read"
            )
        self._left -= size

    def _data(self, name: str, header: _Header) -> bytearray:
        size = header.count * header.dtype.itemsize
        if self._entries[name].file_size != header.length + size:
            raise InputError(f"its array {name} is not as long as its header states")
        data, filled = bytearray(size), 0
        with self._opened(name) as file:
            file.read(header.length)
            while chunk := file.read(2**20):  # to the end, because zipfile compares the checksum there
                data[filled : filled + len(chunk)] = chunk
                filled += len(chunk)
        if filled != size:
            raise InputError(f"its array {name} is not as long as its header states")
        return data


def _read_header(name: str, file: IO[bytes]) -> _Header:
    """Read a header of the NPY format, https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html."""
    start = file.read(8)
    width = {1: 2, 2: 4, 3: 4}.get(start[6] if len(start) == 8 else 0)
    if start[:6] != b"\x93NUMPY" or width is None:
        raise InputError(f"its entry {name} is not an array")
    length = int.from_bytes(file.read(width), "little")
    if length > _MOST_HEADER:
        raise InputError(f"its array {name} has a header of {length} bytes, more than {_MOST_HEADER}")
    text = file.read(length).decode("utf-8", "replace")
    dtype, order, shape = (pattern.search(text) for pattern in (_DTYPE, _ORDER, _SHAPE))
    if dtype is None or order is None or shape is None:
        raise InputError(f"its array {name} holds neither real numbers nor text")
    sizes = tuple(int(size.strip().rstrip("L")) for size in shape[1].split(",") if size.strip())
    kind = "".join(part for part in dtype.groups() if part)
    return _Header(np.dtype(kind), sizes, "F" if order[1] == "True" else "C", 8 + width + length)


@contextlib.contextmanager
def _damage() -> Iterator[None]:
    """Turn the many exceptions of zipfile, zlib and numpy for damaged or hostile bytes into one error."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"it is not a complete NPZ archive ({type(error).__name__})") from error
