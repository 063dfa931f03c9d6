"""Fallback files: the result of an execution is written to a file if its store cannot record it."""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import suppress
from pathlib import Path

from ctxval.campaign.storage.disks import sync_folder
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError


def error_with_fallback(
    ended: Trial, trajectory: Trajectory | None, store: Path | None, error: CtxvalError
) -> CtxvalError:
    """Write the fallback file of an execution; return the error of the store with a sentence that names the file."""
    if not ended.executed:
        return error
    path = _written(ended, trajectory, store)
    if path is None:
        return type(error)(f"{error} The result of trial {ended.number} could not be written to a file either.")
    how = f"--npz {path}" if trajectory is not None else "--failed or --distance with the value in the file"
    return type(error)(
        f"{error} The result of trial {ended.number} is kept in {path}: when the store can be written again, "
        f"run `ctxval tell STORE {ended.number} {how}` before any other command."
    )


def _written(trial: Trial, trajectory: Trajectory | None, store: Path | None) -> Path | None:
    """Write the trajectory of a trial as NPZ, or its distance or failure as JSON; files of other attempts stay.

    The file is next to the store, or in the temporary folder if this is not possible; None if neither is.
    """
    stem = "memory" if store is None else store.stem
    ended = {"trial": trial.number, "distance": trial.distance, "failure": trial.failure}
    content, suffix = (json.dumps(ended).encode(), "json") if trajectory is None else (trajectory.to_npz(), "npz")
    for folder in (Path() if store is None else store.parent, Path(tempfile.gettempdir())):
        for count in range(1000):
            path = folder / f"{stem}.trial-{trial.number}{f'.{count}' if count else ''}.{suffix}"
            try:
                file = path.open("xb")
            except FileExistsError:
                continue
            except OSError:
                break
            try:
                with file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    path.unlink()
                break
            sync_folder(folder)
            return path
    return None
