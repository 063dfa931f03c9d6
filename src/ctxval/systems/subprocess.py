"""A command as the true system: a rig's own program, a simulator, any language.

Its child processes all end: with the command, at a timeout, and with the process that started it. If a command went on
after ``kill -9`` of its campaign, it would move a rig at the same time as its own repetition.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import selectors
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import IO

from ctxval._util.checked import NonNegativeFloat, TimeLimit
from ctxval._util.files import temporary_folder
from ctxval._util.refusals import reworded
from ctxval._util.registry import part
from ctxval.core.controller import Controller
from ctxval.core.exchange import write_controller, write_task
from ctxval.core.labels import require_names
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, Trajectory, at_times
from ctxval.errors import ExecutionError, InputError
from ctxval.systems.episode import require_one

_PROGRAM = Path(__file__).absolute().with_name("supervisor.py")


def run_supervised(
    command: Sequence[str],
    folder: Path | None,
    stdout: IO[bytes],
    stderr: IO[bytes],
    timeout: float,
    grace: float = 0.0,
    patience: float = 10.0,
) -> int | None:
    """Run a command, and end all processes that it started, however this call ends.

    A command that must be ended gets SIGTERM, and SIGKILL after ``grace`` seconds. Return the exit status, negative for
    a signal, or None if the command did not end in time. A supervisor that does not end its command in ``patience``
    more seconds is killed itself.
    """
    if os.name != "posix":
        # Run a command on a system without process groups; processes that it starts may outlive it.
        with reworded("the command cannot be started", OSError, to=ExecutionError):
            process = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr)
        try:
            return process.wait(timeout)
        except subprocess.TimeoutExpired:
            return None
        finally:
            process.kill()
            process.wait()
    descriptors = stdout.fileno(), stderr.fileno()
    # -I, because modules in the folder of the program have the same names as other modules. A session of its own,
    # because Ctrl-C is for the campaign, which ends after the running executions.
    program = [sys.executable, "-I", "-S", str(_PROGRAM), str(os.getpid()), *map(str, (*descriptors, grace)), *command]
    with reworded("the command cannot be started", OSError, to=ExecutionError):
        supervisor = subprocess.Popen(
            program,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,  # because select does not see a line that was read ahead
            cwd=folder,
            pass_fds=descriptors,
            start_new_session=True,
        )
    assert supervisor.stdout is not None
    child = 0
    try:
        line = supervisor.stdout.readline().split()
        if len(line) == 2:
            raise ExecutionError(f"the command cannot be started: {os.strerror(int(line[1]))}")
        child = int(line[0]) if line else 0
        if not _readable(supervisor.stdout, timeout):
            return None
        status = supervisor.stdout.readline().strip()
        if not status.lstrip(b"-").isdigit():
            raise ExecutionError("the process that watches the command was killed")
        return int(status)
    finally:
        _end(supervisor, child, grace + patience)


def _readable(stdout: IO[bytes], timeout: float) -> bool:
    with selectors.DefaultSelector() as selector:
        selector.register(stdout, selectors.EVENT_READ)
        return bool(selector.select(timeout if timeout < 1e6 else None))  # the system does not take years


def _end(supervisor: subprocess.Popen[bytes], child: int, seconds: float) -> None:
    """Make the supervisor end the remaining processes; if it does not in time, kill it and the command's group."""
    assert supervisor.stdin is not None
    assert supervisor.stdout is not None
    with contextlib.suppress(OSError):
        supervisor.stdin.write(b"\n")
    with contextlib.suppress(OSError):
        supervisor.stdin.close()
    try:
        supervisor.wait(seconds)
    except subprocess.TimeoutExpired:  # e.g. somebody stopped the supervisor by SIGSTOP
        supervisor.kill()
        supervisor.wait()
    finally:
        supervisor.stdout.close()
        if child and supervisor.returncode:
            with contextlib.suppress(OSError):
                os.killpg(child, signal.SIGKILL)


