"""The state of the page: the trials, the work in progress, the verdict and the pictures.

A command that executes a campaign gives its page what it shows; that page takes nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import threading
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, replace
from typing import Any

from ctxval._util.progress import Listener, Progress, amount
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.certificates import Certificate, Verdict
from ctxval.core.trial import Trial
from ctxval.web.jobs import Files, Interval, Pictures, ServedCampaign, Snapshot, pictures_of


@dataclass(frozen=True)
class Work:
    """Work that is not done yet: its progress, its start, and that of the present stage."""

    progress: Progress
    started: float
    reached: float

    @staticmethod
    def begun(stage: str) -> Work:
        now = time.monotonic()
        return Work(Progress(stage, 0, None, ""), now, now)

    def at(self, progress: Progress) -> Work:
        """Return the same work at a later stage, or at the same one with another count."""
        same = progress.stage == self.progress.stage
        return replace(self, progress=progress, reached=self.reached if same else time.monotonic())

    def to_json(self) -> dict[str, Any]:
        now, progress = time.monotonic(), self.progress
        counted = amount(progress, now - self.reached)
        text = f"{progress.stage}, {counted}" if counted else progress.stage
        return {"text": text, "done": progress.done, "expected": progress.expected, "seconds": int(now - self.started)}


class Innermost:
    """Sends the innermost stage of long work to a listener, and not more than five times a second if it only counts."""

    def __init__(self, send: Listener) -> None:
        self._send, self._stage, self._at = send, "", 0.0
        self._running: dict[int, Progress] = {}

    def __call__(self, progress: Progress) -> None:
        if progress.ended:
            self._running.pop(progress.depth, None)
        else:
            self._running[progress.depth] = progress
        if not self._running:
            return
        innermost, now = self._running[max(self._running)], time.monotonic()
        if innermost.stage != self._stage or now - self._at >= 0.2:
            self._stage, self._at = innermost.stage, now
            self._send(innermost)


class PageState:
    """What the page shows; it belongs to the event loop, so only what never changes of a campaign is read here."""

    live = False  # whether a command executes the tasks, so that the page only shows them
    choosing: Work | None = None
    judging: Work | None = None
    choice_error: str | None = None
    enough: bool = False  # whether the last choice found that the verdict is reached or the budget is spent
    chosen: int | None = None  # the trial that was opened last from this page
    verdict: Verdict | None = None
    certificate: Certificate | None = None  # of a campaign without a threshold, which has no verdict
    judged: tuple[int, int] | None = None  # the trials that the verdict is about, as Snapshot.ended
    judgement_error: str | None = None
    store_error: str | None = None
    interval: str | None = None  # the largest executed distance and a preliminary bound, of a command
    outcome: str | None = None  # how the command that executed the tasks has ended

    def __init__(self, served: ServedCampaign, snapshot: Snapshot) -> None:
        self.served, self.snapshot = served, snapshot
        self.pictures: Pictures = {}
        self.history: tuple[Interval, ...] = ()  # how the interval of the largest distance closed, since the start
        self.files: dict[int, Files | str] = {}  # of open trials; a text says why there are none
        self.input_differences: dict[int, str | None] = {}  # of the recordings that were told here
        self.version = time.time_ns()  # which grows with each change, also when the server is started again
        self.listeners = self.shown = 0  # open pages, and the version that was last sent to one
        self._changed = asyncio.Event()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._closing = False

    async def start(self) -> None:
        self._loop = asyncio.get_running_loop()

    async def stop(self) -> None:
        self.end_events()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def events(self) -> AsyncIterator[str]:
        """Yield an event with the version of the page after each change, or the work in progress, or a comment."""
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

    def post(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call a function in the event loop of the server; any thread may call this."""
        self._loop.call_soon_threadsafe(function, *arguments)

    def end_events(self) -> None:
        self._closing = True
        self._notify()

    def update(self, **changes: Any) -> None:
        vars(self).update(changes)
        self.version += 1
        self._notify()

    def _notify(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

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


class LiveCampaign(PageState):
    """The state of a campaign that this process executes in another thread, by a search unless the campaign explores.

    The thread of the campaign calls ``hear``, :meth:`take` and :meth:`end`; the rest belongs to the server.
    """

    live = True

    def __init__(self, served: ServedCampaign, search: IntervalSearch | None) -> None:
        super().__init__(served, Snapshot(served.campaign.trials))
        self._search = search
        self.hear = Innermost(functools.partial(self.post, self._progressed, "choosing"))
        self._drawn = self._cost = 0.0
        self.started = threading.Event()

    async def start(self) -> None:
        await super().start()
        self._spawn(self._watch())
        self.started.set()

    # In the thread of the campaign

    def take(self, trial: Trial) -> None:
        """Show the interval and the pictures after a trial has ended."""
        changes: dict[str, Any] = {}
        if self._search is not None:
            low, high = self._search.interval
            bound = "not known yet" if high is None else f"{high:.4g}"
            changes["interval"] = f"from {low:.4g} to {bound} {self.served.experiment.units}".rstrip()
            changes["history"] = self.history = (*self.history, Interval(self.served.campaign.executions, low, high))
        begun = time.monotonic()
        if begun - self._drawn >= 10 * self._cost:  # pictures take at most about a tenth of the time
            changes["pictures"] = pictures_of(self.served)
            self._drawn = time.monotonic()
            self._cost = self._drawn - begun
        self.post(lambda: self.update(**changes))

    def end(self, verdict: Verdict | None, certificate: Certificate | None, report: str | None) -> None:
        outcome = "the campaign has ended, and so will this page" + (f". The report is {report}" if report else "")
        shown = {"verdict": verdict, "certificate": certificate, "pictures": pictures_of(self.served)}
        self.post(lambda: self.update(**shown, choosing=None, interval=None, outcome=outcome))

    def wait_until_seen(self) -> None:
        """Give open pages time to load the last state: until one has, at most 5 s, and a moment for the others."""
        end = time.monotonic() + 5
        while self.listeners and time.monotonic() < end and (self.outcome is None or self.shown < self.version):
            time.sleep(0.05)
        if self.listeners:
            time.sleep(0.5)

    # In the event loop of the server

    def _progressed(self, kind: str, progress: Progress) -> None:
        if self.outcome is not None:
            return
        if self.choosing is None or self.choosing.progress.stage != progress.stage:
            self.update(choosing=Work.begun(progress.stage))
        super()._progressed(kind, progress)

    async def _watch(self) -> None:
        while True:
            fresh = Snapshot(self.served.campaign.trials)
            if fresh.signature != self.snapshot.signature or fresh.trials.executions != self.snapshot.trials.executions:
                self.snapshot = fresh
                self.update()
            await asyncio.sleep(0.5)
