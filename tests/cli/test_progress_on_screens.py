"""What people see while a command works: at a terminal (a pseudo-terminal here), and in a log."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ctxval import Store
from facts import assert_names
from rig_cli import SMALL, calling

pty = pytest.importorskip("pty", reason="there are no pseudo-terminals here")

RIG = '''
import time
from conftest import make_validation
from ctxval import Experiment, Validation, controllers


class Slow:
    """A synthesizer that takes its time."""

    def design(self, task, model):
        time.sleep(0.02)
        return controllers.LQR([1.0, 0.1], [1e-2], [10.0, 1.0]).design(task, model)


class Manual:
    manual = True

    def execute(self, controller, task):
        raise AssertionError


def validation(system):
    whole = make_validation()
    return Validation(
        space=whole.space, task=whole.task, system=system or whole.system, model=whole.model, synthesizer=Slow(),
        distance=whole.distance,
    )


experiment = Experiment("slow", validation(None))
by_hand = Experiment("slow-by-hand", validation(Manual()))
'''


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "rig.py").write_text(RIG)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "rig", raising=False)
    return tmp_path


def environment(folder: Path) -> dict[str, str]:
    source = Path(__file__).parents[2] / "src"
    path = os.pathsep.join([str(folder), str(source), str(Path(__file__).parents[1])])
    return {**os.environ, "PYTHONPATH": path, "TERM": "xterm-256color", "COLUMNS": "120"}


def at_terminal(folder: Path, *arguments: str, release_after: bytes | None = None) -> tuple[str, str, int]:
    """Return what a command writes to its terminal and to its redirected standard output, and its exit status.

    The file ``release`` is made as soon as the terminal shows a text, if there is one.
    """
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [*SMALL, *arguments], cwd=folder, env=environment(folder), stdout=subprocess.PIPE, stderr=slave, text=True
    )
    os.close(slave)
    seen: list[bytes] = []

    def read() -> None:
        while True:
            try:
                seen.append(os.read(master, 65536))
            except OSError:  # the terminal has no writer any more
                return
            if release_after is not None and release_after in b"".join(seen):
                (folder / "release").touch()

    reader = threading.Thread(target=read)
    reader.start()
    out, _ = process.communicate()
    reader.join()
    os.close(master)
    screen = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", b"".join(seen).decode())
    return screen, out, process.returncode


@pytest.mark.slow
def test_a_run_shows_its_executions_and_what_it_is_doing(folder: Path) -> None:
    screen, out, status = at_terminal(
        folder, "run", "rig:experiment", "--explore", "--budget", "2", "--store", "a.sqlite", "--no-report"
    )
    assert status == 0
    assert re.search(r"executions +\S+ +1/2", screen)
    assert_names(screen, 1)
    assert_names(screen, "designs")
    assert "designs" not in out
    assert "executions" in out


@pytest.mark.slow
def test_a_log_has_a_line_for_each_trial(folder: Path) -> None:
    arguments = ("rig:experiment", "--search", "random", "--store", "a.sqlite", "--no-report")
    done = calling("run")(*arguments, "--budget", "2")
    assert done.exit_code == 0
    assert [line.split()[:2] for line in done.stderr.splitlines()] == [["trial", "0"], ["trial", "1"]]
    assert calling("run")(*arguments, "--budget", "3", "--json").stderr == ""


@pytest.mark.slow
@pytest.mark.thorough
def test_asking_and_waiting_for_the_lock_are_shown(folder: Path) -> None:
    assert calling("ask")("rig:by_hand", "--store", "a.sqlite").exit_code == 0
    with held(folder):
        screen, _, status = at_terminal(folder, "ask", "a.sqlite", release_after=b"waiting for another process")
    assert status == 0
    assert "choosing a task" in screen
    assert_names(screen, 60)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the lock of the store, as another process does, until the file ``release`` exists."""
    taken = threading.Event()

    def hold() -> None:
        with Store(folder / "a.sqlite").sole_writer():
            taken.set()
            while not (folder / "release").exists():
                time.sleep(0.02)

    holder = threading.Thread(target=hold)
    holder.start()
    assert taken.wait(30)
    try:
        yield
    finally:
        (folder / "release").touch()
        holder.join()


@pytest.mark.slow
@pytest.mark.thorough
def test_certifying_is_shown(folder: Path) -> None:
    run = calling("run")("rig:experiment", "--budget", "6", "--search", "random", "--store", "a.sqlite", "--no-report")
    assert run.exit_code == 0
    screen, out, _ = at_terminal(folder, "certify", "a.sqlite", "--threshold", "9", "--kind", "posterior")
    assert re.search(r"drawing the largest distance +\S+ +[\d,]+/[\d,]+ draws", screen)
    assert "draws," not in out
