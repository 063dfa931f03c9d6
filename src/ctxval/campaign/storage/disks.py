"""Disks on which a store is not safe, folders that survive a power cut, and results that a store cannot take."""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import suppress
from pathlib import Path

from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError


class StoreWarning(UserWarning):
    """The disk of a store may lose or damage it."""


def file_system(path: Path, mounts: str) -> str:
    """Return the type of the file system that holds a path, by a table of mounts in the format of /proc/mounts."""
    lines = [line.split() for line in mounts.splitlines()]
    places = [(Path(line[1].replace("\\040", " ")), line[2]) for line in lines if len(line) > 2]
    holding = [(len(place.parts), kind) for place, kind in places if path.is_relative_to(place)]
    return max(holding, default=(0, ""))[1]


def network(path: Path) -> str:
    """Return the file system of another machine that a path is on; empty if it is on none, or if that is not known."""
    networks = ("nfs", "nfs4", "cifs", "smb3", "smbfs", "afs", "ncpfs", "fuse.sshfs", "fuse.rclone")
    kind = ""
    with suppress(OSError, ValueError):
        kind = file_system(path.absolute(), Path("/proc/mounts").read_text())
    return kind if kind in networks else ""


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents so that they survive a power cut."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for place in missing:
        sync_folder(place.parent)


def sync_folder(folder: Path) -> None:
    """Flush the directory entries of a folder to the disk, if the operating system supports it."""
    with suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def error_with_fallback(
    ended: Trial, trajectory: Trajectory | None, store: Path | None, error: CtxvalError
) -> CtxvalError:
    """Write what an execution gave to a file next to the store or a temporary one; return an error that names it."""
    if not ended.executed:
        return error
    if trajectory is None:
        values = {"trial": ended.number, "distance": ended.distance, "failure": ended.failure}
        content, suffix = json.dumps(values).encode(), "json"
    else:
        content, suffix = trajectory.to_npz(), "npz"
    name = f"{'memory' if store is None else store.stem}.trial-{ended.number}"
    folders = (Path() if store is None else store.parent, Path(tempfile.gettempdir()))
    path = next(filter(None, (_written(content, folder, name, suffix) for folder in folders)), None)
    if path is None:
        return type(error)(f"{error} The result of trial {ended.number} could not be written to a file either.")
    how = f"--npz {path}" if trajectory is not None else "--failed or --distance with the value in the file"
    return type(error)(
        f"{error} The result of trial {ended.number} is kept in {path}: when the store can be written again, "
        f"run `ctxval tell STORE {ended.number} {how}` before any other command."
    )


def _written(content: bytes, folder: Path, name: str, suffix: str) -> Path | None:
    """Write a file that survives a power cut, beside those of other attempts; None if this is not possible."""
    for count in range(1000):
        path = folder / f"{name}{f'.{count}' if count else ''}.{suffix}"
        try:
            file = path.open("xb")
        except FileExistsError:
            continue
        except OSError:
            return None
        try:
            with file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):
                path.unlink()
            return None
        sync_folder(folder)
        return path
    return None
