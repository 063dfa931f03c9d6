"""The state of the page: the trials, the work in progress, the verdict and the pictures."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from typing import Any

from ctxval._util.progress import Listener, Progress
from ctxval._util.progress_display import amount
from ctxval.certificates import Certificate, Verdict
from ctxval.web.jobs import Files, Pictures
from ctxval.web.served import ServedCampaign, Snapshot


@dataclass(frozen=True)
class Work:
    """Work that is not done yet: its progress, its start, and that of the present stage."""

    progress: Progress
    started: float
    reached: float

    @staticmethod
    def begun(stage: str) -> Work:
        """Return work that begins now."""
        now = time.monotonic()
        return Work(Progress(stage, 0, None, ""), now, now)

    def at(self, progress: Progress) -> Work:
        """Return the same work at a later stage, or at the same one with another count."""
        same = progress.stage == self.progress.stage
        return replace(self, progress=progress, reached=self.reached if same else time.monotonic())

    def to_json(self) -> dict[str, Any]:
        """Return the stage in words, how much of it is done, and the whole seconds since the start."""
        now, progress = time.monotonic(), self.progress
        counted = amount(progress, now - self.reached)
        text = f"{progress.stage}, {counted}" if counted else progress.stage
        return {"text": text, "done": progress.done, "expected": progress.expected, "seconds": int(now - self.started)}


class PageState:
    """What the page shows, for any number of browsers. All of it belongs to the event loop of the server.

    Attributes:
        served: the campaign, of which only what does not change may be read here.
        live: whether a command executes the tasks, so that the page only shows them.
        choosing, judging: present work.
        enough: whether the last choice found that the verdict is reached or the budget is spent.
        chosen: the number of the trial that was opened last from this page.
        certificate: the certificate of a campaign without a threshold, which has no verdict.
        judged: the trials that the verdict is about, as :attr:`Snapshot.ended`.
        files: the files of open trials by number; a text says why there are none.
        interval: the largest executed distance and a preliminary bound, while a command executes the tasks.
        outcome: how the command that executed the tasks has ended.
        version: a number that grows with each change, also when the server is started again.
        shown: the version that was last sent to a browser.
    """

    live = False
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

    def __init__(self, served: ServedCampaign, snapshot: Snapshot) -> None:
        self.served, self.snapshot = served, snapshot
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

    async def events(self) -> AsyncIterator[str]:
        """Yield an event with the version of the page after each change, or with the work in progress.

        A comment now and then shows that the connection is there.
        """
        seen = None
        self.listeners += 1
        try:
            while not self._closing:
                changed = self._changed
                both = {"choosing": self.choosing, "judging": self.judging}
                if seen != self.version:
                    seen = self.version
                    yield f"event: version\ndata: {seen}\n\n"
                elif present := {name: work.to_json() for name, work in both.items() if work is not None}:
                    yield f"event: work\ndata: {json.dumps(present)}\n\n"
                else:
                    yield ": the server is there\n\n"
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(15):
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

    def _follow_progress(self, kind: str) -> Listener:
        """Return a listener for another thread, which shows how far choosing or judging is."""

        def hear(progress: Progress) -> None:
            self._loop.call_soon_threadsafe(self._progressed, kind, progress)

        return hear

    def _progressed(self, kind: str, progress: Progress) -> None:
        work: Work | None = getattr(self, kind)
        if work is not None:
            setattr(self, kind, work.at(progress))
            self.version += progress.stage != work.progress.stage
            self._notify()

    def _spawn(self, work: Any) -> asyncio.Task[Any]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task
