"""How soon a watch notices that a system has changed, and how often it says so of one that has not.

``python benchmarks/study_watch.py development`` and ``... reporting`` write ``benchmarks/results/watch.jsonl``, and
resume. ``benchmarks/watch_page.py`` writes the figures into ``docs/how-to/watch.md``. Each cell has one campaign that
validates the model; tasks are then drawn from the task space, executed, and given to the watch.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign
from ctxval.campaign.watching import Watch
from json_lines import JsonLines
from watch_systems import DEVELOPMENT, REPORTING, Watched

STORED = JsonLines(Path(__file__).parent / "results" / "watch.jsonl", ("system", "imperfection", "part"))

IMPERFECT = ("none", "process 0.1 %", "measurement 0.1 %", "measurement 0.5 %")
FALSE_ALARMS = 1e-3
MARGIN = 1.5  # tau over the largest true distance
BUDGET = 40  # executions of a campaign
HEAVIER, REPEATS, PATIENCE = 1.1, 15, 30
DRIFT, DRIFTS = 50, 5  # tasks in which the payload drifts, and repeats


class Cell:
    """A system with an imperfection, whose model a campaign has validated."""

    def __init__(self, name: str, watched: Watched, imperfection: str) -> None:
        self.watched, self.imperfection = watched, imperfection
        self.key = {"system": name, "imperfection": imperfection}
        self.threshold = MARGIN * self.largest(1.0)
        folder = Path(tempfile.gettempdir()) / "ctxval-study-watch"
        folder.mkdir(exist_ok=True)
        store = folder / f"{name} {imperfection.replace('%', 'percent')}.sqlite"  # campaigns take longest
        experiment = watched.experiment(imperfection)
        self.campaign = Campaign(experiment.validation, store=store, seed=0)
        self.campaign.run(BUDGET, self.threshold, thinking=np.inf, progress=False)
        self.watch: Watch | None = None

    def largest(self, payload: float) -> float:
        """Return the largest distance of 400 tasks with a payload."""
        validation = self.watched.experiment(self.imperfection, payload, seed=1).validation
        points = validation.space.from_unit(np.random.default_rng(5).random((400, validation.space.dimension)))
        return float(np.nan_to_num(validation.distances(points), nan=np.inf).max())

    def state(self) -> Watch:
        """Return the watch at its beginning."""
        if self.watch is None:
            self.watch = self.campaign.watch(self.threshold, FALSE_ALARMS, progress=False)
            self.begun = self.watch.state
        self.watch.state = self.begun
        return self.watch

    def execute(self, payload: float, seed: int) -> None:
        """Execute a random task with a payload, and give it to the watch."""
        validation, watch = self.watched.experiment(self.imperfection, payload, seed).validation, self.watch
        assert watch is not None
        point = validation.space.from_unit(np.random.default_rng(seed).random(validation.space.dimension))
        plan = validation.plan(point)
        executed = validation.system.execute(plan.controller, plan.task)
        # Noise may start anywhere near a task whose trajectory hardly moves.
        watch.update(executed, validation.space.describe_point(point), start_tolerance=1e6)


def certified(cell: Cell) -> dict[str, Any]:
    verdict = cell.campaign.verdict(cell.threshold)
    watch = cell.state()
    return {
        "answer": verdict.answer,
        "executions": cell.campaign.executions,
        "threshold": cell.threshold,
        "noisy": watch._statistics.learned.noisy is not None,
        "channels": len(watch.state.channels),
    }


def in_control(cell: Cell, tasks: int) -> dict[str, Any]:
    """Return the false alarms of an unchanged system; after each of them, the watch begins anew."""
    watch, alarms, largest = cell.state(), list[dict[str, Any]](), 0.0
    for number in range(tasks):
        cell.execute(1.0, 100_000 + number)
        largest = max(largest, watch.state.evidence)
        if watch.state.expired:
            alarms.append({"task": number, "sentence": watch.state.sentence})
            cell.state()
    return {"tasks": tasks, "alarms": alarms, "evidence": largest}


def payload(cell: Cell) -> dict[str, Any]:
    """Return after how many tasks a payload 10 % heavier is noticed; None if it is not."""
    delays, sentences = list[int | None](), list[str]()
    for repeat in range(REPEATS):
        watch, noticed = cell.state(), None
        for number in range(PATIENCE):
            cell.execute(HEAVIER, 200_000 + 1000 * repeat + number)
            if watch.state.expired:
                noticed = number + 1
                break
        delays.append(noticed)
        sentences.append(watch.state.sentence)
    return {"delays": delays, "sentence": sentences[0], "distance": cell.largest(HEAVIER) / cell.threshold}


def drift(cell: Cell) -> dict[str, Any]:
    """Return when a drift over 50 tasks is noticed, and when the largest distance exceeds the threshold."""
    ends = [end for end in (1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0) if cell.largest(end) > cell.threshold]
    if not ends:
        return {"end": None, "noticed": [], "exceeded": None}
    end = ends[0]
    payloads = [1 + (end - 1) * (number + 1) / DRIFT for number in range(DRIFT)]
    exceeded = next(number + 1 for number, each in enumerate(payloads) if cell.largest(each) > cell.threshold)
    noticed = list[int | None]()
    for repeat in range(DRIFTS):
        watch, at = cell.state(), None
        for number, each in enumerate(payloads):
            cell.execute(each, 300_000 + 1000 * repeat + number)
            if watch.state.expired:
                at = number + 1
                break
        noticed.append(at)
    return {"end": end, "noticed": noticed, "exceeded": exceeded}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", choices=("development", "reporting"))
    parser.add_argument("--tasks", type=int, default=100, help="tasks of each cell in which nothing has changed")
    parser.add_argument("--only", nargs="*", help="names of systems")
    parser.add_argument("--imperfections", nargs="*", default=IMPERFECT)
    arguments = parser.parse_args()
    listed = DEVELOPMENT if arguments.systems == "development" else REPORTING
    for imperfection in arguments.imperfections:
        for name, watched in listed.items():
            if arguments.only and name not in arguments.only:
                continue
            cell: Cell | None = None
            parts = (
                ("certified", certified),
                ("payload", payload),
                ("drift", drift),
                ("in control", lambda cell: in_control(cell, arguments.tasks)),
            )
            for part, measure in parts:
                known = STORED.get((name, imperfection, part))
                if known and known.get("tasks", arguments.tasks) >= arguments.tasks:
                    continue
                cell = cell or Cell(name, watched, imperfection)
                STORED.append({**cell.key, "part": part, "of": arguments.systems, **measure(cell)})
                print(STORED[name, imperfection, part], flush=True)


if __name__ == "__main__":
    main()
