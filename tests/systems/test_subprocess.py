"""The adapter of commands, with real processes in several languages."""

from __future__ import annotations

import concurrent.futures
import contextlib
import ctypes
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rig_command
from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, searches, systems, testing
from ctxval._util.arrays import Array
from ctxval.core.controller import AffineFeedback
from ctxval.errors import ExecutionError, InputError
from ctxval.systems import Subprocess
from ctxval.systems import subprocess as adapter
from ctxval.systems import subprocess as supervised
from facts import assert_names, refuses
from rig_thorough import more

MODEL = models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.05]])
TASK = Task([1.0, -0.5], goal=[0.2, 0.0], horizon=20, dt=0.1)

LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs a child subreaper")

# A rig's program, with nothing of ctxval in it.
RIG = """
import csv, json, sys
from pathlib import Path

folder = Path(sys.argv[-1])
task, controller = (json.loads((folder / f"{name}.json").read_text()) for name in ("task", "controller"))
x, rows = task["initial_state"], []
for t in range(task["horizon"] + 1):
    row = [t * task["dt"], *x]
    if t < task["horizon"]:
        K, v, x_0 = (controller[name][t] for name in ("gains", "inputs", "states"))
        u = v[0] + sum(k * (a - b) for k, a, b in zip(K[0], x, x_0))
        x = [x[0] + 0.1 * x[1], x[1] + 0.1 * (u - 0.1 * x[1] * abs(x[1])) / 2]
        row.append(u)
    rows.append(row)
with open(folder / "trajectory.csv", "w", newline="") as file:
    csv.writer(file).writerows([["t", "x0", "x1", "u0"], *rows])
"""


def cart(x: Array, u: Array) -> Array:
    position, speed = x[..., 0], x[..., 1]
    pull = u[..., 0] - 0.1 * speed * np.abs(speed)
    return np.stack([position + 0.1 * speed, speed + 0.1 * pull / 2], axis=-1)


def designed() -> AffineFeedback:
    return controllers.LQR([10.0, 1.0], [0.1]).design(TASK, MODEL)


def python(folder: Path, code: str, *arguments: str, **options: Any) -> Subprocess:
    script = folder / "rig.py"
    script.write_text(code)
    # -S -E: as fast to start as Python can be.
    return Subprocess([sys.executable, "-S", "-E", str(script), *arguments], **{"timeout": 30, **options})


def test_a_program_that_knows_nothing_of_ctxval_executes_a_task(tmp_path: Path) -> None:
    trajectory = python(tmp_path, RIG).execute(designed(), TASK)
    expected = systems.Simulated(cart, vectorized=True).execute(designed(), TASK)
    np.testing.assert_allclose(trajectory.states, expected.states, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trajectory.inputs, expected.inputs, rtol=0, atol=1e-12)


def test_it_keeps_the_contract_of_a_system(tmp_path: Path) -> None:
    testing.check_system(python(tmp_path, RIG), designed(), TASK, tolerance=0)


@pytest.mark.skipif(shutil.which("awk") is None, reason="no awk")
def test_any_language_will_do(tmp_path: Path) -> None:
    script = tmp_path / "rig.sh"
    script.write_text(
        "for folder; do :; done\n"
        """awk 'BEGIN { print "t,x0,x1,u0"; for (t = 0; t < 20; t++) print t / 10 ",1,-0.5,0"; print "2,1,-0.5," }' """
        '> "$folder/trajectory.csv"\n'
    )
    assert (Subprocess(f"sh '{script}'", timeout=30).execute(designed(), TASK).states == [1, -0.5]).all()


def test_a_trajectory_may_come_as_npz_and_say_how_it_ended(tmp_path: Path) -> None:
    code = f"""
import sys
sys.path[:0] = {sys.path!r}
import numpy as np
states = np.zeros((21, 2))
states[5:] = np.nan
np.savez(sys.argv[-1] + "/trajectory.npz", times=np.arange(21) / 10, states=states, inputs=np.zeros((20, 1)),
         ended="motor stalled")
"""
    assert python(tmp_path, code).execute(designed(), TASK).ended == "motor stalled"


def test_names_and_units_go_into_the_files_and_folders_can_be_kept(tmp_path: Path) -> None:
    keep = tmp_path / "kept"
    names: dict[str, Any] = {"states": {"position": "m", "speed": "m/s"}, "inputs": {"force": "N"}}
    system = python(tmp_path, RIG + "print('done')", keep=keep, **names)
    for _ in range(2):
        system.execute(designed(), TASK)
    folders = list(keep.iterdir())
    assert len(folders) == 2
    assert {path.name for path in folders[0].iterdir()} == {
        *("task.json", "controller.json", "controller.npz", "trajectory.csv", "stdout.txt", "stderr.txt")
    }
    assert '"input_units": ["N"]' in (folders[0] / "controller.json").read_text()
    assert (folders[0] / "stdout.txt").read_text() == "done\n"


