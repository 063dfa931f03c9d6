"""Progress on a screen or in a notebook; in a log, a line for each note and for what takes very long."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ctxval._util.progress import Progress, ignore, is_heard, listening
from ctxval._util.texts import shortened, visible

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.progress import Progress as Bars

_DELAY = 0.4  # seconds before a stage is shown; most end sooner


@contextmanager
def progress_shown(wanted: bool | None = None, console: Console | None = None) -> Iterator[None]:
    """Show the progress of everything within this context on standard error."""
    if is_heard() and wanted is not False:
        yield
        return
    if wanted is None:
        wanted = is_screen()
    if not wanted:
        with listening(ignore):
            yield
        return
    from rich.console import Console  # slow to load, and needed by few programs

    screen = Console(stderr=True, markup=False, emoji=False, highlight=False) if console is None else console
    with listening(OnScreen(screen) if screen.is_terminal or screen.is_jupyter else InLog(screen)):
        yield


def is_screen() -> bool:
    """Return whether people see what is printed at once: at a terminal or in a notebook."""
    return bool(sys.stderr is not None and sys.stderr.isatty()) or "ipykernel" in sys.modules


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
    """Shows one bar for each stage while it lasts. Notes stay on the screen, one line for each."""

    def __init__(self, console: Console) -> None:
        self._bars = _bars(console)
        self._rows: dict[int, Any] = {}

    def __call__(self, progress: Progress) -> None:
        bars = self._bars
        if not self._rows:
            bars.start()
        if progress.note:
            bars.console.print(_in_one_line(progress.note), soft_wrap=True, markup=False, highlight=False)
        if progress.depth not in self._rows:
            self._rows[progress.depth] = bars.add_task(progress.stage, text="")
        row = self._rows[progress.depth]
        elapsed = bars.tasks[bars.task_ids.index(row)].elapsed or 0.0
        bars.update(row, completed=progress.done, total=progress.expected, text=amount(progress, elapsed))
        if progress.ended:
            bars.remove_task(self._rows.pop(progress.depth))
            if not self._rows:
                bars.stop()


def _bars(console: Console) -> Bars:
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    class Delayed(Bars):
        def get_renderables(self) -> Iterable[RenderableType]:
            yield self.make_tasks_table([task for task in self.tasks if (task.elapsed or 0.0) > _DELAY])

    return Delayed(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[text]}", markup=False),
        TimeElapsedColumn(),
        console=console,
        transient=True,
    )


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
