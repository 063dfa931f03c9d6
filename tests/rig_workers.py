"""A slow system and a campaign in a process of its own: ``python rig_workers.py STORE BUDGET WORKERS FOLDER``."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from conftest import make_validation
from ctxval import Campaign, Task, Trajectory, searches
from ctxval.core.controller import Controller


class Logging:
    """Writes who executes, takes its time, and does what another system does."""

    def __init__(self, folder: str, seconds: float = 0.4) -> None:
        self.folder, self.seconds = folder, seconds

    def describe(self) -> dict[str, object]:
        return {}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        mark = Path(self.folder) / f"{task.goal[0]:.9f}-{os.getpid()}-{time.monotonic_ns()}"
        mark.write_text("started")
        time.sleep(self.seconds)
        trajectory = make_validation().system.execute(controller, task)
        mark.write_text("ended")
        return trajectory


def campaign(store: str | None, folder: str, seconds: float = 0.4) -> Campaign:
    return Campaign(make_validation(system=Logging(folder, seconds)), store=store, seed=5, search=searches.Random())


if __name__ == "__main__":
    # A shell starts what is in the background deaf to it, and tests may run there.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    store, budget, workers, folder = sys.argv[1:]
    running = campaign(store, folder)
    print("ready", flush=True)
    running.run(int(budget), workers=int(workers))
    print("done", flush=True)
