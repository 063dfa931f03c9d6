"""Processes: work on all cores, interruptions of an execution, and limits of what reads a file of a stranger.

The file may attack libraries in C, which have faults. On Linux, Landlock takes away all rights to open files, except
those that are named, and to use the network (https://docs.kernel.org/userspace-api/landlock.html). The limits hold for
the rest of the life of the process.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar

from ctxval._util.progress import advance, mute

Part = TypeVar("Part")
Result = TypeVar("Result")

_inherited: Callable[[Any], Any]


def on_all_cores(function: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Return a function's results for parts in order; forked processes, if there are any, inherit the function."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = min(cores, len(parts))
    if workers < 2 or not can_fork():
        return [function(part) for part in parts]
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _inherit, (function,))
    try:
        with pool, forking():
            results = []
            for result in pool.map(_call, parts):
                results.append(result)
                advance()
            return results
    except BrokenProcessPool:  # the system may have ended a process because memory was short
        return [function(part) for part in parts]


def can_fork() -> bool:
    """Return whether a process can be forked safely; a forked child inherits objects that cannot be pickled."""
    return sys.platform == "linux" and "fork" in multiprocessing.get_all_start_methods()


@contextmanager
def forking() -> Iterator[None]:
    """Suppress Python's warning about forking while threads run; a progress display has a thread."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def _inherit(function: Callable[[Any], Any]) -> None:
    global _inherited
    # Ctrl-C reaches every process of a terminal, but the campaign alone decides what ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    mute()
    _inherited = function


def _call(part: Any) -> Any:
    return _inherited(part)


class Interrupts:
    """A context in which the first SIGINT waits for the end of shielded code, and a second one stops at once.

    It has an effect only in the main thread, and only if no other handler of SIGINT is installed. After the first
    SIGINT it is ``asked``: the running executions are the last ones.
    """

    def __init__(self) -> None:
        self.asked = False
        self._shielded = False
        self._installed = False

    def __enter__(self) -> Interrupts:
        in_main = threading.current_thread() is threading.main_thread()
        if in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._handle)
            self._installed = True
        return self

    def __exit__(self, *_: object) -> None:
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _handle(self, _signal: int, _frame: FrameType | None) -> None:
        if self.asked or not self._shielded:
            self.asked = True
            raise KeyboardInterrupt
        self.asked = True
        self.announce()

    def announce(self) -> None:
        sys.stderr.write("\nending after the running executions; press Ctrl-C again to stop at once\n")

    @contextmanager
    def shielded(self, shielded: bool = True) -> Iterator[None]:
        """Shield code, or let a SIGINT stop a part of shielded code at once."""
        before, self._shielded = self._shielded, shielded
        try:
            yield
        finally:
            self._shielded = before


def raised_by_signal(error: BaseException) -> bool:
    """Return whether the handler of a signal that ends processes raised an exception, and not the code itself."""
    if isinstance(error, Exception):
        return False
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK", "SIGUSR1", "SIGUSR2")  # the last two preempt jobs of clusters
    ending = [getattr(signal, name) for name in names if hasattr(signal, name)]
    handlers = [signal.getsignal(number) for number in ending]
    codes = {getattr(getattr(handler, "__func__", handler), "__code__", None) for handler in handlers}
    if any(frame.f_code in codes for frame, _ in traceback.walk_tb(error.__traceback__)):
        return True
    # Python's own handler has no frame.
    in_main = threading.current_thread() is threading.main_thread()
    default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return isinstance(error, KeyboardInterrupt) and in_main and default


_leave = os._exit


def allow_exits() -> None:
    """Let ``os._exit`` end this process again, although it may be inside `exits_as_exceptions`."""
    os._exit = _leave


@contextmanager
def exits_as_exceptions() -> Iterator[None]:
    """Turn ``os._exit`` of this process into an exception; forked processes may exit. Restore the recursion limit."""
    ours, leave, depth = os.getpid(), os._exit, sys.getrecursionlimit()

    def refuse(status: int) -> NoReturn:
        if os.getpid() != ours:
            leave(status)
        raise SystemExit(f"os._exit({status!r})")

    os._exit = refuse
    try:
        yield
    finally:
        os._exit = leave
        sys.setrecursionlimit(depth)


MOST_MEMORY = 4 * 2**30  # bytes of a confined process; libraries reserve more than they use

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # system calls, with the same numbers on all processors
_NO_NEW_PRIVILEGES = 38
_EXECUTE, _READ_FILE, _READ_FOLDER = 1 << 0, 1 << 2, 1 << 3


def limit(seconds: int) -> None:
    """Limit memory, processor time, the sizes of written files and the number of open ones, where the system can."""
    if sys.platform == "win32":
        return
    import resource

    limits = {"AS": MOST_MEMORY, "CPU": seconds, "FSIZE": 2**30, "NOFILE": 256, "CORE": 0}
    for name, most in limits.items():
        with contextlib.suppress(OSError, ValueError):  # the limit is lower already, or this system has none
            resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (most, most))


def may_confine() -> bool:
    """Return whether this system can take rights away from a process."""
    return sys.platform == "linux" and bool(_libc().syscall(_CREATE, None, 0, 1) > 0)


def read_only(paths: Iterable[Path]) -> None:
    """Let this process open nothing but these files, those in these folders and the libraries, only for reading."""
    if not may_confine():
        return
    libc, version = _libc(), _libc().syscall(_CREATE, None, 0, 1)
    every_right = (1 << 13) - 1 | (version >= 3) << 14  # from version 3 on, also to truncate
    network = 3 if version >= 4 else 0
    rules = (ctypes.c_uint64 * 2)(every_right, network)
    ruleset = libc.syscall(_CREATE, rules, 16 if network else 8, 0)
    # Python's and the system's libraries; never a folder that contains the user's home.
    system = ("/usr", "/lib", "/lib64", "/nix/store", "/etc/ld.so.cache", "/dev/null", "/dev/urandom", "/proc/cpuinfo")
    home = Path(os.path.expanduser("~")).resolve()
    libraries = (Path(name).resolve() for name in (*system, sys.prefix, sys.base_prefix, *sys.path))
    readable = (*paths, *(path for path in libraries if not home.is_relative_to(path)))
    for path in {path.resolve() for path in readable if path.exists()}:
        file = os.open(path, os.O_PATH)
        rights = _EXECUTE | _READ_FILE | (_READ_FOLDER if path.is_dir() else 0)
        rule = rights.to_bytes(8, sys.byteorder) + file.to_bytes(4, sys.byteorder)
        libc.syscall(_ADD, ruleset, 1, rule, 0)
        os.close(file)
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    if ruleset < 0 or libc.syscall(_RESTRICT, ruleset, 0):
        raise OSError(ctypes.get_errno(), "the rights of the process cannot be taken away")
    os.close(ruleset)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
