"""A rig's program that says which process it is and takes its time, a campaign on it, and what kills it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from ctxval import Campaign, Store, Task, TaskSpace, Validation, controllers, distances, models, searches, systems

RIG = """
import json, os, sys, time
from pathlib import Path

marks, folder = Path(sys.argv[1]), Path(sys.argv[-1])
seconds = float((marks / "../seconds").read_text())
(marks / f"{time.monotonic_ns()}-{os.getpid()}").touch()
task, controller = (json.loads((folder / f"{name}.json").read_text()) for name in ("task", "controller"))
x, rows = task["initial_state"], []
for t in range(task["horizon"] + 1):
    time.sleep(seconds / (task["horizon"] + 1))
    row = [t * task["dt"], *x]
    if t < task["horizon"]:
        K, v, x_0 = (controller[name][t] for name in ("gains", "inputs", "states"))
        u = v[0] + sum(k * (a - b) for k, a, b in zip(K[0], x, x_0))
        x = [x[0] + 0.1 * x[1], x[1] + 0.1 * (u - 0.1 * x[1] * abs(x[1])) / 2]
        row.append(u)
    rows.append(row)
text = "\\n".join(",".join(map(repr, row)) for row in [*rows[:-1], [*rows[-1], 0.0]])
(folder / "trajectory.csv").write_text("t,x0,x1,u0\\n" + text.rpartition(",")[0] + ",\\n")
"""


def campaign(folder: Path, store: Store | Path | None = None, seconds: float = 0.1) -> Campaign:
    """Return a campaign on the program, whose executions leave marks in a folder."""
    (folder / "marks").mkdir(exist_ok=True)
    script = folder / "rig.py"
    script.write_text(RIG)
    (folder / "seconds").write_text(str(seconds))  # no argument: a campaign may be resumed with others
    command = [sys.executable, "-S", "-E", str(script), str(folder / "marks")]
    validation = Validation(
        space=TaskSpace(goal=(0.5, 1.5, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=10, dt=0.1),
        system=systems.Subprocess(command, timeout=60),
        model=models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.05]]),
        synthesizer=controllers.LQR([10.0, 1.0], [0.1]),
        distance=distances.FinalState(weights=(1, 1)),
    )
    return Campaign(validation, search=searches.Random(), store=store, seed=7)


def killer(folder: Path, after: int, wait: float) -> threading.Thread:
    """Start a thread that kills the program's process some seconds into its execution of this number."""

    def kill() -> None:
        end = time.monotonic() + 60
        while len(found := sorted((folder / "marks").iterdir(), key=_began)) <= after and time.monotonic() < end:
            time.sleep(0.002)
        time.sleep(wait)
        with contextlib.suppress(ProcessLookupError, IndexError):
            os.kill(int(found[after].name.split("-")[1]), signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    return thread


def _began(mark: Path) -> int:
    return int(mark.name.split("-")[0])


def processes(folder: Path) -> list[int]:
    """Return the processes of all executions so far."""
    return [int(mark.name.split("-")[1]) for mark in (folder / "marks").glob("*")]


def start(folder: Path, seconds: float, workers: int) -> subprocess.Popen[bytes]:
    """Start a campaign in a process of its own."""
    run = f"rig_command.campaign(Path({str(folder)!r}), Path({str(folder / 'a.sqlite')!r}), {seconds})"
    code = f"import rig_command; from pathlib import Path; {run}.run(6, workers={workers})"
    return subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parent)