@part(folder="folder")
class Subprocess:
    """A command that executes one task, as the true system.

    Every execution has a new folder with ``task.json`` and the controller as ``controller.json`` and
    ``controller.npz`` (see :mod:`ctxval.core.exchange`). The command gets the path of that folder as its last argument.
    It writes ``trajectory.npz`` (times, states, inputs, optionally ended) or ``trajectory.csv`` (columns
    ``t, x0, ..., u0, ...``, no inputs in the last row) into that folder, as a regular file. The command runs in the
    folder that was the current folder when this object was made.

    If the exit status is not 0, the execution has failed, and the last line of stderr is the reason. A trajectory that
    the command has written until then is kept with the failed trial. All processes that the command started end with
    it, and also if this process ends in any way; on Linux this includes processes that left its process group. A
    command that must be ended gets SIGTERM, so that it can stop the rig and write its recording.

    The times should be measured. If they differ by at most a quarter of a step from those of the task, the states are
    interpolated to the times of the task; otherwise the execution has failed.

    Args:
        command: the program and its arguments; a string is split like a shell does. No shell runs the command.
        timeout: seconds after which the command and all processes that it started are ended.
        grace: seconds between SIGTERM and SIGKILL.
        states, inputs: names of the states and inputs with their units, for the files.
        keep: a folder in which the folders of all executions are kept, to examine failures.
        folder: folder in which the files that the command names are searched before the current one.

    Raises:
        InputError: if the command names no program.
    """

    patience = 10.0  # seconds that a supervisor has to kill its command before it is killed itself

    def __init__(
        self,
        command: str | Sequence[str],
        *,
        timeout: TimeLimit,
        grace: NonNegativeFloat = 5.0,
        states: Mapping[str, str] | None = None,
        inputs: Mapping[str, str] | None = None,
        keep: str | Path | None = None,
        folder: str | Path | None = None,
    ) -> None:
        self.command = shlex.split(command) if isinstance(command, str) else [str(part) for part in command]
        self._located = self.command
        if folder is not None:  # a program name without a path stays as it is
            home = Path(folder).absolute()
            self._located = [
                str(home / part) if (i or os.path.dirname(part)) and (home / part).is_file() else part
                for i, part in enumerate(self.command)
            ]
        if not self.command or shutil.which(self._located[0]) is None:
            raise InputError(f"the command must begin with a program that can be run, got {self.command}.")
        self.timeout = timeout
        self.grace = grace
        self.states = None if states is None else dict(states)
        self.inputs = None if inputs is None else dict(inputs)
        require_names(states or (), inputs or ())
        # Absolute, because other code in this process may change the current folder.
        self.keep = None if keep is None else Path(keep).absolute()
        self._home = Path.cwd()

    def describe(self) -> dict[str, object]:
        """Return its program, and digests of the files that the command names; other arguments may be secrets."""
        named = [*self._located[1:], *(self._located[:1] if not os.path.isabs(self.command[0]) else [])]
        files = {Path(name).name: Path(name).read_bytes() for name in named if os.path.isfile(name)}
        digests = {name: hashlib.sha256(content).hexdigest()[:16] for name, content in files.items()}
        return {"program": Path(self.command[0]).name, "files": digests, "states": self.states, "inputs": self.inputs}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        require_one(task)
        kept: AbstractContextManager[Path] = temporary_folder()
        if self.keep is not None:
            self.keep.mkdir(parents=True, exist_ok=True)
            kept = contextlib.nullcontext(Path(tempfile.mkdtemp(prefix="execution-", dir=self.keep)).resolve())
        with kept as folder:
            write_task(folder / "task.json", task, states=self.states)
            for kind in ("json", "npz"):
                path = folder / f"controller.{kind}"
                write_controller(path, controller, dt=task.dt, states=self.states, inputs=self.inputs)
            home = self._home if self._home.is_dir() else None  # on another machine the folder may not exist
            # Output goes to files, because a grandchild that keeps a pipe open would make us wait for it.
            with (folder / "stdout.txt").open("wb") as stdout, (folder / "stderr.txt").open("w+b") as stderr:
                command = [*self._located, str(folder)]
                status = run_supervised(command, home, stdout, stderr, self.timeout, self.grace, self.patience)
                # The file is not opened again, because its name may now stand for another file.
                stderr.seek(max(0, stderr.seek(0, os.SEEK_END) - 4096))
                lines = stderr.read().decode("utf-8", "replace").splitlines() if status else []
            if status == 0:
                return _trajectory(folder, task)
            if status is None:
                failed = f"the command did not end within {self.timeout:g} s and was stopped"
            else:
                how = f"was ended by {signal_name(-status)}" if status < 0 else f"ended with status {status}"
                last = next((line.strip()[:300] for line in reversed(lines) if line.strip()), "nothing on stderr")
                failed = f"the command {how}: {last}"
            try:
                return replace(_trajectory(folder, task, failed=True), ended=failed)
            except ExecutionError:  # nothing was recorded that can be used
                raise ExecutionError(failed) from None


def signal_name(number: int) -> str:
    """Return the name of a signal, also of one that Python does not know."""
    with contextlib.suppress(ValueError):
        return signal.Signals(number).name
    return f"signal {number}"


def _trajectory(folder: Path, task: Task, failed: bool = False) -> Trajectory:
    shape = task.horizon + 1, task.initial_state.size
    with reworded("the command's trajectory cannot be used", InputError, OSError, MemoryError, to=ExecutionError):
        if os.path.lexists(folder / "trajectory.npz"):
            trajectory = Trajectory.from_npz(folder / "trajectory.npz", shape=None if failed else shape)
        elif os.path.lexists(folder / "trajectory.csv"):
            trajectory = Trajectory.from_csv(folder / "trajectory.csv", most_rows=shape[0])
        else:
            raise ExecutionError("the command ended well but wrote neither trajectory.npz nor trajectory.csv")
        if failed or trajectory.ended != COMPLETE:
            with contextlib.suppress(InputError):  # whoever keeps the steps before the failure checks them
                return at_times(trajectory, task.times[: len(trajectory.times)])
            return trajectory
        if trajectory.states.shape != shape:
            raise InputError(f"it must have states of shape {shape}, got {trajectory.states.shape}")
        return at_times(trajectory, task.times)
