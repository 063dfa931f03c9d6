"""Safe reading of NPZ files from elsewhere: the header of an array is checked before its numbers are read.

``numpy.load`` takes as much memory as a header asks for, and raises many kinds of exceptions for damaged bytes.
"""

from __future__ import annotations

import contextlib
import io
import math
import sys
import warnings
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from ctxval._util.files import MOST_BYTES
from ctxval.errors import InputError

_MOST_ARRAYS = 1000
_Header = tuple[tuple[int, ...], bool, np.dtype[Any], int]
"""The shape, the order and the type of an array, and the place of its numbers in its entry."""


class Archive:
    """The arrays of an NPZ file. An array is read when it is requested, and nothing in the file is ever run.

    The message of every error is only the reason; the caller puts the name of the file before it. At most so many bytes
    of arrays are read, with each number as a float64.
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
        return tuple(self._entries)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def shape(self, name: str) -> tuple[int, ...]:
        return self._header(name)[0]

    def numbers(self, name: str) -> npt.NDArray[np.float64]:
        shape, fortran_order, dtype, _ = self._header(name)
        if dtype.kind not in "fiub" or dtype.itemsize > 8:
            raise InputError(f"its array {name} must be real numbers")
        content = self._content(name, 8 * math.prod(shape))
        with _damage():
            array = np.frombuffer(content, dtype=dtype).reshape(shape, order="F" if fortran_order else "C")
            return np.asarray(array, dtype=np.float64)

    def text(self, name: str) -> str:
        shape, _, dtype, _ = self._header(name)
        if dtype.kind not in "US" or math.prod(shape) != 1:
            raise InputError(f"its array {name} must be one text")
        # Surrogates are replaced, because no file or terminal can hold them.
        order = {"<": "little", ">": "big"}.get(dtype.byteorder, sys.byteorder)
        encoding = "utf-8" if dtype.kind == "S" else f"utf-32-{order[0]}e"
        return self._content(name, 2 * dtype.itemsize).decode(encoding, "replace").rstrip("\0")

    def _header(self, name: str) -> _Header:
        if name not in self._entries:
            raise InputError(f"it has no array {name}")
        if name not in self._headers:
            entry = self._entries[name]
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError("its compression method must be one that numpy writes, stored or deflated")
            with _damage(), warnings.catch_warnings(), self._zip.open(entry) as file:
                warnings.simplefilter("ignore")  # of headers that Python 2 wrote
                version = np.lib.format.read_magic(file)
                if version not in ((1, 0), (2, 0), (3, 0)):
                    raise InputError(f"its array {name} has an unknown format")
                # The third version differs from the second in names of fields only.
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                header = (*read(file), file.tell())
            if header[2].kind not in "fiubUS":
                raise InputError(f"its array {name} holds neither real numbers nor text")
            self._headers[name] = header
        return self._headers[name]

    def _content(self, name: str, size: int) -> bytearray:
        """Return the bytes of the numbers or the text of an array, which takes so many bytes in memory."""
        shape, _, dtype, start = self._header(name)
        if size > self._left:
            raise InputError(f"its array {name} of shape {shape} is too large: {self._left} bytes may be read")
        self._left -= size
        length, filled = math.prod(shape) * dtype.itemsize, 0
        wrong = f"its array {name} is not as long as its header states"
        if self._entries[name].file_size != start + length:
            raise InputError(wrong)
        content = bytearray(length)
        with _damage(), self._zip.open(self._entries[name]) as file:
            file.read(start)
            while chunk := file.read(2**20):  # to the end, because zipfile compares the checksum there
                content[filled : filled + len(chunk)] = chunk
                filled += len(chunk)
        if filled != length:
            raise InputError(wrong)
        return content


@contextlib.contextmanager
def _damage() -> Iterator[None]:
    """Turn the many exceptions of zipfile, zlib and numpy for damaged or hostile bytes into one error."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"it is not a complete NPZ archive ({type(error).__name__})") from error
