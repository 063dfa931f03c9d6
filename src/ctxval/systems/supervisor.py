# ruff: noqa: SIM105  -- importing contextlib takes as long as all other imports
"""The process that runs one command and ends all processes of it; :mod:`ctxval.systems.subprocess` starts this file.

A command may start processes that leave its group (``setsid``) or lose their parent. On Linux this process is their
reaper: a process that loses its parent becomes a child of this one, so that none escapes. This process has no other
children; the campaign's process may have some, so it cannot be the reaper. Nothing of ctxval is imported, and little
else, because this file is started for every execution.

Its arguments are the id of the campaign's process, the descriptors of the command's stdout and stderr, the seconds that
a command has to stop a rig after SIGTERM, and the command.
It writes two lines: the id of the command's process, and, after all its processes have ended, the exit status, negative
for a signal. Any input on stdin, or its end, means that the command must be ended.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import sys
import time

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

_LINUX = sys.platform.startswith("linux")


def main() -> None:
    """Run the command, until it ends or must be ended."""
    parent, stdout, stderr, grace, *command = sys.argv[1:]
    if _LINUX:
        ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda _signal, _frame: None)
    try:
        child = _spawn(command, int(stdout), int(stderr))
    except OSError as error:
        _say(f"error {error.errno}")
        return
    _say(str(child))
    statuses: dict[int, int] = {}
    while not _reap(statuses) and child not in statuses and os.getppid() == int(parent):
        # A fork of the campaign may hold our stdin open, so its process is looked at, too.
        if 0 in (ready := select.select([0, woken], [], [], 0.5)[0]):
            break
        if ready:
            os.read(woken, 4096)
    if child not in statuses:
        _signal(_left(child), signal.SIGTERM)
        deadline = time.monotonic() + float(grace)
        while not _reap(statuses) and time.monotonic() < deadline:
            time.sleep(0.005)
    _end(child, statuses)
    _say(str(os.waitstatus_to_exitcode(statuses[child])) if child in statuses else "lost")


def _spawn(command: list[str], stdout: int, stderr: int) -> int:
    files: list[tuple[Any, ...]] = [(os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)]
    files += [(os.POSIX_SPAWN_DUP2, stdout, 1), (os.POSIX_SPAWN_DUP2, stderr, 2)]
    files += [(os.POSIX_SPAWN_CLOSE, stdout), (os.POSIX_SPAWN_CLOSE, stderr)]
    ignored = [signal.SIGPIPE, signal.SIGXFSZ, signal.SIGTERM]  # by Python, or by who started the campaign
    return os.posix_spawnp(command[0], command, os.environ, file_actions=files, setpgroup=0, setsigdef=ignored)


def _say(line: str) -> None:
    try:
        os.write(1, f"{line}\n".encode())
    except OSError:
        pass  # the campaign was killed


def _reap(statuses: dict[int, int]) -> bool:
    """Collect the children that have ended; return whether no child is left."""
    try:
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return False
            statuses[pid] = status
    except ChildProcessError:
        return True


def _end(child: int, statuses: dict[int, int]) -> None:
    """Kill all descendants repeatedly, because the children of a killed process become children of this one."""
    spared: set[int] = set()
    attempts = 200  # if only processes are left that cannot be killed because they belong to another user
    while not _reap(statuses) and attempts:
        left = _left(child)
        attempts -= left <= spared
        spared |= _signal(left, signal.SIGKILL)
        time.sleep(0.005)
    if not _LINUX:
        try:
            os.killpg(child, signal.SIGKILL)
        except OSError:
            pass  # no process of the group is left


def _left(child: int) -> set[int]:
    return _descendants(os.getpid()) if _LINUX else {-child}


def _signal(pids: set[int], number: int) -> set[int]:
    """Signal processes; return those that belong to another user."""
    spared = set()
    for pid in pids:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            pass
        except PermissionError:
            spared.add(pid)
    return spared


def _descendants(ancestor: int) -> set[int]:
    children: dict[int, list[int]] = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/stat", "rb") as file:
                # The state and the parent follow the name, which may contain blanks and brackets.
                parent = int(file.read().rpartition(b")")[2].split()[1])
        except OSError:
            continue  # the process has ended
        children.setdefault(parent, []).append(int(name))
    descendants: set[int] = set()
    waiting = [ancestor]
    while waiting:
        new = set(children.get(waiting.pop(), ())) - descendants
        descendants |= new
        waiting.extend(new)
    return descendants


if __name__ == "__main__":
    main()
