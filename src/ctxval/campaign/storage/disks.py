"""Warnings about disks on which a store is not safe, and folders that survive a power cut."""

from __future__ import annotations

import contextlib
import os
import warnings
from pathlib import Path


class StoreWarning(UserWarning):
    """The disk of a store may lose or damage it."""


_NETWORKS = ("nfs", "nfs4", "cifs", "smb3", "smbfs", "afs", "ncpfs", "fuse.sshfs", "fuse.rclone")
"""File systems of other machines, whose locks and flushes are not reliable."""


def file_system(path: Path, mounts: str) -> str:
    """Return the type of the file system that holds a path, by a table of mounts in the format of /proc/mounts."""
    lines = [line.split() for line in mounts.splitlines()]
    places = [(Path(line[1].replace("\\040", " ")), line[2]) for line in lines if len(line) > 2]
    holding = [(len(place.parts), kind) for place, kind in places if path.is_relative_to(place)]
    return max(holding, default=(0, ""))[1]


def network(path: Path) -> str:
    """Return the file system of another machine that a path is on; empty if it is on none, or if that is not known."""
    kind = ""
    with contextlib.suppress(OSError, ValueError):
        kind = file_system(path.absolute(), Path("/proc/mounts").read_text())
    return kind if kind in _NETWORKS else ""


def warn_of_network(path: Path) -> None:
    """Warn if a store is on a file system of another machine."""
    if kind := network(path):
        warnings.warn(
            f"{path} is on a network file system ({kind}), whose locks and flushes are not reliable; keep "
            "the store on a disk of this computer.",
            StoreWarning,
            stacklevel=4,
        )


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents so that they survive a power cut."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for place in missing:
        sync_folder(place.parent)


def sync_folder(folder: Path) -> None:
    """Flush the directory entries of a folder to the disk, if the operating system supports it."""
    with contextlib.suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
