"""Many workers: real processes that are killed, hang, fail, and are interrupted."""

from __future__ import annotations

import concurrent.futures as cf
import importlib.util
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rig_cluster
from conftest import make_validation
from ctxval import Campaign, Store, Task, Trajectory, Trial, controllers, searches
from ctxval._util.progress import is_heard, listening
from ctxval.campaign.choices import Choice
from ctxval.campaign.trials import TrialRecorder
from ctxval.campaign.workers import ProcessPool
from ctxval.errors import CampaignError, InputError, ModelError
from facts import assert_names, refuses
from faulty_rig import FaultyRig
from rig_thorough import more
from rig_workers import Logging
from rig_workers import campaign as logged

HERE = Path(__file__).parents[1]


def run_of(system: Any, budget: int = 8, **options: Any) -> Campaign:
    return Campaign(make_validation(system=system), search=searches.Random(), seed=5).run(budget, **options)


def run_python(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, with the modules of the tests."""
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])},
        cwd=folder,
        check=False,
    )


class Heard:
    """Fails if the progress of the campaign is heard in its process."""

    def __init__(self) -> None:
        self.inner = make_validation().system

    def execute(self, controller: Any, task: Task) -> Trajectory:
        if is_heard():
            raise RuntimeError("heard")
        return self.inner.execute(controller, task)


def test_the_work_of_a_worker_is_not_shown_as_that_of_the_campaign() -> None:
    with listening(lambda _: None):
        assert not run_of(Heard(), 2, workers=2).failed


def facts(campaign: Campaign) -> list[tuple[object, ...]]:
    return [(t.number, t.state, t.unit_point.tobytes(), t.distance) for t in campaign.trials]


class Deadly:
    """Kills its own process, or hangs, at chosen executions of each process."""

    def __init__(self, folder: Path, *, kill: int = 0, hang: int = 0, hard: bool = False) -> None:
        self.folder, self.kill, self.hang, self.hard = folder, kill, hang, hard
        self.inner = make_validation().system

    def execute(self, controller: Any, task: Task) -> Trajectory:
        mine = next(number for number in itertools.count() if self._claims(number))
        if mine < self.kill:
            os.kill(os.getpid(), signal.SIGKILL)
        if mine < self.hang:
            if self.hard:
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(60)
            (self.folder / "woken").touch()
        return self.inner.execute(controller, task)

    def _claims(self, number: int) -> bool:
        """Whether this is the execution of that number; of two at the same time only one is."""
        try:
            (self.folder / str(number)).touch(exist_ok=False)
        except FileExistsError:
            return False
        return True


# What workers do


def test_random_draws_do_not_depend_on_the_workers(tmp_path: Path) -> None:
    alone = logged(None, str(tmp_path), 0).run(10)
    together = logged(None, str(tmp_path), 0).run(10, workers=3)
    assert facts(alone) == facts(together)


class Meeting:
    """Executes only once as many workers as expected are executing at the same time."""

    def __init__(self, folder: Path, workers: int) -> None:
        self.folder, self.workers = folder, workers
        self.inner = make_validation().system

    def execute(self, controller: Any, task: Task) -> Trajectory:
        (self.folder / str(os.getpid())).touch()
        until(lambda: len(list(self.folder.iterdir())) >= self.workers)
        return self.inner.execute(controller, task)


def test_workers_are_busy_at_the_same_time(tmp_path: Path) -> None:
    # One after the other, the first execution would wait for the others in vain, and fail.
    campaign = run_of(Meeting(tmp_path, 4), 8, workers=4)
    assert [trial.state for trial in campaign.trials] == ["completed"] * 8
    workers = {path.name for path in tmp_path.iterdir()}
    assert len(workers) == 4
    assert str(os.getpid()) not in workers


def test_the_seconds_of_a_trial_are_those_of_its_execution(tmp_path: Path) -> None:
    campaign = logged(None, str(tmp_path), 0.05).run(2, workers=2)
    assert all(trial.seconds is not None and trial.seconds >= 0.05 for trial in campaign.trials)


def test_the_search_knows_what_is_being_executed(tmp_path: Path) -> None:
    seen: list[int] = []

    class Watching(searches.Random):
        def propose(self, rng: np.random.Generator) -> np.ndarray:
            seen.append(int(np.isnan(self.values).sum()))
            return super().propose(rng)

        def describe(self) -> dict[str, object]:
            return {}

    campaign = Campaign(make_validation(system=Logging(str(tmp_path), 0.05)), search=Watching())
    campaign.run(9, workers=3)
    assert seen[:3] == [0, 1, 2]
    assert max(seen) == 2
    assert campaign.executions == 9


def test_a_surrogate_search_proposes_distinct_points_to_all_workers(tmp_path: Path) -> None:
    validation = make_validation(system=Logging(str(tmp_path), 0.02))
    campaign = Campaign(validation, search=searches.GPUCB(), seed=1).run(10, workers=4)
    points = np.array([trial.unit_point for trial in campaign.trials])
    assert len(np.unique(points, axis=0)) == 10


def test_the_budget_is_a_total_and_interrupted_trials_come_first(tmp_path: Path) -> None:
    store = str(tmp_path / "a.sqlite")
    marks = tmp_path / "marks"
    marks.mkdir()
    campaign = logged(store, str(marks), 0)
    for _ in range(2):
        campaign.recorder.open_all([Choice()], attempts=1)
    again = logged(store, str(marks), 0).run(5, workers=3)
    assert (again.executions, len(again.trials)) == (5, 5)
    assert [trial.attempts for trial in again.trials] == [2, 2, 1, 1, 1]
    assert again.run(5, workers=3).executions == 5
    assert again.run(7).executions == 7


def test_an_audit_has_workers_too(tmp_path: Path) -> None:
    alone = logged(None, str(tmp_path), 0).audit(6)
    assert facts(logged(None, str(tmp_path), 0).audit(6, workers=3)) == facts(alone)


def test_until_stops_new_executions_and_takes_the_running_ones(tmp_path: Path) -> None:
    campaign = logged(None, str(tmp_path), 0.05).run(40, workers=3, until=lambda c: c.executions >= 5)
    assert 5 <= campaign.executions <= 8
    assert all(trial.state == "completed" for trial in campaign.trials)


def test_every_ended_trial_is_reported(tmp_path: Path) -> None:
    seen: list[Trial] = []
    logged(None, str(tmp_path), 0).run(6, on_trial=seen.append, workers=2)
    assert sorted(trial.number for trial in seen) == list(range(6))


# What goes wrong


def test_the_systems_failures_are_data_and_not_repeated(tmp_path: Path) -> None:
    rig = FaultyRig(make_validation().system, {0: "raise", 1: "nan", 2: "short", 3: "wrong shape"})
    campaign = run_of(rig, 8, workers=2)
    reasons = [trial.failure or "" for trial in campaign.failed]
    # Each of the two workers has its own copy, whose first four executions fail; one of them makes four at least.
    assert 4 <= len(reasons) <= 8
    for text in ("motor cut out", "not finite", "operator", "must have states"):
        assert 1 <= sum(text in reason for reason in reasons) <= 2
    assert all(trial.attempts == 1 for trial in campaign.trials)


def test_the_systems_failures_are_repeated_where_the_user_says_so() -> None:
    campaign = run_of(FaultyRig(make_validation().system, {0: "raise"}), 4, workers=2, retry_failures=1)
    assert not campaign.failed
    assert sorted(trial.attempts for trial in campaign.trials) == [1, 1, 2, 2]


def test_a_killed_worker_is_replaced_and_its_execution_repeated(tmp_path: Path) -> None:
    campaign = run_of(Deadly(tmp_path, kill=2), 6, workers=2)
    assert [trial.state for trial in campaign.trials] == ["completed"] * 6
    assert sum(trial.attempts for trial in campaign.trials) == 8
    assert facts(campaign) == facts(run_of(None, 6))


def test_an_execution_that_kills_every_worker_fails_in_the_end(tmp_path: Path) -> None:
    campaign = run_of(Deadly(tmp_path, kill=10**6), 2, workers=2, retries=1)
    for trial in campaign.trials:
        assert_names(str(trial.failure), 2, 9)
    assert [trial.attempts for trial in campaign.trials] == [2, 2]
    assert campaign.executions == 2


@pytest.mark.slow
@pytest.mark.parametrize("hard", [False, True])
def test_an_execution_that_hangs_is_ended(tmp_path: Path, hard: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if hard:
        monkeypatch.setattr("ctxval.campaign.workers._GRACE_PERIOD", 0.2)
    campaign = run_of(Deadly(tmp_path, hang=1, hard=hard), 4, workers=2, timeout=0.5)
    assert not (tmp_path / "woken").exists()
    assert_names([trial.failure for trial in campaign.failed], 0.5)
    assert len(campaign.completed) == 3


@pytest.mark.slow
def test_a_timeout_alone_is_one_worker(tmp_path: Path) -> None:
    campaign = run_of(Deadly(tmp_path, hang=1), 3, timeout=0.5)
    assert [trial.state for trial in campaign.trials] == ["failed", "completed", "completed"]


SIGNALLED_AT_ITS_END = """
import os, signal
from multiprocessing.util import Finalize
from pathlib import Path
from conftest import make_validation
from ctxval import Campaign, searches

pid = os.getpid

def pid_after_a_signal():
    os.kill(pid(), signal.SIGTERM)
    return pid()

def signal_at_the_end():
    Path(f"ended-{pid()}").touch()
    os.getpid = pid_after_a_signal

class System:
    def execute(self, controller, task):
        Finalize(None, signal_at_the_end, exitpriority=0)
        raise RuntimeError

try:
    Campaign(make_validation(system=System()), search=searches.Random()).run(2, workers=2)
finally:
    print("campaign left", flush=True)
"""


@pytest.mark.slow
@pytest.mark.thorough
def test_a_worker_that_is_signalled_while_it_ends_does_not_go_on_as_the_campaign(tmp_path: Path) -> None:
    done = run_python("-c", SIGNALLED_AT_ITS_END, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "campaign left\n"
    assert len(list(tmp_path.glob("ended-*"))) == 2


def test_a_model_that_fails_stops_the_campaign_after_what_is_running(tmp_path: Path) -> None:
    class Late:
        calls = 0

        def design(self, task: Task, model: Any) -> Any:
            Late.calls += 1
            if Late.calls > 8:  # three for what independent draws depend on
                raise ModelError("no more")
            return controllers.LQR([1.0, 0.1], [1e-2]).design(task, model)

        def describe(self) -> dict[str, object]:
            return {}

    validation = make_validation(system=Logging(str(tmp_path), 0.05))
    validation.synthesizer = Late()
    campaign = Campaign(validation, search=searches.Random())
    with refuses(ModelError, "goal"):
        campaign.run(20, workers=3)
    assert [trial.state for trial in campaign.trials] == ["completed"] * 5 + ["failed"]


def test_a_controller_that_cannot_be_sent_is_said_so(tmp_path: Path) -> None:
    validation = make_validation()
    validation.synthesizer = controllers.Policy(lambda t, x, task: -x[..., :1])
    with refuses(InputError, "AttributeError", "lambda"):
        Campaign(validation).run(3, workers=2)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"workers": 0}, ("workers", 0)),
        ({"workers": 1.5}, ("workers", 1.5)),
        ({"timeout": 0}, ("timeout",)),
        ({"timeout": float("nan")}, ("timeout",)),
        ({"executor": 3}, ("executor", 3)),
        ({"retries": -1}, ("retries", 0)),
        ({"retry_failures": True}, ("retry_failures", 0)),
        ({"retry_failures": 1}, ("retry_failures", "workers")),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], facts: tuple[object, ...]) -> None:
    campaign = Campaign(make_validation())
    with refuses(InputError, *facts):
        campaign.run(3, **options)
    assert not campaign.trials


# Executors


@pytest.mark.parametrize("pool", [cf.ThreadPoolExecutor, cf.ProcessPoolExecutor])
def test_any_executor_will_do(pool: Any, tmp_path: Path) -> None:
    with pool(3) as executor:
        campaign = logged(None, str(tmp_path), 0.02).run(7, executor=executor)
    assert facts(campaign) == facts(logged(None, str(tmp_path), 0).run(7))


def test_a_pool_whose_process_was_killed_stops_the_campaign_with_everything_stored(tmp_path: Path) -> None:
    campaign = Campaign(make_validation(system=Picklable(tmp_path)), search=searches.Random(), seed=5)
    with cf.ProcessPoolExecutor(2) as executor, refuses(CampaignError, "executor"):
        campaign.run(6, executor=executor)
    with cf.ProcessPoolExecutor(2) as executor:
        assert campaign.run(6, executor=executor).executions == 6


class Picklable:
    """Kills the process of its first execution."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def describe(self) -> dict[str, object]:
        return {}

    def execute(self, controller: Any, task: Task) -> Trajectory:
        try:
            (self.folder / "killed").touch(exist_ok=False)
        except FileExistsError:
            return make_validation().system.execute(controller, task)
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError


@pytest.mark.slow
def test_a_thread_that_hangs_is_given_up() -> None:
    release = threading.Event()

    class Hanging:
        def execute(self, controller: Any, task: Task) -> Trajectory:
            release.wait(20)
            raise RuntimeError

    with cf.ThreadPoolExecutor(2) as executor:
        campaign = Campaign(make_validation(system=Hanging()), search=searches.Random())
        campaign.run(2, executor=executor, timeout=0.2)
        release.set()
    for trial in campaign.trials:
        assert_names(str(trial.failure), 0.2)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs dask.distributed")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.thorough  # test_clusters.py kills a worker of Dask, too
def test_a_campaign_on_dask_survives_the_death_of_a_worker(tmp_path: Path) -> None:
    script = tmp_path / "cluster.py"
    script.write_text(DASK)
    (tmp_path / "marks").mkdir()
    done = run_python(str(script), str(tmp_path / "a.sqlite"), str(tmp_path / "marks"), folder=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    trials = Store(tmp_path / "a.sqlite").trials()
    assert [trial.state for trial in trials] == ["completed"] * 16
    alone = logged(None, str(tmp_path / "marks"), 0).run(16)
    assert [trial.distance for trial in trials] == [trial.distance for trial in alone.trials]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs dask.distributed")
@pytest.mark.thorough
def test_a_campaign_whose_dask_scheduler_is_killed_goes_on_with_another(tmp_path: Path) -> None:
    status, stderr, before = rig_cluster.killed_and_resumed(tmp_path, after=4, wait=0.1)
    assert status == 3
    assert "Traceback" not in stderr
    assert 1 <= len(before) < 12
    trials = Store(tmp_path / "a.sqlite").trials()
    assert [trial.state for trial in trials] == ["completed"] * 12
    assert all(trials[number].distance == distance for number, distance in before.items())
    alone = logged(None, str(tmp_path / "marks"), 0).run(12)
    assert [trial.distance for trial in trials] == [trial.distance for trial in alone.trials]


DASK = """
import os, signal, sys
from distributed import Client, LocalCluster
from rig_workers import campaign

if __name__ == "__main__":
    store, folder = sys.argv[1:]
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        with Client(cluster) as client:
            pids = list(client.run(os.getpid).values())
            running = campaign(store, folder, 0.15)

            def kill_once(trial):
                if running.executions == 5:
                    os.kill(pids[0], signal.SIGKILL)
                    print("killed a worker after", running.executions, flush=True)

            running.run(16, on_trial=kill_once, executor=client.get_executor(pure=False), workers=2)
"""


# Ctrl-C, and kill -9


def start(store: Path, marks: Path, workers: int, budget: int = 40) -> subprocess.Popen[str]:
    marks.mkdir(exist_ok=True)
    process = subprocess.Popen(
        [sys.executable, str(HERE / "rig_workers.py"), str(store), str(budget), str(workers), str(marks)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def until(condition: Any, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def just_started(marks: Path) -> bool:
    """Whether an execution has begun so lately that a signal sent now meets it."""
    youngest = max(marks.iterdir(), key=lambda mark: int(mark.name.rsplit("-", 1)[1]), default=None)
    if youngest is None or youngest.read_text() != "started":
        return False
    return time.monotonic_ns() - int(youngest.name.rsplit("-", 1)[1]) < 0.1e9


def ended(store: Path) -> int:
    return sum(trial.state == "completed" for trial in Store(store).trials()) if store.exists() else 0


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("workers", [*more(1), 3])
def test_the_first_interrupt_ends_after_the_running_executions(tmp_path: Path, workers: int) -> None:
    store, marks = tmp_path / "a.sqlite", tmp_path / "marks"
    process = start(store, marks, workers)
    until(lambda: ended(store) >= 2 and just_started(marks))
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode != 0
    states = [trial.state for trial in Store(store).trials()]
    assert set(states) == {"completed"}
    assert 2 <= len(states) < 40
    assert all(mark.read_text() == "ended" for mark in marks.iterdir())
    assert len(list(marks.iterdir())) == len(states)
    whole = logged(None, str(marks), 0).run(len(states) + 2)
    assert facts(logged(str(store), str(marks), 0).run(len(states) + 2)) == facts(whole)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(("part", "method"), [("TrialRecorder", "open_all"), ("ProcessPool", "_start_worker")])
def test_an_interrupt_while_an_execution_begins_leaves_it_to_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str, method: str, workers: int
) -> None:
    owner = {"TrialRecorder": TrialRecorder, "ProcessPool": ProcessPool}[part]
    begin = getattr(owner, method)
    calls = itertools.count(1)

    def interrupted(*arguments: Any, **options: Any) -> Any:
        begun = begin(*arguments, **options)
        if next(calls) == (1 if method == "open_all" else workers):
            signal.raise_signal(signal.SIGINT)
        return begun

    monkeypatch.setattr(owner, method, interrupted)
    store = tmp_path / "a.sqlite"
    validation = make_validation()
    with pytest.raises(KeyboardInterrupt):
        Campaign(validation, store=store, search=searches.Random(), seed=5).run(8, workers=workers, timeout=60)
    assert [trial.state for trial in Store(store).trials()] == ["completed"] * workers


@pytest.mark.slow
@pytest.mark.parametrize("workers", [*more(1), 3])
def test_the_second_interrupt_ends_at_once_and_the_store_can_be_resumed(tmp_path: Path, workers: int) -> None:
    store, marks = tmp_path / "a.sqlite", tmp_path / "marks"
    process = start(store, marks, workers)
    until(lambda: ended(store) >= 1 and just_started(marks))
    process.send_signal(signal.SIGINT)
    time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode != 0
    before = {t.number: t.distance for t in Store(store).trials() if t.state == "completed"}
    resumed = logged(str(store), str(marks), 0).run(12)
    assert resumed.executions == 12
    assert all(resumed.trials[number].distance == distance for number, distance in before.items())
    assert facts(resumed) == facts(logged(None, str(marks), 0).run(12))


@pytest.mark.slow
def test_workers_do_not_outlive_a_killed_campaign(tmp_path: Path) -> None:
    store, marks = tmp_path / "a.sqlite", tmp_path / "marks"
    process = start(store, marks, 3)
    until(lambda: ended(store) >= 3)
    process.kill()
    process.communicate()
    pids = {int(mark.name.split("-")[-2]) for mark in marks.iterdir()}
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids), 15)
    resumed = logged(str(store), str(marks), 0).run(10, workers=2)
    assert facts(resumed)[:10] == facts(logged(None, str(marks), 0).run(10))