# Times


def test_measured_times_that_jitter_are_brought_to_those_of_the_task(tmp_path: Path) -> None:
    late = "late = 0.02 if t % 2 else 0.0"
    code = RIG.replace('row = [t * task["dt"], *x]', late + '; row = [t * task["dt"] + late, t + 10 * late, 0.0]')
    trajectory = python(tmp_path, code).execute(designed(), TASK)
    np.testing.assert_array_equal(trajectory.times, TASK.times)
    np.testing.assert_allclose(trajectory.states[1:-1:2, 0], np.arange(1, 20, 2), atol=1e-9)


@pytest.mark.parametrize("clock", ["t * 0.3", "t * 0.1 * 1.02", "t * 0.1 + (0.04 if t == 7 else 0)", "t * 0.001"])
def test_a_rig_that_does_not_keep_the_time_step_is_refused_with_its_period(clock: str, tmp_path: Path) -> None:
    with refuses(ExecutionError, 0.1, "trajectory"):
        python(tmp_path, RIG.replace('t * task["dt"]', clock)).execute(designed(), TASK)


# Failures


STOPS = RIG.replace(
    "folder = Path",
    """import signal, time


def stop(number, frame):
    with open(folder / "trajectory.csv", "w", newline="") as file:
        csv.writer(file).writerows([["t", "x0", "x1", "u0"], *rows])
    Path(sys.argv[1], "stopped").touch()
    sys.exit(0)


signal.signal(signal.SIGTERM, stop)
folder = Path""",
).replace(
    "    rows.append(row)",
    """    rows.append(row)
    if t == 6:
        Path(sys.argv[1], "runs").touch()
        time.sleep(60)""",
)


def test_a_rig_has_time_to_stop_and_its_recording_is_kept(tmp_path: Path) -> None:
    system = python(tmp_path, STOPS, str(tmp_path), timeout=0.5)
    trajectory = system.execute(designed(), TASK)
    assert (tmp_path / "stopped").exists()
    assert_names(trajectory.ended, 0.5, "stopped")
    space = TaskSpace(speed=(-0.6, -0.5))
    validation = Validation(
        space=space,
        task=lambda p: Task(np.stack([np.ones_like(p.speed), p.speed], -1), goal=[0.2, 0.0], horizon=20, dt=0.1),
        system=system,
        model=MODEL,
        synthesizer=controllers.LQR([10.0, 1.0], [0.1]),
        distance=distances.FinalState(),
    )
    campaign = Campaign(validation, seed=0).run(1)
    (trial,) = campaign.failed
    _, kept = campaign.trajectories(trial)
    assert "was stopped" in str(trial.failure)
    assert kept is not None
    assert kept.horizon == 6


def test_a_rig_that_ignores_sigterm_is_killed_after_the_grace_period(tmp_path: Path) -> None:
    code = SPAWN + "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"
    began = time.monotonic()
    with refuses(ExecutionError, 0.3):
        python(tmp_path, code, str(tmp_path), timeout=0.3, grace=0.1).execute(designed(), TASK)
    assert time.monotonic() - began < 20
    assert gone(int((tmp_path / "pid").read_text()))


def test_an_interrupted_rig_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(stdout: Any, timeout: float) -> bool:
        while not (tmp_path / "runs").exists():
            time.sleep(0.005)
        raise KeyboardInterrupt

    monkeypatch.setattr(supervised, "_readable", interrupted)
    with pytest.raises(KeyboardInterrupt):
        python(tmp_path, STOPS, str(tmp_path)).execute(designed(), TASK)
    assert (tmp_path / "stopped").exists()


@pytest.mark.parametrize(
    ("code", "facts"),
    [
        ("import sys; print('warming up', file=sys.stderr); sys.exit('the brake is on')", (1,)),
        ("raise RuntimeError('no power')", (1, "RuntimeError")),
        ("import sys; sys.exit(7)", (7,)),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", ("SIGKILL",)),
        ("pass", ("trajectory.npz", "trajectory.csv")),
        (
            "import sys; open(sys.argv[-1] + '/trajectory.npz', 'w').write('junk')",
            ("trajectory.npz",),
        ),
        ("import sys; open(sys.argv[-1] + '/trajectory.csv', 'w').write('a,b\\n1,2\\n3,4\\n')", ("trajectory.csv",)),
        (RIG.replace('task["horizon"]', "5"), ((21, 2), (6, 2))),
        (
            RIG.replace('t * task["dt"]', "t * 0.2"),
            (0.1, 1),
        ),
    ],
)
def test_a_failed_execution_says_why(code: str, facts: tuple[object, ...], tmp_path: Path) -> None:
    with refuses(ExecutionError, *facts):
        python(tmp_path, code).execute(designed(), TASK)


