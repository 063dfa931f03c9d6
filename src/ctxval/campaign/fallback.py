"""Fallback files: how an execution ended is kept in a file if its store does not take it."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path
from typing import IO

from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError
from ctxval.storage.disks import sync_folder

_MOST_FILES = 1000
"""Files of one trial that are kept in one folder."""


def error_with_fallback(
    ended: Trial, trajectory: Trajectory | None, store: Path | None, error: CtxvalError
) -> CtxvalError:
    """Write the fallback file of an execution; return the store's error with a sentence that names the file."""
    if not ended.executed:
        return error
    path = write_fallback(ended, trajectory, store)
    if path is None:
        return type(error)(f"{error} How trial {ended.number} ended could not be kept either.")
    how = f"--npz {path}" if trajectory is not None else "--failed or --distance as it says"
    return type(error)(
        f"{error} How trial {ended.number} ended is kept in {path}: once the store can take it, "
        f"say `ctxval tell STORE {ended.number} {how}` before anything else."
    )


def write_fallback(trial: Trial, trajectory: Trajectory | None, store: Path | None) -> Path | None:
    """Write how a trial ended to a file beside its store, or in the temporary folder if there is no room.

    The file is the trajectory as NPZ; if there is none, the distance or the failure as JSON. Files of other attempts
    stay.

    Returns:
        the path of the file; None if it can be written nowhere.
    """
    stem = "memory" if store is None else store.stem
    ended = {"trial": trial.number, "distance": trial.distance, "failure": trial.failure}
    content, suffix = (json.dumps(ended).encode(), "json") if trajectory is None else (trajectory.to_npz(), "npz")
    for folder in (Path() if store is None else store.parent, Path(tempfile.gettempdir())):
        for count in range(_MOST_FILES):
            path = folder / f"{stem}.trial-{trial.number}{f'.{count}' if count else ''}.{suffix}"
            try:
                file = path.open("xb")
            except FileExistsError:
                continue
            except OSError:
                break
            if _flushed(file, content):
                sync_folder(folder)
                return path
            with contextlib.suppress(OSError):
                path.unlink()
            break
    return None


def _flushed(file: IO[bytes], content: bytes) -> bool:
    try:
        with file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        return False
    return True
