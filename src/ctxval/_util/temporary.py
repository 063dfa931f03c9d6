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
        self._lock = _owned(self._around)
        self.path = self._around / "files"
        self.path.mkdir()

    def remove(self) -> None:
        """Remove the folder with everything in it."""
        if self._lock is not None:
            self._lock.close()
        shutil.rmtree(self._around, ignore_errors=True)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield the path of a new folder, which is removed at the end of the context."""
    folder = TemporaryFolder()
    try:
        yield folder.path
    finally:
        folder.remove()


def _owned(folder: Path) -> FileLock | None:
    """Return the lock that marks a folder as in use as long as this process lives.

    Returns None on a disk without locks; no other process removes a folder that has no lock file.
    """
    unnamed = folder / "new"
    try:
        held = FileLock(unnamed)
        held.acquire()
    except OSError:
        return None
    # The file gets its name only after it is locked, so that no other process finds it unlocked.
    unnamed.rename(folder / "lock")
    return held
