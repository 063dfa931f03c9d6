"""Reports of long work to whoever listens: what is being done, how much of it is done, and how much is expected.

Long work is a stage, and whatever does it advances the innermost stage. Neither knows who listens. If nobody does, a
report costs a look at one variable. A listener belongs to the thread that it was set in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """How far a stage is: what is being done, how much of it, of how much if that is known, in which unit.

    The note is a sentence about what has just been done, the depth the number of stages that this one is a part of, and
    ``ended`` is true in the last report of a stage.
    """

    stage: str
    done: float
    expected: float | None
    unit: str
    note: str = ""
    depth: int = 0
    ended: bool = False


Listener = Callable[[Progress], None]
"""Called with each report; it should return soon."""


@dataclass
class _Stage:
    listener: Listener
    name: str
    expected: float | None
    unit: str
    done: float
    depth: int

    def report(self, note: str = "", *, ended: bool = False) -> None:
        # An estimate that was too small is none any more.
        expected = None if self.expected is None or self.done > self.expected else self.expected
        self.listener(Progress(self.name, self.done, expected, self.unit, note, self.depth, ended))


_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)
_innermost: ContextVar[_Stage | None] = ContextVar("innermost", default=None)


def is_heard() -> bool:
    return _listener.get() is not None


@contextmanager
def listening(listener: Listener | None) -> Iterator[None]:
    """Send all reports within this context to a listener; None lets nobody listen."""
    tokens = _listener.set(listener), _innermost.set(None)
    try:
        yield
    finally:
        _listener.reset(tokens[0])
        _innermost.reset(tokens[1])


@contextmanager
def also_listening(listener: Listener) -> Iterator[None]:
    outer = _listener.get() or ignore

    def both(progress: Progress) -> None:
        outer(progress)
        listener(progress)

    with listening(both):
        yield


def ignore(_: Progress) -> None:
    """Listen, and do nothing: nobody else is told."""


def mute() -> None:
    """Let nobody listen from now on, as in a forked process, whose listener is that of its parent."""
    _listener.set(None)
    _innermost.set(None)


@contextmanager
def stage(name: str, expected: float | None = None, unit: str = "", done: float = 0) -> Iterator[None]:
    """Report that long work begins, and its end."""
    listener = _listener.get()
    if listener is None:
        yield
        return
    outer = _innermost.get()
    begun = _Stage(listener, name, expected, unit, done, 0 if outer is None else outer.depth + 1)
    token = _innermost.set(begun)
    try:
        begun.report()
        yield
    finally:
        _innermost.reset(token)
        begun.report(ended=True)


def advance(count: float = 1, note: str = "") -> None:
    """Report that so much more of the innermost stage is done."""
    current = _innermost.get()
    if current is not None:
        current.done += count
        current.report(note)


def expect(expected: float) -> None:
    current = _innermost.get()
    if current is not None:
        current.expected = expected
        current.report()
