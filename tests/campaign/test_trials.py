"""What was executed stays: how trials end, whoever says so, and what a store does not take."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import interrupt_at_once, make_validation
from ctxval import Campaign, Store, Trajectory, searches
from ctxval.errors import DesignError, DistanceError, ExecutionError, InputError, StoreMismatchError
from facts import assert_names, refuses
from rig_cli import SMALL

HERE = Path(__file__).parents[1]
PLAIN = make_validation()


class Doing:
    """A system that does something before each execution; the second one is as usual in every second task."""

    def __init__(self, act: Any) -> None:
        self.act = act

    def describe(self) -> dict[str, object]:
        return {}

    def execute(self, controller: Any, task: Any) -> Trajectory:
        changed = self.act(PLAIN.system.execute(controller, task))
        return changed if isinstance(changed, Trajectory) else PLAIN.system.execute(controller, task)


def campaign_of(act: Any = lambda whole: None, store: Path | None = None, **parts: Any) -> Campaign:
    validation = make_validation(system=Doing(act), **parts)
    return Campaign(validation, search=searches.GPUCB(), store=store, seed=1)


# Exits


def leave(_: Trajectory) -> None:
    sys.exit(3)


def interrupt_by_code(_: Trajectory) -> None:
    raise KeyboardInterrupt


def leave_hard(_: Trajectory) -> None:
    os._exit(0)


@pytest.mark.parametrize("workers", [None, 2])
@pytest.mark.parametrize("act", [leave, interrupt_by_code, leave_hard])
def test_a_system_that_exits_has_failed_once(act: Any, workers: int | None) -> None:
    campaign = campaign_of(act).run(3, workers=workers)
    assert [(t.state, t.attempts, t.executed) for t in campaign.trials] == [("failed", 1, True)] * 3
    expected = {leave: "SystemExit: 3", interrupt_by_code: "KeyboardInterrupt", leave_hard: "os._exit(0)"}[act]
    assert all(expected in str(t.failure) for t in campaign.trials)


def test_a_process_that_exits_by_itself_is_a_failure_and_not_a_lost_worker() -> None:
    def native_exit(_: Trajectory) -> None:
        import ctypes

        ctypes.CDLL(None)._exit(5)

    campaign = campaign_of(native_exit).run(2, workers=2)
    assert [t.attempts for t in campaign.trials] == [1, 1]
    for trial in campaign.trials:
        assert_names(str(trial.failure), 5)


def test_a_person_still_interrupts() -> None:
    campaign = campaign_of(lambda whole: interrupt_at_once())
    with pytest.raises(KeyboardInterrupt):
        campaign.run(3)
    assert campaign.trials[0].state == "open"


def test_an_exit_from_a_signal_of_outside_is_no_failure() -> None:
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        campaign = campaign_of(lambda whole: signal.raise_signal(signal.SIGTERM))
        with pytest.raises(SystemExit):
            campaign.run(3)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert campaign.trials[0].state == "open"


def test_an_exit_leaves_forked_processes_alone() -> None:
    def forks(_: Trajectory) -> None:
        child = os.fork()
        if child == 0:
            os._exit(7)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7

    assert [t.state for t in campaign_of(forks).run(2).trials] == ["completed"] * 2


def test_a_recursion_limit_that_a_system_sets_is_its_own() -> None:
    before = sys.getrecursionlimit()
    campaign = campaign_of(lambda whole: sys.setrecursionlimit(before - 1)).run(2)
    assert [t.state for t in campaign.trials] == ["completed"] * 2
    assert sys.getrecursionlimit() == before


@pytest.mark.slow
@pytest.mark.thorough
def test_run_ends_with_a_report_if_the_system_leaves_hard(tmp_path: Path) -> None:
    (tmp_path / "rig.py").write_text(
        textwrap.dedent("""
        import os
        from conftest import make_validation
        from ctxval import systems

        def step(x, u):
            os._exit(0)

        def experiment(seed):
            return make_validation(system=systems.Simulated(step))
        """)
    )
    done = subprocess.run(
        [*SMALL, "run", "rig:experiment", "--budget", "2", "--no-report", "--json"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])},
    )
    assert done.returncode == 3, done.stderr
    assert json.loads(done.stdout)["failed"] == 2


# One check of every execution


def shifted(whole: Trajectory) -> Trajectory:
    return replace(whole, states=whole.states + np.array([1.0, 0.0]))


def slower(whole: Trajectory) -> Trajectory:
    return replace(whole, times=whole.times * 2)


@pytest.mark.parametrize(("act", "facts"), [(shifted, ("start_tolerance", 0)), (slower, (0.02, "trajectory"))])
@pytest.mark.parametrize("workers", [None, 2])
def test_run_refuses_what_tell_refuses(act: Any, facts: tuple[object, ...], workers: int | None) -> None:
    campaign = campaign_of(act).run(2, workers=workers)
    assert [t.state for t in campaign.trials] == ["failed"] * 2
    by_hand = campaign_of()
    opened = by_hand.ask()
    whole = by_hand.validation.execute(opened.plan)
    with refuses(InputError, *facts):
        by_hand.tell(opened, act(whole))
    with refuses(InputError, *facts):
        by_hand.add({"goal": opened.trial.parameters["goal"]}, act(whole))


def test_how_far_elsewhere_a_start_may_be_is_the_validations() -> None:
    validation = make_validation(system=Doing(shifted))
    validation.start_tolerance = 10.0
    campaign = Campaign(validation, search=searches.Random()).run(2)
    assert [t.state for t in campaign.trials] == ["completed"] * 2


# A distance that gives nothing usable for the system, which no trial with the model alone shows


def differ(model: Trajectory, system: Trajectory) -> bool:
    return not np.array_equal(model.states, system.states)


def test_an_execution_that_cannot_be_measured_is_kept_and_measured_later_for_free(tmp_path: Path) -> None:
    calls: list[int] = []

    def counted(whole: Trajectory) -> None:
        calls.append(1)

    mended = tmp_path / "mended"

    def distance(model: Any, system: Any, task: Any) -> float:
        if not mended.exists() and differ(model, system):
            return float("nan")
        return float(np.abs(model.final_state - system.final_state).sum())

    path = tmp_path / "a.sqlite"
    for number in range(2):
        with refuses(DistanceError, "STORE", "distance", number):
            campaign_of(counted, path, distance=distance).run(5)
    assert [t.state for t in Store(path).trials()] == ["unmeasured"] * 2
    mended.touch()
    campaign = campaign_of(counted, path, distance=distance)
    assert (campaign.executions, len(campaign.unmeasured), campaign.failed) == (2, 2, [])
    assert campaign.run(5).executions == 5
    assert len(calls) == 5
    assert [t.state for t in campaign.trials] == ["completed"] * 5
    plain = Campaign(make_validation(), search=searches.GPUCB(), seed=1).run(5)
    assert campaign.trials[0].distance == pytest.approx(plain.trials[0].distance)


def test_what_is_told_or_added_without_a_usable_distance_is_kept_too() -> None:
    campaign = campaign_of(distance=lambda model, system, task: -1.0 if differ(model, system) else 0.0)
    opened = campaign.ask()
    whole = campaign.validation.execute(opened.plan)
    with pytest.raises(DistanceError):
        campaign.tell(opened, whole)
    added = campaign.add({"goal": 1.0}, campaign.validation.execute(campaign.ask({"goal": 1.0}).plan))
    assert added is not None
    assert [campaign.trials[number].state for number in (0, added.number)] == ["unmeasured"] * 2
    assert len(campaign.remeasure(PLAIN.distance)) == 2
    assert campaign.trials[0].state == "completed"


# Who may say how a trial ended


def test_nothing_is_told_of_a_trial_that_is_being_executed(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    refused: list[str] = []

    def tell_meanwhile(_: Trajectory) -> None:
        other = Campaign(campaign.validation, search=searches.GPUCB(), store=path, seed=1)
        for terminal in (campaign, other):
            with refuses(InputError, len(other.trials) - 1) as error:
                terminal.tell(len(other.trials) - 1, distance=0.001)
            refused.append(str(error.value))

    campaign = campaign_of(tell_meanwhile, path)
    campaign.run(2)
    assert len(refused) == 4
    assert all(t.distance != 0.001 for t in Store(path).trials())


def test_a_trial_that_was_interrupted_can_be_told(tmp_path: Path) -> None:
    campaign = campaign_of(lambda whole: interrupt_at_once(), tmp_path / "a.sqlite")
    with pytest.raises(KeyboardInterrupt):
        campaign.run(2)
    assert campaign.tell(0, distance=0.5).distance == 0.5
    assert Store(tmp_path / "a.sqlite").trials()[0].distance == 0.5


def test_what_a_store_does_not_take_is_kept_beside_it_every_time(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    campaign = campaign_of(store=path)
    opened = campaign.ask()
    whole = campaign.validation.execute(opened.plan)
    late = [Campaign(campaign.validation, search=searches.GPUCB(), store=path, seed=1) for _ in range(3)]
    for one in late:  # they have looked before the first one told
        one.recorder.refresh = lambda: None  # type: ignore[method-assign]
    campaign.tell(opened, distance=0.1)
    for one in late[:2]:
        with refuses(InputError, "a.trial", "--npz"):
            one.tell(opened, whole)
    with refuses(InputError, "a.trial", "0.json"):
        late[2].tell(0, failed="fell over")
    kept = sorted(tmp_path.glob("a.trial-0*"))
    assert [file.name for file in kept] == ["a.trial-0.1.npz", "a.trial-0.json", "a.trial-0.npz"]
    np.testing.assert_array_equal(Trajectory.from_npz(kept[0]).states, whole.states)
    assert json.loads(kept[1].read_text()) == {"trial": 0, "distance": None, "failure": "fell over"}
    assert Store(path).trials()[0].distance == 0.1


# One runner


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a file beside the store is locked")
def test_a_second_run_is_refused_by_another_name_and_after_a_lock_file_is_gone(tmp_path: Path) -> None:
    path, link, hard = tmp_path / "a.sqlite", tmp_path / "link.sqlite", tmp_path / "hard.sqlite"
    executed: list[int] = []

    def run_elsewhere(_: Trajectory) -> None:
        executed.append(1)
        for name in (path, link, hard):
            (tmp_path / "a.sqlite.lock").unlink(missing_ok=True)
            with refuses(StoreMismatchError, "a.sqlite", "validation.system"):
                campaign_of(store=name).run(3)

    campaign = campaign_of(run_elsewhere, path)
    link.symlink_to(path)
    hard.hardlink_to(path)
    campaign.run(2)
    assert len(executed) == 2
    assert not (tmp_path / "a.sqlite.lock").exists()


def test_a_changed_folder_does_not_move_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    campaign = campaign_of(lambda whole: os.chdir(tmp_path / "elsewhere"), Path("a.sqlite")).run(3)
    assert campaign.store.path == tmp_path / "a.sqlite"
    assert len(Store(tmp_path / "a.sqlite").trials()) == 3


def test_threads_can_run_their_own_campaigns() -> None:
    ended: list[int] = []
    threads = [threading.Thread(target=lambda: ended.append(campaign_of(leave).run(3).executions)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert ended == [3, 3]


def test_an_execution_in_a_notebook_can_be_interrupted_by_a_person() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    validation = make_validation(system=Doing(lambda whole: signal.raise_signal(signal.SIGINT)))
    plan = validation.plan([1.0])
    try:
        with pytest.raises(KeyboardInterrupt):
            validation.execute(plan)
    finally:
        signal.signal(signal.SIGINT, before)
    with refuses(ExecutionError, "SystemExit", 3):
        make_validation(system=Doing(leave)).execute(plan)


def test_an_alarm_of_the_system_itself_is_its_failure() -> None:
    def stuck(_number: int, _frame: Any) -> None:
        raise TimeoutError("rig stuck")

    before = signal.signal(signal.SIGUSR1, stuck)
    try:
        campaign = campaign_of(lambda whole: signal.raise_signal(signal.SIGUSR1)).run(2)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert [t.failure for t in campaign.trials] == ["TimeoutError: rig stuck"] * 2


@pytest.mark.parametrize("act", [leave, interrupt_by_code, leave_hard])
def test_a_distance_that_exits_leaves_its_execution(act: Any) -> None:
    def distance(model: Any, system: Any, task: Any) -> float:
        if differ(model, system):
            act(system)
        return 0.0

    campaign = campaign_of(distance=distance)
    with pytest.raises(DistanceError):
        campaign.run(2)
    assert [t.state for t in campaign.trials] == ["unmeasured"]


def test_a_design_that_exits_stops_the_campaign_behind_its_trial() -> None:
    class Leaving:
        def design(self, task: Any, model: Any) -> Any:
            os._exit(0)

        def describe(self) -> dict[str, object]:
            return {}

    campaign = campaign_of()
    campaign.validation.synthesizer = Leaving()
    for _ in range(2):
        with refuses(DesignError, "os._exit", "goal"):
            campaign.run(2)
    assert [t.state for t in campaign.trials] == ["failed", "failed"]