@pytest.mark.parametrize("kind", ["npz", "csv"])
def test_no_damage_of_a_trajectory_gives_anything_but_a_failed_execution(kind: str, tmp_path: Path) -> None:
    trajectory = systems.Simulated(cart, vectorized=True).execute(designed(), TASK)
    path, rng = tmp_path / f"trajectory.{kind}", np.random.default_rng(0)
    trajectory.to_csv(path) if kind == "csv" else path.write_bytes(trajectory.to_npz())
    whole = path.read_bytes()
    for _ in range(150):
        broken = bytearray(whole)
        for position in rng.integers(len(whole), size=3):
            broken[position] = rng.integers(256)
        path.write_bytes(bytes(broken[: rng.integers(1, len(whole) + 1)] if rng.random() < 0.3 else broken))
        with contextlib.suppress(ExecutionError):
            adapter._trajectory(tmp_path, TASK)


def test_executions_run_side_by_side(tmp_path: Path) -> None:
    system = python(tmp_path, RIG)
    alone = system.execute(designed(), TASK).states
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        for trajectory in pool.map(lambda _: system.execute(designed(), TASK), range(6)):
            np.testing.assert_array_equal(trajectory.states, alone)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        # A zombie that nobody has collected yet does not count.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except ProcessLookupError:
        return False
    except FileNotFoundError:  # it has ended just now, or this is no Linux
        return not sys.platform.startswith("linux")


def gone(pid: int) -> bool:
    deadline = time.monotonic() + 5
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    return not alive(pid)


SPAWN = """
import pathlib, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(60)"])
(pathlib.Path(sys.argv[1]) / "pid").write_text(str(child.pid))
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[float | None]:
    """Return the distances of a campaign on a command that nothing disturbs."""
    campaign = rig_command.campaign(tmp_path_factory.mktemp("whole"), seconds=0)
    return [trial.distance for trial in campaign.run(6).trials]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, *more(1)])
def test_a_command_ends_with_a_campaign_that_is_killed(workers: int, tmp_path: Path, whole: list[float | None]) -> None:
    campaign = rig_command.start(tmp_path, seconds=60, workers=workers)
    deadline = time.monotonic() + 30
    while len(pids := rig_command.processes(tmp_path)) < workers and time.monotonic() < deadline:
        time.sleep(0.01)
    assert all(alive(pid) for pid in pids)
    campaign.kill()
    campaign.wait()
    assert len(pids) == workers
    assert all(gone(pid) for pid in pids)
    resumed = rig_command.campaign(tmp_path, tmp_path / "a.sqlite", seconds=0)
    assert [trial.state for trial in resumed.trials] == ["open"] * workers
    assert [trial.distance for trial in resumed.run(6).trials] == whole


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
@pytest.mark.parametrize(("end", "facts"), [("time.sleep(60)", (1, "end")), ("sys.exit(3)", (3,))])
def test_whatever_the_command_started_ends_with_it(end: str, facts: tuple[object, ...], tmp_path: Path) -> None:
    started = time.monotonic()
    with refuses(ExecutionError, *facts):
        python(tmp_path, SPAWN + end, str(tmp_path), timeout=1).execute(designed(), TASK)
    assert time.monotonic() - started < 20
    assert gone(int((tmp_path / "pid").read_text()))


# It leaves its session, so its group, and loses its parent; then it says who it is.
ESCAPE = """
import os, pathlib, sys, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        os.setsid()
        mark = pathlib.Path(sys.argv[1]) / f"{os.getpid()}.escaped"
        mark.touch()
        time.sleep(60)
    os._exit(0)
os.wait()
while not list(pathlib.Path(sys.argv[1]).glob("*.escaped")):
    time.sleep(0.005)
