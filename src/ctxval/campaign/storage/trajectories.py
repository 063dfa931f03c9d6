"""The trajectories of a store, of which those of the system stay in memory once they are read."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from ctxval.campaign.storage.database import Database
from ctxval.campaign.storage.rows import checksum_of, read_trajectory
from ctxval.core.trajectory import Trajectory

Side = Literal["model", "system"]


class StoredTrajectories:
    """Reads and writes the trajectories of one store.

    The system's trajectories are read again for each choice of a task, so they are kept in memory after the first
    time. A stored trajectory does not change. If another connection has written to the file nevertheless, the
    checksums in the file show which ones are read again.
    """

    def __init__(self, database: Database, memory: int = 512 * 2**20) -> None:
        self._database, self._left = database, memory
        self._kept: dict[int, tuple[int, Trajectory]] = {}
        self._missing: set[int] = set()
        self._version: int | None = None

    def read(self, numbers: Iterable[int], side: Side) -> dict[int, Trajectory]:
        """Return the stored trajectories of trials by number; a trial without one is left out."""
        if side == "model":
            rows = ((number, self._read(number, side)) for number in numbers)
            return {number: row[1] for number, row in rows if row is not None}
        with self._database.snapshot():
            version = self._database.execute("PRAGMA data_version").fetchone()[0]
            if version != self._version:  # another connection may have changed the file
                statement = "SELECT trial, checksum FROM trajectories WHERE side = 'system'"
                stored = dict(self._database.execute(statement)) if self._kept else {}
                self._version = version
                self._missing.clear()
                for number in [n for n, (checksum, _) in self._kept.items() if stored.get(n) != checksum]:
                    self._left += _size(self._kept.pop(number)[1])
        of_system = ((number, self._of_system(number)) for number in numbers)
        return {number: trajectory for number, trajectory in of_system if trajectory is not None}

    def write(self, number: int, side: Side, trajectory: Trajectory | None) -> None:
        """Store a trajectory of a trial, if there is one. Call this inside a transaction."""
        if trajectory is None:
            return
        npz = trajectory.to_npz()
        self._missing.discard(number)
        self._database.execute(
            "INSERT INTO trajectories (trial, side, npz, checksum) VALUES (?, ?, ?, ?)",
            (number, side, npz, checksum_of((number, side, npz))),
        )

    def remove(self, number: int, side: Side) -> None:
        """Remove a trajectory of a trial, if there is one. Call this inside a transaction."""
        self._database.execute("DELETE FROM trajectories WHERE trial = ? AND side = ?", (number, side))
        if number in self._kept:
            self._left += _size(self._kept.pop(number)[1])

    def _of_system(self, number: int) -> Trajectory | None:
        if number in self._missing:
            return None
        if number in self._kept:
            return self._kept[number][1]
        row = self._read(number, "system")
        if row is None:
            self._missing.add(number)
            return None
        trajectory = row[1]
        if (size := _size(trajectory)) <= self._left:  # to drop an older one would not help: all are read in turn
            for array in (trajectory.times, trajectory.states, trajectory.inputs):
                array.setflags(write=False)
            self._left -= size
            self._kept[number] = row
        return trajectory

    def _read(self, number: int, side: Side) -> tuple[int, Trajectory] | None:
        where = "FROM trajectories {} WHERE trial = ? AND side = ?"
        with self._database.snapshot():
            row = self._database.execute(f"SELECT npz, checksum {where.format('')}", (number, side)).fetchone()
            # A damaged index may hide a row. The search without the index is slower, so it runs only if none is found.
            hidden = (
                row is None
                and self._database.execute(f"SELECT 1 {where.format('NOT INDEXED')}", (number, side)).fetchone()
            )
        if row is None and not hidden:
            return None
        trajectory = None if row is None else read_trajectory(number, side, *row)
        if trajectory is None:
            raise self._database.damaged(f"the {side}'s trajectory of its trial {number} cannot be read")
        return int(row[1]), trajectory


def _size(trajectory: Trajectory) -> int:
    return trajectory.times.nbytes + trajectory.states.nbytes + trajectory.inputs.nbytes
