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
        self._left = most

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._entries)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def shape(self, name: str) -> tuple[int, ...]:
        return self._header(name)[0]

    def numbers(self, name: str) -> npt.NDArray[np.float64]:
        shape, dtype = self._header(name)
        if dtype.kind not in "fiub" or dtype.itemsize > 8:
            raise InputError(f"its array {name} must be real numbers")
        return np.asarray(self._array(name, 8 * math.prod(shape)), dtype=np.float64)

    def text(self, name: str) -> str:
        shape, dtype = self._header(name)
        if dtype.kind not in "US" or math.prod(shape) != 1:
            raise InputError(f"its array {name} must be one text")
        # Surrogates are replaced, because no file or terminal can hold them.
        order = {"<": "little", ">": "big"}.get(dtype.byteorder, sys.byteorder)
        encoding = "utf-8" if dtype.kind == "S" else f"utf-32-{order[0]}e"
        return self._array(name, 2 * dtype.itemsize).tobytes().decode(encoding, "replace").rstrip("\0")

    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
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

    def _array(self, name: str, size: int) -> npt.NDArray[Any]:
        """Return an array whose numbers or text take so many bytes in memory."""
        if size > self._left:
            raise InputError(
                f"its array {name} of shape {self.shape(name)} is too large: {self._left} bytes may be read"
            )
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
