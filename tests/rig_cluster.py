"""A Dask scheduler and its workers, each a process that can be killed, and an experiment for ``ctxval run --dask``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from conftest import make_validation
from ctxval import Experiment
from rig_cli import SMALL
from rig_workers import Logging

HERE = Path(__file__).parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
EXPERIMENT = """
experiment = "rig_cluster:experiment"
budget = 12
seed = 5
store = "a.sqlite"
search = {{ type = "random" }}
options = {{ folder = "{marks}", seconds = 0.2 }}
"""


def experiment(seed: int, folder: str, seconds: float) -> Experiment:
    return Experiment("logged", make_validation(system=Logging(folder, seconds)))


@dataclass
class Cluster:
    """Running processes, and where the scheduler listens."""

    scheduler: subprocess.Popen[bytes]
    workers: list[subprocess.Popen[bytes]]
    address: str


@contextmanager
def cluster(folder: Path, workers: int = 2) -> Iterator[Cluster]:
    """Start a scheduler and workers, which end with the context."""
    folder.mkdir(exist_ok=True)
    where, log = folder / "scheduler.json", folder / "scheduler.log"
    options = ["--port", "0", "--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(where)]
    processes = [_start("dask_scheduler", options, folder, log)]
    try:
        _until(lambda: where.exists() and where.read_text().rstrip().endswith("}"))
        address = json.loads(where.read_text())["address"]
        options = [address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "30"]
        for number in range(workers):
            processes.append(_start("dask_worker", options, folder, folder / f"worker{number}.log"))
        _until(lambda: log.read_text().count("Register worker") == workers)
        yield Cluster(processes[0], processes[1:], address)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _start(what: str, options: list[str], folder: Path, log: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"distributed.cli.{what}", *options]
    with log.open("wb") as output:
        return subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, stdout=output, stderr=subprocess.STDOUT)


def _until(condition: object, seconds: float = 60.0) -> None:
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def run(folder: Path, address: str) -> subprocess.Popen[str]:
    """Start ``ctxval run`` on a cluster; what is executed leaves its marks."""
    (folder / "marks").mkdir(exist_ok=True)
    (folder / "e.toml").write_text(EXPERIMENT.format(marks=folder / "marks"))
    command = [*SMALL, "run", "e.toml", "--dask", address, "--json", "--no-report"]
    return subprocess.Popen(
        command, cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def marks(folder: Path) -> int:
    """Return how many executions have begun."""
    return len(list((folder / "marks").iterdir()))


def killed_and_resumed(folder: Path, after: int, wait: float) -> tuple[int, str, dict[int, float | None]]:
    """Kill the scheduler some seconds after so many executions have begun, and resume on another.

    Returns:
        The exit status and stderr of the campaign that lost its scheduler, and the distances that it had stored.
    """
    from ctxval import Store

    with cluster(folder / "first") as first:
        process = run(folder, first.address)
        _until(lambda: marks(folder) >= after)
        time.sleep(wait)
        first.scheduler.kill()
        _, stderr = process.communicate(timeout=120)
    before = {t.number: t.distance for t in Store(folder / "a.sqlite").trials() if t.state == "completed"}
    with cluster(folder / "second") as second:
        again = run(folder, second.address)
        _, said = again.communicate(timeout=120)
        assert again.returncode == 0, said
    return process.returncode, stderr, before
