"""The campaigns that are recorded, each a process: ``python -m crash.campaigns NAME FOLDER MARKS [SYNCHRONOUS]``.

After each transaction the campaign says in the file of marks what its store holds, which is what was acknowledged.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sqlite3
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "benchmarks")]

from conftest import make_validation  # noqa: E402
from ctxval import Campaign, Store, Trajectory, searches  # noqa: E402
from ctxval.core.controller import Controller  # noqa: E402
from ctxval.core.task import Task  # noqa: E402
from ctxval.core.trial import Trial  # noqa: E402
from ctxval.errors import CtxvalError, DistanceError, ExecutionError, StoreAccessError  # noqa: E402

STORE = "runs/a.sqlite"
BUDGET = 6


class Counting:
    """A rig that counts its executions, fails at large angles, and kills its process in one of them, where told to."""

    def __init__(self, limit: float = 9.0, deadly: int | None = None) -> None:
        self.limit, self.deadly, self.executions = limit, deadly, 0

    def describe(self) -> dict[str, Any]:
        return {}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        if self.executions == self.deadly:
            os._exit(9)
        self.executions += 1
        if abs(task.goal[0]) > self.limit:
            raise ExecutionError(f"the motor cut out at {task.goal[0]:.2f} rad")
        return make_validation(horizon=15).system.execute(controller, task)


class Picky:
    """A distance that raises for some tasks, until it is mended."""

    def __init__(self, mended: bool = False) -> None:
        self.mended = mended

    def describe(self) -> dict[str, Any]:
        return {}

    def __call__(self, model: Trajectory, system: Trajectory, task: Task) -> Any:
        if not self.mended and task.goal[0] > 1.0:
            raise ValueError("the goal is out of the camera's sight")
        return abs(system.states[..., -1, 0] - model.states[..., -1, 0])


class Marked(Store):
    """A store that acknowledges in a file of marks what it holds after each transaction."""

    def __init__(self, path: Path, marks: Path, synchronous: str | None) -> None:
        self.marks = os.open(marks, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        super().__init__(path)
        if synchronous is not None:
            self._execute(f"PRAGMA synchronous = {synchronous}")

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        with super()._transaction():
            yield
        self.say(content(self._connection))

    def say(self, what: object) -> None:
        """Acknowledge something."""
        os.write(self.marks, json.dumps(what).encode() + b"\n")


class Full(Marked):
    """A store whose disk is full when the third execution has ended."""

    def close_trials(self, ended: Iterable[tuple[Trial, Trajectory | None]], *, changes: int | None = None) -> None:
        known = list(ended)
        if any(trial.number == 2 for trial, _ in known):
            raise StoreAccessError(f"{self.path} cannot be written: the disk is full.")
        super().close_trials(known, changes=changes)


def content(connection: sqlite3.Connection) -> str:
    """Return a digest of all that a database holds."""
    tables = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
    rows = {table: connection.execute(f"SELECT * FROM {table} ORDER BY rowid").fetchall() for table in tables}
    version = connection.execute("PRAGMA user_version").fetchone()
    return digest(repr((version, rows)).encode())


def digest(data: bytes) -> str:
    """Tell apart contents that differ."""
    return hashlib.sha256(data).hexdigest()[:24]


def rig_of(name: str) -> Counting:
    """Return the rig of a campaign."""
    return Counting(1.5 if name == "failures" else 9.0)


def campaign(name: str, store: Store | Path, system: Counting | None = None, *, mended: bool = False) -> Campaign:
    """Return a campaign as it is recorded, or resumed after the cut."""
    distance = Picky(mended) if name == "distance" else None
    validation = make_validation(system=system or rig_of(name), distance=distance, horizon=15)
    return Campaign(validation, search=searches.Random(), store=store, seed=3, name="power")


Opened = Callable[..., Marked]
Script = Callable[[Opened], None]


def _run(opened: Opened) -> None:
    campaign("run", opened()).run(BUDGET)


def _failures(opened: Opened) -> None:
    campaign("failures", opened()).run(BUDGET)


def _workers(opened: Opened) -> None:
    campaign("workers", opened()).run(BUDGET, workers=2)


def _hand(opened: Opened) -> None:
    """Ask and tell each trial in a process of its own, as several terminals do."""
    told = ({"distance": 0.25}, {"failed": "the motor cut out"}, {})
    for number in range(3):
        running = campaign("hand", opened())
        asked = running.ask()
        running.store.close()
        running = campaign("hand", opened())
        trajectory = {} if told[number] else {"trajectory": running.validation.execute(asked.plan)}
        running.tell(number, **trajectory, **told[number])
        running.store.close()
    running = campaign("hand", opened())
    running.store.keep_settings({"experiment": "power", "seed": 3})
    running.add({"goal": 0.5}, distance=0.125)
    running.ask({"goal": -1.0})


def _resumed(opened: Opened) -> None:
    """Be killed in an execution, twice; then resume, and audit."""
    for _ in range(2):
        child = os.fork()
        if child == 0:
            campaign("resumed", opened(), Counting(deadly=2)).run(BUDGET)
            os._exit(1)
        os.waitpid(child, 0)
    campaign("resumed", opened()).run(BUDGET - 1).audit(BUDGET)


def _distance(opened: Opened) -> None:
    """Go on behind trials whose distance raises; mend it, and measure again."""
    running = campaign("distance", opened())
    for _ in range(BUDGET):
        try:
            running.run(BUDGET)
            break
        except DistanceError:
            continue
    running.store.close()
    if hasattr(Campaign, "remeasure"):
        campaign("distance", opened(), mended=True).remeasure()


def _full(opened: Opened) -> None:
    """Keep an execution beside its store, tell it, and go on."""
    running = campaign("full", opened(Full))
    with contextlib.suppress(StoreAccessError):
        running.run(BUDGET)
    assert isinstance(running.store, Marked)
    assert running.store.path is not None
    (kept,) = running.store.path.parent.glob("*.trial-2.npz")
    running.store.say({"kept": str(Path(STORE).parent / kept.name), "digest": digest(kept.read_bytes())})
    running.store.close()
    running = campaign("full", opened())
    running.tell(2, Trajectory.from_npz(kept))
    running.run(BUDGET)


SCRIPTS: dict[str, Script] = {
    "run": _run,
    "failures": _failures,
    "workers": _workers,
    "hand": _hand,
    "resumed": _resumed,
    "distance": _distance,
    "full": _full,
}


def main(name: str, folder: str, marks: str, synchronous: str | None = None) -> None:
    """Run a campaign."""
    SCRIPTS[name](lambda kind=Marked: kind(Path(folder) / STORE, Path(marks), synchronous))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except CtxvalError as error:
        raise SystemExit(str(error)) from error
