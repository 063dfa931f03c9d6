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
from ctxval.errors import CampaignError, InputError, StoreAccessError
from facts import assert_names, refuses
from rig_thorough import more
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
@pytest.mark.parametrize(("recipe", "package"), more(("dask", "distributed"), ("slurm", "submitit"), ("ray", "ray")))
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
    source = (folder / "simulator.py").read_text().replace("time.sleep(0.2)", "")
    exec(source.replace("__file__", repr(str(folder / "simulator.py"))), names)
    return Campaign(names["validation"](), search=searches.Random()).run(4).trials


@pytest.mark.slow
@pytest.mark.thorough
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
    """The smallest executor; it takes no more than so many jobs in all, and knows the most that waited at a time."""

    def __init__(self, asks: float, most: int = 1000) -> None:
        self.asks, self.most, self.jobs, self.waiting = asks, most, list[Job](), 0

    def submit(self, function: Any, *arguments: Any) -> Job:
        if len(self.jobs) == self.most:
            raise RuntimeError("the queue is closed")
        self.jobs.append(Job(self.asks, function, arguments))
        self.waiting = max(self.waiting, sum(job.asks >= 0 for job in self.jobs))
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
    assert_names(campaign.trials[0].failure, 1e-09)


def test_what_cannot_be_executed_there_is_named_by_the_last_error_of_its_traceback() -> None:
    class Elsewhere(Queue):
        def submit(self, function: Any, *arguments: Any) -> Job:
            def fail() -> None:
                raise RuntimeError("failed:\n  KeyError: 1\nModuleNotFoundError: No module 'rig'\n--\nLogs: x")

            return super().submit(fail)

    with refuses(InputError, "ModuleNotFoundError", "rig"):
        Campaign(make_validation()).run(1, executor=Elsewhere(0))


# Executions whose choice depends on no result


def random_campaign(store: Path | None = None) -> Campaign:
    return Campaign(make_validation(), search=searches.Random(), store=store, seed=5)


def facts(campaign: Campaign) -> list[tuple[object, ...]]:
    return [(trial.number, trial.state, trial.unit_point.tobytes(), trial.distance) for trial in campaign.trials]


def test_random_tasks_wait_for_a_free_worker_and_are_the_same() -> None:
    queue = Queue(2)
    campaign = random_campaign().run(24, executor=queue, workers=2)
    assert 2 < queue.waiting <= 18
    assert (len(queue.jobs), campaign.executions) == (24, 24)
    assert facts(campaign) == facts(random_campaign().run(24))


def test_tasks_of_an_audit_wait_for_a_free_worker() -> None:
    queue = Queue(2)
    campaign = random_campaign().audit(24, executor=queue, workers=2)
    assert 2 < queue.waiting <= 18
    assert facts(campaign) == facts(random_campaign().audit(24))


@pytest.mark.parametrize(
    ("search", "options"),
    [
        (searches.GPUCB(), {}),
        (searches.Random(), {"until": lambda campaign: False}),
        (searches.Random(), {"timeout": 60.0}),
        (searches.Random(), {"threshold": 100.0, "explore": False}),
    ],
)
def test_no_task_waits_if_results_matter_or_time_is_limited(search: searches.Search, options: dict[str, Any]) -> None:
    queue = Queue(2)
    Campaign(make_validation(), search=search, seed=5).run(8, executor=queue, workers=2, **options)
    assert queue.waiting == 2


def test_trials_are_stored_before_they_wait(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"

    class Watching(Queue):
        def submit(self, function: Any, *arguments: Any) -> Job:
            stored = Store(path)
            assert len(stored.trials()) > len(self.jobs)
            stored.close()
            return super().submit(function, *arguments)

    assert random_campaign(path).run(20, executor=Watching(2), workers=2).executions == 20


def test_what_waited_when_the_executor_ended_is_executed_later(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with refuses(CampaignError, "executor", "RuntimeError"):
        random_campaign(path).run(20, executor=Queue(2, most=9), workers=2)
    before = Store(path).trials()
    assert any(trial.state == "open" and trial.attempts for trial in before)
    resumed = random_campaign(path).run(20, executor=Queue(2), workers=2)
    assert facts(resumed) == facts(random_campaign().run(20))
    assert all(resumed.trials[trial.number].attempts == 1 + (trial.state == "open") for trial in before)


def test_results_that_the_store_refuses_together_are_stored_alone(tmp_path: Path) -> None:
    class Refusing(Store):
        alone = 0

        def close_trials(self, ended: Any, *, changes: int | None = None) -> None:
            ended = list(ended)
            if len(ended) > 1:
                raise StoreAccessError("the disk is full.")
            self.alone += 1
            super().close_trials(ended, changes=changes)

    store = Refusing(tmp_path / "a.sqlite")
    campaign = Campaign(make_validation(), search=searches.Random(), store=store, seed=5)
    assert facts(campaign.run(12, executor=Queue(0), workers=4)) == facts(random_campaign().run(12))
    assert store.alone == 12
