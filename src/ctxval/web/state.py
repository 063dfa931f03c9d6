"""The state of the page: the trials, the work in progress, the verdict and the pictures."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from typing import Any

from ctxval.certificates import Certificate, Verdict
from ctxval.web.background import Stage
from ctxval.web.jobs import Files, Pictures
from ctxval.web.served import Description, Snapshot


@dataclass(frozen=True)
class Work:
    """Work that is not done yet: its stage, and the starts of itself, of the stage and of its last count."""

    stage: Stage
    started: float
    reached: float
    counted: float

    @staticmethod
    def begun(stage: str) -> Work:
        """Return work that begins now."""
        now = time.monotonic()
        return Work(Stage(stage), now, now, now)

    def at(self, stage: Stage) -> Work:
        """Return the same work at a later stage, or at the same one with another count."""
        now = time.monotonic()
        reached = self.reached if stage.text == self.stage.text else now
        return replace(self, stage=stage, reached=reached, counted=now)

    @property
    def seconds(self) -> int:
        """Whole seconds since the start."""
        return int(time.monotonic() - self.started)

    @property
    def left(self) -> int | None:
        """Expected seconds until the end of the stage; None if they cannot be estimated."""
        done, expected = self.stage.done, self.stage.expected
        if expected is None or not 0 < done <= expected:
            return None
        left = (self.counted - self.reached) * (expected - done) / done - (time.monotonic() - self.counted)
        return max(round(left), 0)

    @property
    def text(self) -> str:
        """The stage, how much of it is done, and how long it takes, in words."""
        stage, unit = self.stage, f" {self.stage.unit}".rstrip()
        counted = "" if stage.expected is None else f", {stage.done:g} of {stage.expected:g}{unit}"
        return f"{stage.text}{counted}" + ("" if self.left is None else f", about {self.left} s left")


class PageState:
    """What the page shows, for any number of browsers. All of it belongs to the event loop of the server.

    Args:
        description: what does not change.
        snapshot: the trials at the start.

    Attributes:
        snapshot: the trials as they were last read.
        choosing, judging: present work; None if there is none.
        choice_error: why the last choice failed; None if it did not.
        enough: whether the last choice found that the verdict is reached or the budget is spent.
        chosen: the number of the trial that was opened last from this page; None if none was.
        verdict: the last verdict; None if there is none.
        certificate: the certificate of a campaign without a threshold, which has no verdict.
        judged: the trials that the verdict is about, as :attr:`Snapshot.ended`.
        judgement_error: why there is no verdict; None if there is no reason.
        pictures: the last pictures.
        files: the files of open trials by number; a text says why there are none.
        store_error: why the store cannot be read at present; None if it can.
        interval: the largest executed distance and a preliminary bound, while a command executes the tasks.
        outcome: how the command that executed the tasks has ended; None if it has not.
        version: a number that grows with each change, also when the server is started again.
        shown: the version that was last sent to a browser.
        listeners: the number of browsers that are kept up to date.
    """

    choosing: Work | None = None
    judging: Work | None = None
    choice_error: str | None = None
    enough: bool = False
    chosen: int | None = None
    verdict: Verdict | None = None
    certificate: Certificate | None = None
    judged: tuple[int, int] | None = None
    judgement_error: str | None = None
    store_error: str | None = None
    interval: str | None = None
    outcome: str | None = None

    def __init__(self, description: Description, snapshot: Snapshot) -> None:
        self.description, self.snapshot = description, snapshot
        self.pictures: Pictures = {}
        self.files: dict[int, Files | str] = {}
        self.version = time.time_ns()
        self.listeners = self.shown = 0
        self._changed = asyncio.Event()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._closing = False

    async def start(self) -> None:
        """Begin to follow the campaign."""
        self._loop = asyncio.get_running_loop()

    async def stop(self) -> None:
        """End all work in progress."""
        self.end_events()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def events(self) -> AsyncIterator[tuple[str, Any]]:
        """Yield the version of the page after each change, the work in progress, and now and then a heartbeat."""
        seen = None
        self.listeners += 1
        try:
            while not self._closing:
                changed = self._changed
                if seen != self.version:
                    seen = self.version
                    yield "version", seen
                else:
                    both = {"choosing": self.choosing, "judging": self.judging}
                    present = {name: work for name, work in both.items() if work is not None}
                    yield ("work", present) if present else ("heartbeat", None)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(15):  # a heartbeat then shows that the connection is there
                        await changed.wait()
        finally:
            self.listeners -= 1

    def end_events(self) -> None:
        """Let all listeners end, because the server stops."""
        self._closing = True
        self._notify()

    def update(self, **changes: Any) -> None:
        """Change what the page shows."""
        vars(self).update(changes)
        self.version += 1
        self._notify()

    def _notify(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    def _set_stage(self, kind: str, stage: Stage) -> None:
        work: Work | None = getattr(self, kind)
        if work is not None:
            setattr(self, kind, work.at(stage))
            self.version += stage.text != work.stage.text
            self._notify()

    def _spawn(self, work: Any) -> asyncio.Task[Any]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task
