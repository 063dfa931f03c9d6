"""Work on all cores of this computer, and interruptions of an execution."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn, TypeVar

from ctxval._util.progress import advance, mute

Part = TypeVar("Part")
Result = TypeVar("Result")

_inherited: Callable[[Any], Any]


def on_all_cores(function: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Return the result of a function for each part, in the order of the parts; in parallel if processes can be forked.

    The child processes inherit the function, so it need not be picklable; the parts and the results must be.
    """
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
    """Return whether the handler of a signal that ends processes raised an exception, rather than the code itself.

    A handler that raises an ordinary exception, for instance that of an alarm, belongs to the code.
    """
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
