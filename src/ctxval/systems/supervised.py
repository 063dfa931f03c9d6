"""Commands whose child processes all end: with the command, at a timeout, and with the process that started it.

If a command went on after ``kill -9`` of its campaign, it would move a rig at the same time as its own repetition.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from ctxval.errors import ExecutionError

_PROGRAM = Path(__file__).absolute().with_name("supervisor.py")

_GRACE_PERIOD = 10.0  # seconds that a supervisor has to end its command before it is killed itself


def run_supervised(
    command: Sequence[str], folder: Path | None, stdout: IO[bytes], stderr: IO[bytes], timeout: float
) -> int | None:
    """Run a command, and end all processes that it started, however this call ends.

    Return the exit status, negative for a signal; None if the command did not end in time and was killed.
    """
    if os.name != "posix":
        return _run_alone(command, folder, stdout, stderr, timeout)
    descriptors = stdout.fileno(), stderr.fileno()
    # -I, because modules in the folder of the program have the same names as other modules. A session of its own,
    # because Ctrl-C is for the campaign, which ends after the running executions.
    program = [sys.executable, "-I", "-S", str(_PROGRAM), str(os.getpid()), *map(str, descriptors), *command]
    try:
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
    except OSError as error:
        raise ExecutionError(f"the command cannot be started: {error}") from error
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
        _end(supervisor, child)


def _readable(stdout: IO[bytes], timeout: float) -> bool:
    with selectors.DefaultSelector() as selector:
        selector.register(stdout, selectors.EVENT_READ)
        return bool(selector.select(timeout if timeout < 1e6 else None))  # the system does not take years


def _end(supervisor: subprocess.Popen[bytes], child: int) -> None:
    """Make the supervisor end the remaining processes; if it does not, kill it and the command's group."""
    assert supervisor.stdin is not None
    assert supervisor.stdout is not None
    with contextlib.suppress(OSError):
        supervisor.stdin.write(b"\n")
    with contextlib.suppress(OSError):
        supervisor.stdin.close()
    try:
        supervisor.wait(_GRACE_PERIOD)
    except subprocess.TimeoutExpired:  # e.g. somebody stopped the supervisor by SIGSTOP
        supervisor.kill()
        supervisor.wait()
    finally:
        supervisor.stdout.close()
        if child and supervisor.returncode:
            with contextlib.suppress(OSError):
                os.killpg(child, signal.SIGKILL)


def _run_alone(
    command: Sequence[str], folder: Path | None, stdout: IO[bytes], stderr: IO[bytes], timeout: float
) -> int | None:
    """Run a command on a system without process groups; processes that it starts may outlive it."""
    try:
        process = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr)
    except OSError as error:
        raise ExecutionError(f"the command cannot be started: {error}") from error
    try:
        return process.wait(timeout)
    except subprocess.TimeoutExpired:
        return None
    finally:
        process.kill()
        process.wait()
