"""How often each fault was inflicted, and what came of it. Writes docs/reliability.md, from the stored counts alone.

``python benchmarks/reliability.py --kills 100 --worker-kills 50 --flips 2000 --cuts 200`` adds to the counts.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from conftest import make_validation  # noqa: E402
from ctxval import Campaign, Store, searches  # noqa: E402
from ctxval.salvage import salvage  # noqa: E402
from rig_workers import campaign as logged  # noqa: E402
from test_faults import check_damaged, everything  # noqa: E402
from test_kill import BUDGET, content, killed_and_resumed, start  # noqa: E402
from test_workers import start as start_workers  # noqa: E402
from test_workers import until  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results" / "reliability.json"
PAGE = ROOT / "docs" / "reliability.md"

FAULTS = {
    "kill": "`kill -9` of the campaign, one worker, at a random instant",
    "kill workers": "`kill -9` of the campaign with three workers, at a random instant",
    "kill worker": "`kill -9` of one of three workers",
    "flip": "1 to 3 bytes of the store changed",
    "cut": "the store cut at a random byte",
}
COLUMNS = ("inflicted", "midway", "lost", "twice", "same end", "noticed", "harmless", "silent")


def kills(count: int, folder: Path, seed: int) -> dict[str, int]:
    """Kill a campaign of one worker; the resumed one must end bit for bit as the unbroken one."""
    whole = folder / "whole.sqlite"
    began = time.perf_counter()
    assert start(whole).wait(timeout=300) == 0
    duration, expected = time.perf_counter() - began, content(whole)
    counts = dict.fromkeys(("inflicted", "midway", "lost", "same end"), 0)
    rng = np.random.default_rng(seed)
    for number in range(count):
        store = folder / f"kill{number}.sqlite"
        before, after = killed_and_resumed(store, rng.uniform(0, duration))
        counts["inflicted"] += 1
        counts["midway"] += 0 < len(before) < BUDGET
        counts["lost"] += after[: len(before)] != before
        counts["same end"] += after == expected
        store.unlink()
    return counts


def worker_kills(count: int, folder: Path, seed: int, *, whole: bool) -> dict[str, int]:
    """Kill a campaign of three workers, or one of its workers; random draws must end as those of one worker."""
    (folder / "plain").mkdir(exist_ok=True)
    expected = {t.number: t.distance for t in logged(None, str(folder / "plain"), 0).run(8).trials}
    counts = dict.fromkeys(("inflicted", "lost", "twice", "same end"), 0)
    rng = np.random.default_rng(seed)
    for number in range(count):
        store, marks = folder / f"{whole}{number}.sqlite", folder / f"marks{whole}{number}"
        process = start_workers(store, marks, 3, budget=8)
        until(lambda marks=marks: any(marks.iterdir()))
        time.sleep(rng.uniform(0, 0.7))
        victim = int(rng.choice(sorted({int(mark.name.split("-")[-2]) for mark in marks.iterdir()})))
        if whole:
            process.kill()
        else:
            with contextlib.suppress(ProcessLookupError):
                os.kill(victim, signal.SIGKILL)
        process.communicate(timeout=60)
        before = {t.number: t.distance for t in Store(store).trials() if t.state == "completed"}
        trials = logged(str(store), str(marks), 0).run(8).trials
        counts["inflicted"] += 1
        counts["lost"] += any(trials[k].distance != d for k, d in before.items())
        counts["twice"] += len(trials) != 8
        counts["same end"] += {t.number: t.distance for t in trials} == expected
    return counts


def damage(count: int, folder: Path, seed: int, *, cut: bool) -> dict[str, int]:
    """Damage a store; it is noticed, or everything that is read is what was written."""
    path = folder / "damaged.sqlite"
    whole = folder / "sound.sqlite"
    if not whole.exists():
        campaign = Campaign(make_validation(), search=searches.Random(), store=whole, seed=2).run(12)
        campaign.store.close()
    expected, data = everything(Store(whole)), whole.read_bytes()
    counts = dict.fromkeys(("inflicted", "noticed", "harmless", "silent"), 0)
    rng = np.random.default_rng(seed)
    for number in range(count):
        broken = bytearray(data[: rng.integers(1, len(data))] if cut else data)
        for position in () if cut else rng.integers(len(data), size=1 + number % 3):
            broken[position] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(broken))
        counts["inflicted"] += 1
        try:
            counts["noticed" if check_damaged(path, expected) else "harmless"] += 1
        except AssertionError:
            counts["silent"] += 1
        for trial in salvage(path).trials.values():
            assert trial.distance == expected[0][trial.number][4]
    return counts


HEAD = """\
# Reliability

Faults inflicted on real processes and files, and what came of them. Written by `benchmarks/reliability.py` from
`benchmarks/results/reliability.json`; running it again adds to the counts.

"""

TAIL = """
- *midway*: some executions had been stored, and not all.
- *lost*: a stored execution was gone or changed after the fault; *twice*: one was counted twice.
- *same end*: the resumed campaign ended as the unbroken one did, bit for bit.
- *noticed*: reading the store gave an error that says so; *harmless*: every trial and every trajectory was read as it
  had been written; *silent*: something was read that had never been written.

The tests inflict each of them too, fewer times, and besides: a store on a full disk and in a read-only folder, a clock
that is set back, executions that hang, raise, return NaN, the wrong shape or a part of a trajectory, Ctrl-C once and
twice, a Dask worker killed in a campaign, several terminals at once, random sequences of asking, telling, running and
dying against a model of the store, and random bytes for every reader (`tests/test_faults.py`, `tests/test_workers.py`,
`tests/test_hand.py`, `tests/test_kill.py`).
"""


def page(results: dict[str, dict[str, int]]) -> str:
    """Return the document."""
    rows = [["fault", *COLUMNS], ["---"] * (1 + len(COLUMNS))]
    for fault, title in FAULTS.items():
        if fault in results:
            rows.append([title, *(str(results[fault].get(column, "")) for column in COLUMNS)])
    return HEAD + "".join(f"| {' | '.join(row)} |\n" for row in rows) + TAIL


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("kills", "worker-kills", "flips", "cuts"):
        parser.add_argument(f"--{name}", type=int, default=0)
    given = parser.parse_args()
    results: dict[str, dict[str, int]] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    seed = sum(counts["inflicted"] for counts in results.values())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        jobs = {
            "flip": (given.flips, lambda count: damage(count, folder, seed, cut=False)),
            "cut": (given.cuts, lambda count: damage(count, folder, seed, cut=True)),
            "kill worker": (given.worker_kills, lambda count: worker_kills(count, folder, seed, whole=False)),
            "kill workers": (given.worker_kills, lambda count: worker_kills(count, folder, seed, whole=True)),
            "kill": (given.kills, lambda count: kills(count, folder, seed)),
        }
        for fault, (count, inflict) in jobs.items():
            if count:
                new = inflict(count)
                results[fault] = {key: results.get(fault, {}).get(key, 0) + value for key, value in new.items()}
                RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    PAGE.write_text(page(results))


if __name__ == "__main__":
    main()
