"""Do the verdicts and choices of the present code agree with those of the frozen campaigns? Nothing is executed.

``python benchmarks/frozen_replay.py`` reads the campaigns of ``benchmarks/frozen/`` into new stores and computes again
how each ended, and what it would have executed after half of its trials and before the last one: a campaign's choice
after k trials is the task of the next one. The system in its place raises an exception. ``--sample 40`` replays so many
of them, spread over the groups; ``--store FILE`` keeps what was replayed, and resumes.

:func:`loaded` is the only place that knows how trials are stored: names that stores have changed since are mapped here.
"""

from __future__ import annotations

import argparse
import math
import re
import time
import warnings
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from calibrate import all_of
from ctxval import Campaign, Trajectory
from ctxval._util.arrays import single_threaded
from ctxval.campaign.storage.store import Store
from ctxval.core.trial import Trial
from ctxval.core.trial_note import TrialNote
from freeze import ENDING, FROZEN, call, outcome, read, search_of, validation_of
from json_lines import JsonLines

CLOSE = 1e-6
"""Relative difference of numbers, and difference of tasks in the unit cube, that is none."""
EXACT = ("answer", "kind", "witness")
NUMBERS = ("bound", "volume")
TEXTS = ("reason", "withdrawn")
"""Differences of texts, and of bounds that are withdrawn, are notes: words may change."""


class Recorded:
    """A system with the attributes of another one that is never executed."""

    def __init__(self, system: Any) -> None:
        self._system = system

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_system":
            raise AttributeError(name)
        return False if name == "exact_batches" else getattr(self._system, name)

    def execute(self, controller: Any, task: Any) -> Trajectory:
        """Refuse the execution."""
        raise RuntimeError("a replay executes nothing")


class Chosen(Exception):  # noqa: N818
    """A campaign has chosen its next task."""


# The store of a frozen campaign


def loaded(frozen: Mapping[str, Any], count: int | None = None) -> Campaign:
    """Return the campaign with its first trials in a new store, as if it had just executed them."""
    validation = validation_of(frozen["group"], frozen["system"], frozen["seed"])
    validation = validation.with_parts(system=Recorded(validation.system))
    store = Store()
    campaign = Campaign(validation, search=search_of(frozen), store=store, seed=frozen["seed"])
    if frozen["draws"] is not None:
        store.keep_draws(frozen["draws"])
    if frozen["threshold"] is not None:
        campaign.state_threshold(frozen["threshold"])
    experiment = campaign.recorder.dynamics.experiment
    store.add((_trial(one, experiment), None, _trajectory(one["run"])) for one in frozen["trials"][:count])
    campaign.refresh()
    return campaign


def _trial(one: Mapping[str, Any], experiment: str) -> Trial:
    known = {name: value for name, value in one.items() if name not in ("point", "note", "run")}
    note = dict(one["note"] or {})
    if "prediction" in note:
        # It belongs to the present distance, however a validation describes itself by now.
        note["prediction"] = {**note["prediction"], "experiment": experiment}
    return Trial(unit_point=np.array(one["point"]), note=TrialNote.from_json(note), **known)


def _trajectory(run: Mapping[str, Any] | None) -> Trajectory | None:
    if run is None:
        return None
    times, states, inputs = (np.array(run[name], dtype=float) for name in ("times", "states", "inputs"))
    return Trajectory(times, states, inputs, run["ended"])


# What is compared


def next_trial(frozen: Mapping[str, Any], count: int) -> tuple[list[float], str] | None:
    """Return the task that a campaign chooses after so many trials, a point of the unit cube, and its origin."""
    step = next(k for k, end in enumerate(frozen["ends"]) if count < end)
    campaign = loaded(frozen, count)

    def stop(trial: Trial) -> None:
        raise Chosen

    with suppress(Chosen):
        call(campaign, frozen["steps"][step], frozen, on_trial=stop)
    if len(campaign.trials) == count:
        return None
    chosen = campaign.trials[count]
    return chosen.unit_point.tolist(), chosen.origin


