"""How much of a campaign a power cut can take: every disk that it could leave is opened again, thousands of them.

``python benchmarks/crash_states.py --each 8`` records the campaigns of `crash/campaigns.py` with strace, plays their
writes and syncs on the model of a disk in `crash/disk.py`, cuts the power after each of them in many ways, and opens
the store of what is left. Writes benchmarks/results/crash_states.jsonl; `benchmarks/reliability.py` makes the page.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import sqlite3
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "benchmarks")]

from crash.campaigns import BUDGET, SCRIPTS, STORE, campaign, content, digest, rig_of  # noqa: E402
from crash.disk import Disk, Files, Mode  # noqa: E402
from crash.recorder import Event, record  # noqa: E402
from ctxval import Store  # noqa: E402
from ctxval.core.trial import Trial  # noqa: E402
from ctxval.errors import CtxvalError  # noqa: E402
from json_lines import JsonLines  # noqa: E402

STORED = JsonLines(ROOT / "benchmarks" / "results" / "crash_states.jsonl", ("synchronous", "mode"))
MODES: tuple[Mode, ...] = ("ordered", "strict")
COUNTS = ("states", "distinct", "opened", "lost", "twice", "changed", "refused", "crashed", "resumed", "went on")


@dataclass(frozen=True, eq=False)
class Recording:
    """A campaign's writes and syncs, and what it acknowledged between them.

    Attributes:
        name: of the campaign.
        events: in order.
        said: digests of the store after each transaction.
    """

    name: str
    events: list[Event]
    said: list[str]


@dataclass(frozen=True, eq=False)
class State:
    """What a power cut left.

    Attributes:
        files: of the campaign's folder.
        acknowledged: how many transactions had been.
        kept: what had been said to be kept beside the store, by the digests of these files.
    """

    files: Files
    acknowledged: int
    kept: dict[str, str]

    @property
    def key(self) -> str:
        """Tells apart states that differ."""
        return hashlib.sha256(repr((self.acknowledged, self.kept, sorted(self.files.items()))).encode()).hexdigest()


def recorded(name: str, folder: Path, synchronous: str | None = None) -> Recording:
    """Run a campaign and record it."""
    place, marks = folder / name, folder / f"{name}.marks"
    place.mkdir()
    script = [sys.executable, "-m", "crash.campaigns", name, str(place), str(marks)]
    with contextlib.chdir(ROOT / "benchmarks"):
        events = record([*script, *([] if synchronous is None else [synchronous])], place, marks, folder / "log")
    return Recording(name, events, [event.mark for event in events if isinstance(event.mark, str)])


def states(recording: Recording, mode: Mode, each: int, seed: int) -> Iterator[State]:
    """Cut the power after each event: at the four corners of what may be left, and in so many other ways."""
    disk, acknowledged = Disk(mode), 0
    kept: dict[str, str] = {}
    rng = np.random.default_rng([seed, MODES.index(mode)])
    for event in recording.events:
        if isinstance(event.mark, str):
            acknowledged += 1
        elif event.kind == "mark":
            kept = {**kept, event.mark["kept"]: event.mark["digest"]}
        disk.tell(event)
        for writes in (True, False):
            for names in (True, False):
                yield State(disk.corner(writes=writes, names=names), acknowledged, kept)
        for _ in range(each if disk.loose else 0):
            yield State(disk.cut(rng), acknowledged, kept)


def examine(recording: Recording, state: State, *, resume: bool) -> Counter[str]:
    """Open what a power cut left, with SQLite alone and with the package; go on with it where that is wanted."""
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as name:
        raw, own = Path(name) / "raw", Path(name) / "own"
        for place in (raw, own):
            _write(state.files, place)
        found = Counter({"states": 1})
        try:
            found[_held(recording, state, raw / STORE)] += 1
            _open(recording, state, own / STORE, found, resume=resume)
        except CtxvalError:
            found["refused"] += 1
        except Exception as error:
            found["crashed"] += 1
            print(f"{recording.name}: {type(error).__name__}: {error}", file=sys.stderr)
        return found


def _held(recording: Recording, state: State, path: Path) -> str:
    """Return whether a store holds what was acknowledged, and perhaps what was being written."""
    if any(digest(state.files.get(name, b"")) != known for name, known in state.kept.items()):
        return "lost"
    if state.acknowledged == 0:
        return "opened"
    if not path.exists():
        return "lost"
    connection = sqlite3.connect(path)
    try:
        found = content(connection)
    except sqlite3.DatabaseError:
        return "changed"
    finally:
        connection.close()
    if found in recording.said[state.acknowledged - 1 : state.acknowledged + 1]:
        return "opened"
    return "lost" if found in recording.said or found == _EMPTY else "changed"


def _open(recording: Recording, state: State, path: Path, found: Counter[str], *, resume: bool) -> None:
    """Open a store as the package does, which makes what is not there yet; then go on with it."""
    store = Store(path)
    for number in range(len(store.trials())):
        store.trajectory(number, "model"), store.trajectory(number, "system")
    if resume and store.description():
        found["resumed"] += 1
        found[_gone_on(recording, store)] += 1
    store.close()


def _gone_on(recording: Recording, store: Store) -> str:
    """Resume a campaign to the end of its budget; return whether what had ended was left alone."""
    trials = store.trials()
    # What has no distance yet is measured by whoever goes on.
    ended = {trial.number: trial for trial in trials if trial.state in ("completed", "failed")}
    executed = sum(trial.executed for trial in trials)
    rig = rig_of(recording.name)
    running = campaign(recording.name, store, rig, mended=True).run(BUDGET)
    if any(_facts(running.trials[number]) != _facts(trial) for number, trial in ended.items()):
        return "changed"
    return "twice" if rig.executions + executed > max(BUDGET, executed) else "went on"


def _facts(trial: Trial) -> tuple[object, ...]:
    return (trial.unit_point.tobytes(), trial.state, trial.distance, trial.failure, trial.executed)


def _write(files: Files, folder: Path) -> None:
    folder.mkdir()
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


_EMPTY = content(sqlite3.connect(":memory:"))


def _examined(given: tuple[Recording, State, bool]) -> Counter[str]:
    recording, state, resume = given
    return examine(recording, state, resume=resume)


def count(
    recording: Recording, mode: Mode, each: int, seed: int, resume_each: int, workers: int, every: int = 1
) -> Counter[str]:
    """Examine the states of a recording that differ, or every so many-th of them; each so many-th is resumed."""
    unlike: dict[str, State] = {}
    total = 0
    for state in states(recording, mode, each, seed):
        total += 1
        unlike.setdefault(state.key, state)
    chosen = [*unlike.values()][::every]
    jobs = [(recording, state, place % resume_each == 0) for place, state in enumerate(chosen)]
    counts: Counter[str] = Counter(dict.fromkeys(COUNTS, 0))
    with ProcessPoolExecutor(workers) if workers > 1 else contextlib.nullcontext() as pool:
        examined = map(_examined, jobs) if pool is None else pool.map(_examined, jobs, chunksize=64)
        for found in examined:
            counts.update(found)
    counts["distinct"], counts["states"] = len(chosen), total
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=8, help="random cuts after each event")
    parser.add_argument("--resume-each", type=int, default=10, help="each so many-th state is resumed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--synchronous", help="PRAGMA of the recorded stores, in place of the package's own")
    parser.add_argument("--only", nargs="*", default=list(SCRIPTS), help="these campaigns")
    given = parser.parse_args()
    counts: dict[str, Any] = {mode: Counter(dict.fromkeys(COUNTS, 0)) for mode in MODES}
    with tempfile.TemporaryDirectory() as name:
        for script in given.only:
            recording = recorded(script, Path(name), given.synchronous)
            for mode in MODES:
                found = count(recording, mode, given.each, given.seed, given.resume_each, given.workers)
                print(script, mode, len(recording.events), dict(found), flush=True)
                counts[mode].update(found)
    for mode, found in counts.items():
        STORED.append({"synchronous": given.synchronous or "own", "mode": mode, **found})


if __name__ == "__main__":
    main()
