"""A process that kills commands where the one that started them was killed and cannot.

A command that goes on after ``kill -9`` of its campaign would move a rig beside its own repetition.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator

_PROGRAM = """
import os, signal, sys
groups = set()
for line in sys.stdin:
    (groups.add if line[0] == "+" else groups.discard)(int(line[1:]))
for group in groups:
    try:
        os.killpg(group, signal.SIGKILL)
    except OSError:
        pass
"""

# By the process that it watches: a fork must have one of its own.
_guards: dict[int, subprocess.Popen[bytes]] = {}
_starting = threading.Lock()


@contextlib.contextmanager
def guarded(group: int) -> Iterator[None]:
    """Have a process group killed should this process die meanwhile, however it does."""
    if not hasattr(os, "killpg"):
        yield
        return
    guard = _guard()
    _say(guard, f"+{group}\n")
    try:
        yield
    finally:
        _say(guard, f"-{group}\n")


def _guard() -> subprocess.Popen[bytes]:
    """Return this process's guard, which lives as long as the process."""
    with _starting:
        guard = _guards.get(os.getpid())
        if guard is not None and guard.poll() is not None:  # somebody killed it
            _dismiss()
            guard = None
        if guard is None:
            # A session of its own: what is sent to our group is not for the guard.
            command = [sys.executable, "-S", "-E", "-c", _PROGRAM]
            guard = subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0, start_new_session=True)
            _guards[os.getpid()] = guard
        return guard


def _say(guard: subprocess.Popen[bytes], line: str) -> None:
    assert guard.stdin is not None
    with contextlib.suppress(OSError):  # it was killed: the next execution has a new one
        guard.stdin.write(line.encode())


@atexit.register
def _dismiss() -> None:
    guard = _guards.pop(os.getpid(), None)
    if guard is not None:
        assert guard.stdin is not None
        guard.stdin.close()
        guard.wait()