"""


def escaped(folder: Path, count: int = 1) -> list[int]:
    deadline = time.monotonic() + 30
    while len(found := list(folder.glob("*.escaped"))) < count and time.monotonic() < deadline:
        time.sleep(0.005)
    return [int(path.stem) for path in found]


@pytest.mark.slow
@LINUX
@pytest.mark.parametrize("end", ["", "sys.exit(3)", *more("time.sleep(60)"), "os.kill(os.getpid(), 9)"])
def test_what_left_the_group_ends_with_the_command(end: str, tmp_path: Path) -> None:
    with refuses(ExecutionError):
        python(tmp_path, ESCAPE + end, str(tmp_path), timeout=1).execute(designed(), TASK)
    (pid,) = escaped(tmp_path)
    assert gone(pid)


@pytest.mark.slow
@LINUX
def test_many_that_have_left_the_group_end_too(tmp_path: Path) -> None:
    code = "import os, sys\nfor _ in range(3):\n    os.fork()\n" + ESCAPE + "time.sleep(60)"
    with refuses(ExecutionError, 1):
        python(tmp_path, code, str(tmp_path), timeout=1).execute(designed(), TASK)
    assert all(gone(pid) for pid in escaped(tmp_path, 8))


CAMPAIGN = """
import sys
sys.path[:0] = {path!r}
from pathlib import Path
from test_subprocess import *
python(Path({folder!r}), ESCAPE + "time.sleep(60)", {folder!r}).execute(designed(), TASK)
"""


@pytest.mark.slow
@LINUX
def test_what_left_the_group_ends_with_a_process_that_is_killed(tmp_path: Path) -> None:
    code = CAMPAIGN.format(path=sys.path, folder=str(tmp_path))
    campaign = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parent)
    (pid,) = escaped(tmp_path)
    campaign.kill()
    campaign.wait()
    assert gone(pid)


@LINUX
def test_the_process_itself_adopts_nobody(tmp_path: Path) -> None:
    python(tmp_path, RIG).execute(designed(), TASK)
    adopts = ctypes.c_int(-1)
    assert ctypes.CDLL(None).prctl(37, ctypes.byref(adopts), 0, 0, 0) == 0  # PR_GET_CHILD_SUBREAPER
    assert adopts.value == 0


@pytest.mark.slow
@LINUX
@pytest.mark.parametrize("signal_", ["SIGKILL", "SIGSTOP"])
def test_a_supervisor_that_is_killed_or_stopped_takes_its_command_with_it(signal_: str, tmp_path: Path) -> None:
    # Whoever watches has time to say which process it started, also on a busy computer.
    code = SPAWN + f"import os, signal; time.sleep(0.5); os.kill(os.getppid(), signal.{signal_}); time.sleep(60)"
    rig = python(tmp_path, code, str(tmp_path), timeout=2)
    rig.patience = 0.2
    with refuses(ExecutionError):
        rig.execute(designed(), TASK)
    assert gone(int((tmp_path / "pid").read_text()))


def test_all_is_killed_when_we_are_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pids = []

    def interrupted(stdout: Any, timeout: float) -> bool:
        while not (tmp_path / "pid").exists() or not (text := (tmp_path / "pid").read_text()):
            time.sleep(0.005)
        pids.append(int(text))
        raise KeyboardInterrupt

    monkeypatch.setattr(supervised, "_readable", interrupted)
    with pytest.raises(KeyboardInterrupt):
        python(tmp_path, SPAWN + "time.sleep(60)", str(tmp_path)).execute(designed(), TASK)
    assert gone(pids[0])


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("false") is None, reason="no false")
def test_the_status_of_the_shortest_command_is_never_lost() -> None:
    system = Subprocess("false", timeout=30)
    for _ in range(15):
        with refuses(ExecutionError, 1):
            system.execute(designed(), TASK)


def test_a_program_that_cannot_be_started_any_more_is_a_failed_execution(tmp_path: Path) -> None:
    program = tmp_path / "rig"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    system = Subprocess([str(program)], timeout=5)
    program.unlink()
    with refuses(ExecutionError):
        system.execute(designed(), TASK)


def test_a_timeout_may_be_longer_than_the_system_can_wait(tmp_path: Path) -> None:
    assert python(tmp_path, RIG, timeout=float("inf")).execute(designed(), TASK).ended == "complete"


# What is no file


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs and devices")
@pytest.mark.parametrize("name", ["trajectory.npz", "trajectory.csv"])
@pytest.mark.parametrize(
    "make",
    [
        "os.mkfifo(path)",
        "os.symlink('/dev/zero', path)",
        "os.symlink('/dev/tty', path)",
        "os.mkdir(path)",
        "os.symlink('nowhere', path)",
        "os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), 2**33)",
    ],
)
def test_what_is_no_file_is_neither_waited_for_nor_read(make: str, name: str, tmp_path: Path) -> None:
    code = f"import os, sys; path = sys.argv[-1] + '/{name}'; {make}"
    with refuses(ExecutionError, name):
        python(tmp_path, code, timeout=5).execute(designed(), TASK)


def test_a_trajectory_may_be_a_link_to_a_file(tmp_path: Path) -> None:
    code = RIG + f"__import__('shutil').move(folder / 'trajectory.csv', {str(tmp_path / 'log')!r})\n"  # another disk
    code += f"__import__('os').symlink({str(tmp_path / 'log')!r}, folder / 'trajectory.csv')"
    assert python(tmp_path, code).execute(designed(), TASK).ended == "complete"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs")
def test_a_fifo_in_place_of_what_the_command_wrote_on_stderr_is_not_waited_for(tmp_path: Path) -> None:
    code = "import os, sys; p = sys.argv[-1] + '/stderr.txt'; os.unlink(p); os.mkfifo(p); sys.exit('the brake is on')"
    with refuses(ExecutionError, 1):
        python(tmp_path, code).execute(designed(), TASK)


def test_more_numbers_than_the_task_has_are_not_read(tmp_path: Path) -> None:
    code = "import sys; open(sys.argv[-1] + '/trajectory.csv', 'w').write('t,x0,x1,u0\\n' + '0,1,2,3\\n' * 22)"
    with refuses(ExecutionError, "trajectory.csv", 21):
        python(tmp_path, code).execute(designed(), TASK)


def test_it_does_not_depend_on_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "rig.py").write_text(RIG)
    monkeypatch.chdir(tmp_path)
    system = Subprocess([sys.executable, "-S", "-E", "rig.py"], timeout=30, keep="kept")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert system.execute(designed(), TASK).ended == "complete"
    assert len(list((tmp_path / "kept").iterdir())) == 1


def test_a_controller_that_cannot_leave_the_process_is_refused(tmp_path: Path) -> None:
    with refuses(InputError, "LQR", "iLQR"):
        python(tmp_path, RIG).execute(lambda t, x: x[:1], TASK)


@pytest.mark.parametrize("command", ["", [], "no-such-program --fast"])
def test_programs_must_exist(command: Any) -> None:
    with refuses(InputError, "command"):
        Subprocess(command, timeout=1)


@pytest.mark.parametrize("timeout", [0, -1, None, float("nan")])
def test_timeouts_must_be_positive(timeout: Any) -> None:
    with refuses(InputError, "timeout"):
        Subprocess(["sh"], timeout=timeout)


def test_a_campaign_on_a_command_records_its_failures(tmp_path: Path) -> None:
    code = RIG.replace("x, rows = task", "sys.exit('over edge') if task['reference'][-1][0] > 1 else 0; x, rows = task")
    validation = Validation(
        space=TaskSpace(goal=(0.5, 1.5, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=20, dt=0.1),
        system=python(tmp_path, code),
        model=MODEL,
        synthesizer=controllers.LQR([10.0, 1.0], [0.1]),
        distance=distances.FinalState(),
    )
    campaign = Campaign(validation, search=searches.Random()).run(6)
    assert 0 < len(campaign.failed) < 6
    assert all(str(trial.failure).endswith("over edge") for trial in campaign.failed)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [*more(None), 2])
def test_a_killed_command_costs_its_own_trial_and_nothing_else(
    tmp_path: Path, workers: int | None, whole: list[float | None]
) -> None:
    campaign = rig_command.campaign(tmp_path, tmp_path / "a.sqlite", seconds=0.4)
    thread = rig_command.killer(tmp_path, after=2, wait=0.1)
    campaign.run(6, workers=workers)
    thread.join()
    (killed,) = campaign.failed
    assert_names(str(killed.failure), "SIGKILL")
    assert campaign.executions == 6
    expected = [None if number == killed.number else distance for number, distance in enumerate(whole)]
    assert [trial.distance for trial in campaign.trials] == expected
    assert len(list((tmp_path / "marks").iterdir())) == 6


@pytest.mark.slow
def test_a_killed_command_is_run_again_where_the_user_says_so(tmp_path: Path, whole: list[float | None]) -> None:
    campaign = rig_command.campaign(tmp_path, tmp_path / "a.sqlite", seconds=0.4)
    thread = rig_command.killer(tmp_path, after=2, wait=0.1)
    campaign.run(6, workers=2, retry_failures=1)
    thread.join()
    assert sorted(trial.attempts for trial in campaign.trials) == [1, 1, 1, 1, 1, 2]
    assert [trial.distance for trial in campaign.trials] == whole
