"""Parallel evaluation of a plain function on all cores of this computer."""

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
