"""What a power cut leaves on a disk.

A file is what it was when it was last synced, and of the writes since then each is there, or a part of it, or not, in
any order. The names in a folder are those that it had when it was last synced, and of the changes since then

* ``ordered``: the first few, as journalling file systems write them (ext4, xfs, btrfs); there, syncing a new file
  writes the names too,
* ``strict``: any, name by name, as POSIX allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

from crash.recorder import Event

Mode = Literal["ordered", "strict"]
Files = dict[str, bytes]
Fates = Callable[[list["Change"], np.random.Generator], list["Change"]]

SECTOR = 512


@dataclass(frozen=True)
class Change:
    """A write, or a new size where there are no data."""

    offset: int
    data: bytes | None = None

    def on(self, content: bytearray, filler: np.random.Generator | None = None) -> None:
        """Apply it; a hole that it leaves is full of zeros, or of what was on the disk before."""
        if self.data is None:
            del content[self.offset :]
            content.extend(b"\0" * (self.offset - len(content)))
            return
        missing = self.offset - len(content)
        if missing > 0:
            content.extend(b"\0" * missing if filler is None else filler.bytes(missing))
        content[self.offset : self.offset + len(self.data)] = self.data


@dataclass(eq=False)
class _File:
    """What is on the disk for certain, and what was changed since."""

    durable: bytes = b""
    size: int = 0
    changes: list[Change] = field(default_factory=list)
    named: bool = False

    def add(self, change: Change) -> None:
        change = Change(self.size, change.data) if change.offset < 0 else change
        self.size = change.offset if change.data is None else max(self.size, change.offset + len(change.data))
        self.changes.append(change)

    def sync(self) -> None:
        self.durable = self.left(self.changes)
        self.changes = []

    def left(self, changes: list[Change], filler: np.random.Generator | None = None) -> bytes:
        content = bytearray(self.durable)
        for change in changes:
            change.on(content, filler)
        return bytes(content)


@dataclass(frozen=True, eq=False)
class _Naming:
    """A change of a folder: this name is then this file, a folder (a file None), or nothing at all."""

    name: str
    file: _File | None = None
    gone: bool = False


class Disk:
    """A disk that is told each event, and says what a power cut would leave of it."""

    def __init__(self, mode: Mode) -> None:
        self.mode: Mode = mode
        self._names: dict[str, _File | None] = {}
        self._kept: dict[str, _File | None] = {}
        self._namings: list[_Naming] = []

    def tell(self, event: Event) -> None:
        """Take in what happened."""
        match event.kind:
            case "create":
                self._name(_Naming(event.path, _File()))
            case "mkdir":
                self._name(_Naming(event.path))
            case "unlink" | "rmdir":
                self._name(_Naming(event.path, gone=True))
            case "rename":
                self._name(_Naming(event.target, self._names[event.path]))
                self._name(_Naming(event.path, gone=True))
            case "write":
                self._file(event.path).add(Change(event.offset, event.data))
            case "truncate":
                self._file(event.path).add(Change(event.offset))
            case "sync":
                self._sync(self._file(event.path))
            case "sync folder":
                self._sync_folder(event.path)

    def _file(self, path: str) -> _File:
        file = self._names[path]
        assert file is not None
        return file

    def _name(self, naming: _Naming) -> None:
        _apply(naming, self._names)
        self._namings.append(naming)

    def _sync(self, file: _File) -> None:
        file.sync()
        if self.mode == "ordered" and any(naming.file is file for naming in self._namings):
            self._keep(self._namings)

    def _sync_folder(self, folder: str) -> None:
        inside = [naming for naming in self._namings if str(PurePosixPath(naming.name).parent) == (folder or ".")]
        self._keep(self._namings if self.mode == "ordered" else inside)

    def _keep(self, namings: list[_Naming]) -> None:
        for naming in namings:
            _apply(naming, self._kept)
        self._namings = [naming for naming in self._namings if naming not in namings]

    # The power is cut

    @property
    def loose(self) -> int:
        """How many changes are not on the disk for certain."""
        files = {id(file): file for file in (*self._names.values(), *self._kept.values()) if file is not None}
        return len(self._namings) + sum(len(file.changes) for file in files.values())

    def corner(self, *, writes: bool, names: bool) -> Files:
        """Return what is left where the changes since the last sync, of files and of folders, all stay or all go."""
        return self._left(
            self._namings if names else [], lambda changes, _: changes if writes else [], np.random.default_rng(0), None
        )

    def cut(self, rng: np.random.Generator) -> Files:
        """Return what may be left: some writes whole, torn, in another order, or not at all."""
        fate = FATES[int(rng.integers(len(FATES)))]
        return self._left(self._some_namings(rng), fate, rng, rng if rng.random() < 0.5 else None)

    def _some_namings(self, rng: np.random.Generator) -> list[_Naming]:
        if self.mode == "ordered":
            return self._namings[: int(rng.integers(len(self._namings) + 1))]
        counts: dict[str, int] = {}
        for naming in self._namings:
            counts[naming.name] = counts.get(naming.name, 0) + 1
        kept = {name: int(rng.integers(count + 1)) for name, count in counts.items()}
        found = []
        for naming in self._namings:
            if kept[naming.name]:
                kept[naming.name] -= 1
                found.append(naming)
        return found

    def _left(
        self, namings: list[_Naming], fate: Fates, rng: np.random.Generator, filler: np.random.Generator | None
    ) -> Files:
        names = dict(self._kept)
        for naming in namings:
            _apply(naming, names)
        files = {name: file for name, file in names.items() if file is not None and _reachable(name, names)}
        return {name: file.left(fate(file.changes, rng), filler) for name, file in sorted(files.items())}


def _apply(naming: _Naming, names: dict[str, _File | None]) -> None:
    if naming.gone:
        names.pop(naming.name, None)
    else:
        names[naming.name] = naming.file


def _reachable(name: str, names: dict[str, _File | None]) -> bool:
    """Return whether the folders that a file is in are there."""
    return all(str(parent) in names for parent in PurePosixPath(name).parents if str(parent) != ".")


def _whole(changes: list[Change], rng: np.random.Generator) -> list[Change]:
    return changes


def _none(changes: list[Change], rng: np.random.Generator) -> list[Change]:
    return []


def _first(changes: list[Change], rng: np.random.Generator) -> list[Change]:
    return changes[: int(rng.integers(len(changes) + 1))]


def _some(changes: list[Change], rng: np.random.Generator) -> list[Change]:
    return [change for change in changes if rng.random() < 0.5]


def _shuffled(changes: list[Change], rng: np.random.Generator) -> list[Change]:
    kept = _some(changes, rng)
    return [kept[place] for place in rng.permutation(len(kept))]


def _torn(changes: list[Change], rng: np.random.Generator) -> list[Change]:
    """Keep of some writes the first sectors, the last ones, or any."""
    return [part for change in _some(changes, rng) for part in _sectors(change, rng)]


def _sectors(change: Change, rng: np.random.Generator) -> list[Change]:
    if change.data is None:
        return [change]
    first = change.offset // SECTOR * SECTOR
    edges = [change.offset, *range(first + SECTOR, change.offset + len(change.data), SECTOR)]
    parts = [
        Change(begin, change.data[begin - change.offset : end - change.offset])
        for begin, end in zip(edges, [*edges[1:], change.offset + len(change.data)], strict=True)
    ]
    place = int(rng.integers(len(parts) + 1))
    kinds = (parts[:place], parts[place:], [part for part in parts if rng.random() < 0.5])
    return kinds[int(rng.integers(3))]


def _broken(changes: list[Change], rng: np.random.Generator) -> list[Change]:
    """Keep the first bytes of some writes."""
    return [
        change if change.data is None else Change(change.offset, change.data[: int(rng.integers(len(change.data) + 1))])
        for change in _some(changes, rng)
    ]


FATES: tuple[Fates, ...] = (_whole, _none, _first, _some, _shuffled, _torn, _torn, _broken)
"""What becomes of the writes to a file since it was last synced."""
