"""A command, and the end of all that it starts: after it, at a timeout, and with the process that started it.

A command that goes on after ``kill -9`` of its campaign would move a rig beside its own repetition.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from ctxval.errors import ExecutionError

_PROGRAM = Path(__file__).absolute().with_name("supervisor.py")

_PATIENCE = 10.0
"""Seconds that a supervisor has to end its command, before it is killed itself."""

_LONGEST = 3600.0
"""Seconds that are waited at once: a call of the system takes no timeout of years."""


def run_supervised(
    command: Sequence[str], folder: Path | None, stdout: IO[bytes], stderr: IO[bytes], timeout: float
) -> int | None:
    """Run a command, and end all that it started, however this call ends.

    Args:
        command: the program and its arguments.
        folder: it is run there; None for the current one.
        stdout, stderr: open files.
        timeout: seconds.

    Returns:
        Its status, negative for a signal; None if it did not end in time and was killed.

    Raises:
        ExecutionError: it cannot be started, or its supervisor was killed.
    """
    if os.name != "posix":
        return _run_alone(command, folder, stdout, stderr, timeout)
    descriptors = stdout.fileno(), stderr.fileno()
    # -I: the folder of the program has modules named as those of others. A session of its own: Ctrl-C is for the
    # campaign, which ends after what is running.
    program = [sys.executable, "-I", "-S", str(_PROGRAM), str(os.getpid()), *map(str, descriptors), *command]
    supervisor = _started(program, cwd=folder, pass_fds=descriptors, start_new_session=True)
    assert supervisor.stdout is not None
    child = 0
    try:
        line = supervisor.stdout.readline().split()
        if len(line) == 2:
            raise ExecutionError(f"the command cannot be started: {os.strerror(int(line[1]))}")
        child = int(line[0]) if line else 0
        if not _says_something(supervisor.stdout, timeout):
            return None
        status = supervisor.stdout.readline().strip()
        if not status.lstrip(b"-").isdigit():
            raise ExecutionError("the process that watches the command was killed")
        return int(status)
    finally:
        _end(supervisor, child)


def _started(program: Sequence[str], **options: object) -> subprocess.Popen[bytes]:
    try:
        # Unbuffered: a line that was read ahead could not be waited for.
        return subprocess.Popen(  # type: ignore[call-overload, no-any-return]
            program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0, **options
        )
    except OSError as error:
        raise ExecutionError(f"the command cannot be started: {error}") from error


def _says_something(stdout: IO[bytes], timeout: float) -> bool:
    deadline = time.monotonic() + timeout
    with selectors.DefaultSelector() as selector:
        selector.register(stdout, selectors.EVENT_READ)
        while (left := deadline - time.monotonic()) > 0:
            if selector.select(min(left, _LONGEST)):
                return True
    return False


def _end(supervisor: subprocess.Popen[bytes], child: int) -> None:
    """Have the supervisor end what is left; kill what can be found of it where it does not."""
    assert supervisor.stdin is not None
    assert supervisor.stdout is not None
    with contextlib.suppress(OSError):
        supervisor.stdin.write(b"\n")
    with contextlib.suppress(OSError):
        supervisor.stdin.close()
    try:
        supervisor.wait(_PATIENCE)
    except subprocess.TimeoutExpired:  # somebody stopped it
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
    """Run a command where there are no process groups: what it starts may outlive it."""
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