def replay(path: Path) -> dict[str, Any]:
    """Return how a replay differs from a frozen campaign: ``differs`` and ``notes``, each a list of sentences."""
    frozen, started = read(path), time.process_time()
    differs, notes, count = list[str](), list[str](), len(frozen["trials"])
    with single_threaded(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for known in sorted({count // 2, count - 1}):
                wanted, found = frozen["trials"][known], next_trial(frozen, known)
                differs += _other_task(f"after {known} trials", wanted["point"], wanted["origin"], found)
            campaign = loaded(frozen)
            call(campaign, frozen["steps"][-1], frozen)
            if len(campaign.trials) > count:
                differs.append(f"it goes on after {count} trials, at {campaign.trials[count].unit_point.tolist()}")
                campaign = loaded(frozen)
            _compare(frozen["outcome"], outcome(campaign, frozen), differs, notes)
        except Exception as error:
            differs.append(f"{type(error).__name__}: {error}")
    result = {"name": frozen["name"], "group": frozen["group"], "answer": frozen["outcome"]["answer"]}
    return {**result, "differs": differs, "notes": notes, "seconds": round(time.process_time() - started, 1)}


def _other_task(when: str, wanted: list[float], origin: str, found: tuple[list[float], str] | None) -> list[str]:
    if found is None:
        return [f"{when} it ends"]
    gap = float(np.abs(np.subtract(wanted, found[0])).max())
    if gap > CLOSE or origin != found[1]:
        return [f"{when} the task differs by {gap:.2g}: {origin} {wanted}, now {found[1]} {found[0]}"]
    return []


def _compare(wanted: Mapping[str, Any], found: Mapping[str, Any], differs: list[str], notes: list[str]) -> None:
    for name in EXACT:
        if wanted.get(name) != found.get(name):
            differs.append(f"{name} {wanted.get(name)}, now {found.get(name)}")
    for name in NUMBERS:
        if not same(wanted.get(name), found.get(name)):
            differs.append(f"{name} {wanted.get(name)}, now {found.get(name)}")
    if not same(wanted.get("next"), found.get("next")):
        differs.append(f"next task {wanted.get('next')}, now {found.get('next')}")
    if not same(wanted.get("upper"), found.get("upper")):
        notes.append(f"withdrawn bound {wanted.get('upper')}, now {found.get('upper')}")
    for name in TEXTS:
        if _without_numbers(wanted.get(name)) != _without_numbers(found.get(name)):
            notes.append(f"{name}: {wanted.get(name)}\n    now: {found.get(name)}")
    before, now = wanted.get("envelope") or {}, found.get("envelope") or {}
    for name in before:
        if name == "withdrawn":
            if (before[name] is None) != (now.get(name) is None):
                differs.append(f"envelope withdrawn: {before[name]}, now {now.get(name)}")
        elif not same(before[name], now.get(name)):
            differs.append(f"envelope's {name} {before[name]}, now {now.get(name)}")


def same(wanted: Any, found: Any) -> bool:
    """Return whether values of JSON are the same, numbers up to a relative difference."""
    if isinstance(wanted, Mapping) and isinstance(found, Mapping):
        return wanted.keys() == found.keys() and all(same(value, found[key]) for key, value in wanted.items())
    if isinstance(wanted, list) and isinstance(found, list):
        return len(wanted) == len(found) and all(map(same, wanted, found))
    if isinstance(wanted, int | float) and isinstance(found, int | float):
        return wanted == found or math.isclose(wanted, found, rel_tol=CLOSE, abs_tol=1e-12)
    return bool(wanted == found)


def _without_numbers(text: str | None) -> str | None:
    return None if text is None else re.sub(r"[-+]?\d[\d.,e+-]*", "#", text)


def sample(paths: list[Path], count: int) -> list[Path]:
    """Return so many files, spread over the groups and over each of them."""
    groups: dict[str, list[Path]] = {}
    for path in sorted(paths):
        groups.setdefault(path.parent.name, []).append(path)
    placed = [((k + 0.5) / len(group), path) for group in groups.values() for k, path in enumerate(group)]
    ordered = [path for _, path in sorted(placed)]
    return [ordered[k] for k in np.unique(np.linspace(0, len(ordered) - 1, min(count, len(ordered))).astype(int))]


def table(results: list[dict[str, Any]]) -> str:
    """Return how many replays agree, by group and by the answer of the frozen campaign."""
    head = "| group | campaigns | agree | validated | falsified | undecided or none | with notes | CPU s |"
    lines = [head, "|---" * 8 + "|"]
    groups = sorted({one["group"] for one in results})
    for name in [*groups, "all"]:
        of = [one for one in results if name in (one["group"], "all")]
        answers = Counter(one["answer"] for one in of if not one["differs"])
        totals = Counter(one["answer"] for one in of)
        shown = [f"{answers[answer]} of {totals[answer]}" for answer in ("validated", "falsified")]
        decided = {"validated", "falsified"}
        rest = [sum(number for answer, number in each.items() if answer not in decided) for each in (answers, totals)]
        notes, seconds = sum(bool(one["notes"]) for one in of), sum(one["seconds"] for one in of)
        cells = [name, len(of), sum(answers.values()), *shown, f"{rest[0]} of {rest[1]}", notes, round(seconds)]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    """Replay the campaigns, and print the table, each disagreement, and with ``--notes`` each note."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=FROZEN)
    parser.add_argument("--group", nargs="*", help="only these groups")
    parser.add_argument("--only", help="only campaigns whose file has this in its name")
    parser.add_argument("--sample", type=int, help="how many are replayed; all by default")
    parser.add_argument("--store", type=Path, help="a file of results, to resume with")
    parser.add_argument("--notes", action="store_true", help="print how texts and withdrawn bounds differ, too")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    paths = sorted(given.folder.glob(f"*/*{ENDING}"))
    paths = [path for path in paths if not given.group or path.parent.name in given.group]
    paths = [path for path in paths if given.only is None or given.only in path.name]
    paths = paths if given.sample is None else sample(paths, given.sample)
    stored = None if given.store is None else JsonLines(given.store, ("file",))
    files = {str(path.relative_to(given.folder)): path for path in paths}
    results = [stored[file,] for file in files if stored is not None and (file,) in stored]
    left = [path for file, path in files.items() if stored is None or (file,) not in stored]
    for result in all_of(_replay_file, [(path, given.folder) for path in left], given.workers):
        if stored is not None:
            stored.append(result)
        results.append(result)
        print("\r" + ("differs " if result["differs"] else "agrees  ") + result["name"], result["seconds"], flush=True)
    for one in results:
        for sentence in [*one["differs"], *(f"(note) {note}" for note in one["notes"] if given.notes)]:
            print(f"{one['name']}: {sentence}")
    print(table(results))
    raise SystemExit(any(one["differs"] for one in results))


def _replay_file(asked: tuple[Path, Path]) -> dict[str, Any]:
    path, folder = asked
    return {"file": str(path.relative_to(folder)), **replay(path)}


if __name__ == "__main__":
    main()
