"""A plain function over all cores of this computer."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")

_inherited: Callable[[Any], Any]


def on_all_cores(function: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Return what a function makes of each part, in their order, many at a time where processes can be forked.

    The function is inherited and need not be picklable; the parts and the results must be.
    """
    workers = min(_cores(), len(parts))
    if workers < 2 or not can_fork():
        return [function(part) for part in parts]
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _inherit, (function,))
    try:
        with pool, forking():
            return list(pool.map(_call, parts))
    except BrokenProcessPool:  # what ends a process may do so for want of memory
        return [function(part) for part in parts]


def can_fork() -> bool:
    """Return whether a process can be forked without harm: a child then inherits what cannot be pickled."""
    return sys.platform == "linux" and "fork" in multiprocessing.get_all_start_methods()


@contextmanager
def forking() -> Iterator[None]:
    """Start processes without a warning of the thread that a progress display has."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _inherit(function: Callable[[Any], Any]) -> None:
    global _inherited
    # Ctrl-C reaches every process of a terminal; what it ends is decided by the campaign.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _inherited = function


def _call(part: Any) -> Any:
    return _inherited(part)
