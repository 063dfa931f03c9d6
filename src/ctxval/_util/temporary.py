"""Temporary folders. The folders that a killed process left behind are removed when the next one is made."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ctxval._util.locks import FileLock


class TemporaryFolder:
    """A new temporary folder, which only this process removes."""

    def __init__(self) -> None:
        for owned in Path(tempfile.gettempdir()).glob("ctxval-*/lock"):
            with suppress(OSError):  # it is in use, or another user's
                left = FileLock(owned)
                try:
                    left.acquire()
                    shutil.rmtree(owned.parent, ignore_errors=True)
                finally:
                    left.close()
        self._around = Path(tempfile.mkdtemp(prefix="ctxval-")).resolve()
        # It marks the folder as in use as long as this process lives. It gets its name only after it is locked, so that
        # no other process finds it unlocked. On a disk without locks there is none, and nobody else removes the folder.
        self._lock: FileLock | None = None
        with suppress(OSError):
            lock = FileLock(self._around / "new")
            lock.acquire()
            self._lock = lock
            (self._around / "new").rename(self._around / "lock")
        self.path = self._around / "files"
        self.path.mkdir()

    def remove(self) -> None:
        if self._lock is not None:
            self._lock.close()
        shutil.rmtree(self._around, ignore_errors=True)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    folder = TemporaryFolder()
    try:
        yield folder.path
    finally:
        folder.remove()
