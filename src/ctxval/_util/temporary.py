"""Folders for a while. What a killed process leaves of them is removed when the next one is made."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ctxval._util.locks import FileLock

_PREFIX = "ctxval-"
_OWNED = "lock"
"""The file that is locked as long as the process lives that made the folder."""


class TemporaryFolder:
    """A new folder, of this process alone to remove.

    Attributes:
        path: where it is.
    """

    def __init__(self) -> None:
        _remove_left_over()
        self._around = Path(tempfile.mkdtemp(prefix=_PREFIX)).resolve()
        self._lock = _owned(self._around)
        self.path = self._around / "files"
        self.path.mkdir()

    def remove(self) -> None:
        """Remove the folder with all that is in it."""
        if self._lock is not None:
            self._lock.close()
        shutil.rmtree(self._around, ignore_errors=True)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Give a new folder, which is removed in the end."""
    folder = TemporaryFolder()
    try:
        yield folder.path
    finally:
        folder.remove()


def _owned(folder: Path) -> FileLock | None:
    """Return the lock that says whose a folder is; None on a disk without locks, where nobody else ever removes it."""
    unnamed = folder / "new"
    try:
        held = FileLock(unnamed)
        held.acquire()
    except OSError:
        return None
    # Nobody sees the file before it is locked.
    unnamed.rename(folder / _OWNED)
    return held


def _remove_left_over() -> None:
    """Remove the folders whose processes have ended."""
    for owned in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*/{_OWNED}"):
        with suppress(OSError):  # it is in use, or another user's
            left = FileLock(owned)
            try:
                left.acquire()
                shutil.rmtree(owned.parent, ignore_errors=True)
            finally:
                left.close()
