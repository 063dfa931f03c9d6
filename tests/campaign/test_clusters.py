"""The recipes of the page on clusters, each with a worker that dies during an execution."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from conftest import make_validation
from ctxval import Campaign, Store, Trial, searches
from ctxval.errors import InputError
from test_how_to import DOCS, blocks

# The simulator of the page; its first execution sends its own process a signal.
STRUCK = """
import contextlib
import os
from pathlib import Path

slowly = execute
folder = Path(__file__).parent


def execute(controller, task):
    (folder / f"began-{task.goal[0]}-{os.getpid()}").touch()
    try:
        (folder / "struck").touch(exist_ok=False)
    except FileExistsError:
        return slowly(controller, task)
    os.kill(os.getpid(), SIGNAL)
    time.sleep(60)


with contextlib.suppress(ImportError):
    import submitit.core.core

    submitit.core.core.Job._results_timeout_s = 1  # how long the result of a job is awaited whose process has ended
"""


def require(package: str) -> None:
    """Skip a test without a package. It is not imported: Ray would stay in the process of the tests."""
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"needs {package}")


def trials_of_recipe(folder: Path, recipe: str, struck_by: signal.Signals) -> list[Trial]:
    """Run a recipe of the page whose first execution is struck; return the stored trials."""
    for _, content in blocks(DOCS / "how-to" / "clusters.md"):
        name, _, rest = content.partition("\n")
        if name.startswith("# file: "):
            (folder / name.removeprefix("# file: ")).write_text(rest)
    with (folder / "simulator.py").open("a") as simulator:
        simulator.write(STRUCK.replace("SIGNAL", str(int(struck_by))))
    quiet = {"RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0", "HOME": str(folder)}
    # Workers import the simulator from the folder of the script, and ctxval from where it is here.
    environment = {**os.environ, **quiet, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    done = subprocess.run(
        [sys.executable, f"on_{recipe}.py"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return Store.existing(folder / f"{recipe}.sqlite").trials()


@pytest.mark.slow
@pytest.mark.parametrize(("recipe", "package"), [("slurm", "submitit"), ("ray", "ray"), ("dask", "distributed")])
def test_nothing_is_lost_if_a_worker_is_killed(tmp_path: Path, recipe: str, package: str) -> None:
    require(package)
    trials = trials_of_recipe(tmp_path, recipe, signal.SIGKILL)
    assert [trial.state for trial in trials] == ["completed"] * 4
    assert sorted(trial.attempts for trial in trials) == [1, 1, 1, 2]
    assert len(list(tmp_path.glob("began-*"))) == 5
    assert [trial.distance for trial in trials] == [trial.distance for trial in alone(tmp_path)]


def alone(folder: Path) -> tuple[Trial, ...]:
    """Return the trials of the same campaign without a cluster."""
    names: dict[str, Any] = {}
    exec((folder / "simulator.py").read_text().replace("__file__", repr(str(folder / "simulator.py"))), names)
    return Campaign(names["validation"](), search=searches.Random()).run(4).trials


@pytest.mark.slow
def test_a_job_that_slurm_preempts_and_queues_again_is_no_failure(tmp_path: Path) -> None:
    require("submitit")
    trials = trials_of_recipe(tmp_path, "slurm", signal.SIGUSR2)
    assert [(trial.state, trial.attempts) for trial in trials] == [("completed", 1)] * 4
    assert len(list(tmp_path.glob("began-*"))) == 5


# Executors of any kind


class Job:
    """A job that is done once it was asked so many times; its function is called when its result is wanted."""

    def __init__(self, asks: float, function: Any, arguments: Any) -> None:
        self.asks, self.function, self.arguments, self.cancelled = asks, function, arguments, False

    def done(self) -> bool:
        self.asks -= 1
        return self.asks < 0

    def result(self) -> Any:
        return self.function(*self.arguments)

    def cancel(self) -> None:
        self.cancelled = True
        raise OSError("the command that cancels is missing")


class Queue:
    """The smallest executor."""

    def __init__(self, asks: float) -> None:
        self.asks, self.jobs = asks, list[Job]()

    def submit(self, function: Any, *arguments: Any) -> Job:
        self.jobs.append(Job(self.asks, function, arguments))
        return self.jobs[-1]


def distances_of(campaign: Campaign) -> list[float | None]:
    return [trial.distance for trial in campaign.trials]


def test_what_submits_is_an_executor() -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), seed=5)
    campaign.run(3, executor=Queue(3), workers=2)
    assert distances_of(campaign) == distances_of(Campaign(make_validation(), search=searches.Random(), seed=5).run(3))


def test_a_job_beyond_the_time_limit_is_cancelled_even_if_that_fails() -> None:
    queue = Queue(float("inf"))
    campaign = Campaign(make_validation()).run(1, executor=queue, timeout=1e-9)
    assert queue.jobs[0].cancelled
    assert campaign.trials[0].failure == "the execution did not end within 1e-09 s"


def test_what_cannot_be_executed_there_is_named_by_the_last_error_of_its_traceback() -> None:
    class Elsewhere(Queue):
        def submit(self, function: Any, *arguments: Any) -> Job:
            def fail() -> None:
                raise RuntimeError("failed:\n  KeyError: 1\nModuleNotFoundError: No module 'rig'\n--\nLogs: x")

            return super().submit(fail)

    with pytest.raises(InputError, match="cannot be sent to a worker: ModuleNotFoundError: No module 'rig'"):
        Campaign(make_validation()).run(1, executor=Elsewhere(0))
