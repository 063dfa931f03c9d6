"""Fallback files: the result of an execution is written to a file if its store cannot record it."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path
from typing import IO

from ctxval.campaign.storage.disks import sync_folder
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError

_MOST_FILES = 1000
"""Largest number of files of one trial in one folder."""


def error_with_fallback(
    ended: Trial, trajectory: Trajectory | None, store: Path | None, error: CtxvalError
) -> CtxvalError:
    """Write the fallback file of an execution; return the error of the store with a sentence that names the file."""
    if not ended.executed:
        return error
    path = write_fallback(ended, trajectory, store)
    if path is None:
        return type(error)(f"{error} The result of trial {ended.number} could not be written to a file either.")
    how = f"--npz {path}" if trajectory is not None else "--failed or --distance with the value in the file"
    return type(error)(
        f"{error} The result of trial {ended.number} is kept in {path}: when the store can be written again, "
        f"run `ctxval tell STORE {ended.number} {how}` before any other command."
    )


def write_fallback(trial: Trial, trajectory: Trajectory | None, store: Path | None) -> Path | None:
    """Write the result of a trial to a file next to its store, or to the temporary folder if this is not possible.

    The file is the trajectory as NPZ; if there is none, it is the distance or the failure as JSON. Files of other
    attempts are not overwritten.

    Returns:
        the path of the file; None if it cannot be written in either folder.
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
