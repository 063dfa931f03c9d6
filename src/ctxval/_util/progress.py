"""Reports of long work to whoever listens: what is being done, how much of it is done, and how much is expected.

Long work is a stage, and whatever does it advances the innermost stage. Neither knows who listens. If nobody does, a
report costs a look at one variable. A listener belongs to the thread that it was set in.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ctxval._util.texts import shortened, visible

if TYPE_CHECKING:
    from rich.console import Console, RenderableType


@dataclass(frozen=True)
class Progress:
    """How far a stage is: what is being done, how much of it, of how much if that is known, in which unit."""

    stage: str
    done: float
    expected: float | None
    unit: str
    note: str = ""  # a sentence about what has just been done
    depth: int = 0  # the number of stages that this one is a part of
    ended: bool = False  # true in the last report of a stage


Listener = Callable[[Progress], None]  #: called with each report; it should return soon


@dataclass
class _Stage:
    listener: Listener
    name: str = ""
    expected: float | None = None
    unit: str = ""
    done: float = 0
    depth: int = -1  # that of a listener, outside of all stages

    def report(self, note: str = "", *, ended: bool = False) -> None:
        # An estimate that was too small is none any more.
        expected = None if self.expected is None or self.done > self.expected else self.expected
        self.listener(Progress(self.name, self.done, expected, self.unit, note, self.depth, ended))


_innermost: ContextVar[_Stage | None] = ContextVar("innermost", default=None)  # None if nobody listens


def is_heard() -> bool:
    return _innermost.get() is not None


@contextmanager
def listening(listener: Listener | None) -> Iterator[None]:
    """Send all reports within this context to a listener; None lets nobody listen."""
    token = _innermost.set(None if listener is None else _Stage(listener))
    try:
        yield
    finally:
        _innermost.reset(token)


def also_listening(listener: Listener) -> AbstractContextManager[None]:
    outer = _innermost.get()

    def both(progress: Progress) -> None:
        if outer is not None:
            outer.listener(progress)
        listener(progress)

    return listening(both)


def mute() -> None:
    """Let nobody listen from now on, as in a forked process, whose listener is that of its parent."""
    _innermost.set(None)


@contextmanager
def stage(name: str, expected: float | None = None, unit: str = "", done: float = 0) -> Iterator[None]:
    """Report that long work begins, and its end."""
    outer = _innermost.get()
    if outer is None:
        yield
        return
    begun = _Stage(outer.listener, name, expected, unit, done, outer.depth + 1)
    token = _innermost.set(begun)
    try:
        begun.report()
        yield
    finally:
        _innermost.reset(token)
        begun.report(ended=True)


def advance(count: float = 1, note: str = "", units: Collection[str] | None = None) -> None:
    """Report that so much more of the innermost stage is done; with units, only if it counts in one of these."""
    current = _innermost.get()
    if current is not None and current.depth >= 0 and (units is None or current.unit in units):
        current.done += count
        current.report(note)


def expect(expected: float) -> None:
    current = _innermost.get()
    if current is not None and current.depth >= 0:
        current.expected = expected
        current.report()


@contextmanager
def progress_shown(wanted: bool | None = None, console: Console | None = None, delay: float = 0.4) -> Iterator[None]:
    """Show the progress of everything within this context on standard error, of stages after some seconds."""
    if _innermost.get() is not None and wanted is not False:
        yield
        return
    if wanted is None:
        # People see what is printed at once at a terminal or in a notebook.
        wanted = bool(sys.stderr is not None and sys.stderr.isatty()) or "ipykernel" in sys.modules
    if not wanted:
        with listening(lambda _: None):  # so that nothing inside shows it either
            yield
        return
    from rich.console import Console  # slow to load, and needed by few programs

    screen = Console(stderr=True, markup=False, emoji=False, highlight=False) if console is None else console
    with listening(OnScreen(screen, delay) if screen.is_terminal or screen.is_jupyter else InLog(screen)):
        yield


class InLog:
    """Prints each note, and after 30 s without one the amount of the present stage."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last = time.monotonic()
        self._started: dict[int, float] = {}

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        self._started.setdefault(progress.depth, now)
        if progress.note or (now - self._last > 30 and not progress.ended):
            self._last = now
            text = progress.note or f"{progress.stage}: {amount(progress, now - self._started[progress.depth])}"
            self._console.print(_in_one_line(text), soft_wrap=True)
        if progress.ended:
            del self._started[progress.depth]


class OnScreen:
    """Shows one bar for each stage that lasts longer. Notes stay on the screen, one line for each."""

    def __init__(self, console: Console, delay: float) -> None:
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bars

        class Delayed(Bars):
            def get_renderables(self) -> Iterable[RenderableType]:
                yield self.make_tasks_table([task for task in self.tasks if (task.elapsed or 0.0) > delay])

        name, amount = (TextColumn(f"{{task.{part}}}", markup=False) for part in ("description", "fields[text]"))
        columns = name, BarColumn(bar_width=20), amount, TimeElapsedColumn()
        self._bars = Delayed(*columns, console=console, transient=True)
        self._rows: dict[int, Any] = {}

    def __call__(self, progress: Progress) -> None:
        bars = self._bars
        if not self._rows:
            bars.start()
        if progress.note:
            bars.console.print(_in_one_line(progress.note), soft_wrap=True, markup=False, highlight=False)
        if progress.depth not in self._rows:
            self._rows[progress.depth] = bars.add_task(progress.stage, total=None, text="")
        row = self._rows[progress.depth]
        task = bars.tasks[bars.task_ids.index(row)]
        task.total = progress.expected  # an update would keep an estimate that was too small
        bars.update(row, completed=progress.done, text=amount(progress, task.elapsed or 0.0))
        task.finished_time = None  # its clock runs until the stage ends
        if progress.ended:
            bars.remove_task(self._rows.pop(progress.depth))
            if not self._rows:
                bars.stop()


def _in_one_line(text: str) -> str:
    return visible(" ".join(shortened(text).splitlines()))


def amount(progress: Progress, elapsed: float) -> str:
    """Return how much of a stage is done, and how many seconds are left if that can be told."""
    if progress.expected is None:
        return f"{progress.done:,.0f} {progress.unit}".strip() if progress.done else ""
    text = f"{progress.done:,.0f}/{progress.expected:,.0f} {progress.unit}".strip()
    # The first parts may take longer than others.
    early = progress.done < 0.1 * progress.expected and elapsed < 60
    if early or not progress.done or progress.ended or progress.note:
        return text
    return f"{text}, {duration(elapsed * (progress.expected - progress.done) / progress.done)} left"


def duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
