"""The state of the page, and everything that changes it. All of it runs in the event loop of the server."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import AsyncIterator
from dataclasses import dataclass, field, replace
from typing import Any

from ctxval.campaign.telling import ToldResult
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError, InputError
from ctxval.web import jobs
from ctxval.web.background import BackgroundProcess, Job, Stage
from ctxval.web.desk import Desk, Snapshot
from ctxval.web.jobs import Files, Judgement, Pictures, TaskRequest
from ctxval.web.served import OpenCampaign

_POLL = 1.0
"""Seconds between two looks at a store that other processes may change."""

_HEARTBEAT = 15.0
"""Seconds after which a listener hears something, so that a lost connection is noticed."""

_REMEMBERED = 1_000
"""Number of submitted forms that are remembered, to recognise a form that is sent twice."""


@dataclass(frozen=True)
class Work:
    """Work of a background process that is not done yet.

    Attributes:
        stage: what it does at present.
        started: the time of its start, on the clock of ``time.monotonic``.
        reached: the time of the start of the stage.
        counted: the time at which the stage told how much is done.
    """

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


@dataclass(frozen=True, eq=False)
class Background:
    """What the background processes have found, and what they do.

    Attributes:
        choosing, judging: present work; None if there is none.
        choice_error: why the last choice failed; None if it did not.
        enough: whether the last choice found that the verdict is reached or the budget is spent.
        chosen: the number of the trial that was opened last from this page; None if none was.
        judgement: the last verdict; None if there is none.
        judged: the trials that it is about, as :attr:`Snapshot.ended`.
        judgement_error: why it failed; None if it did not.
        pictures: the last pictures.
        files: the files of open trials by number; a text says why there are none.
        store_error: why the store cannot be read at present; None if it can.
    """

    choosing: Work | None = None
    judging: Work | None = None
    choice_error: str | None = None
    enough: bool = False
    chosen: int | None = None
    judgement: Judgement | None = None
    judged: tuple[int, int] | None = None
    judgement_error: str | None = None
    pictures: Pictures = field(default_factory=Pictures)
    files: dict[int, Files | str] = field(default_factory=dict)
    store_error: str | None = None


class CampaignService:
    """One campaign, with the work in progress, for any number of operators.

    Args:
        desk: the server's own campaign.
        reopen: opens the campaign in a child process; it must be picklable.

    Attributes:
        description: what does not change.
        snapshot: the trials as they were last read.
        background: what the background processes have found.
        version: a number that grows with each change, also when the server is started again.
    """

    def __init__(self, desk: Desk, reopen: OpenCampaign) -> None:
        self._desk = desk
        self.description, self.snapshot = desk.description, desk.first
        self.background = Background()
        self.version = time.time_ns()  # it grows when the server is started again, too
        self._changed = asyncio.Event()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._preparing: dict[int, asyncio.Task[None]] = {}
        self._submitted: OrderedDict[str, int] = OrderedDict()
        self._telling = asyncio.Lock()
        self._closing = False
        self._chooser = BackgroundProcess(reopen, lambda stage: self._told("choosing", stage))
        self._judge = BackgroundProcess(reopen, lambda stage: self._told("judging", stage))

    async def start(self) -> None:
        """Start the background processes and the observation of the store."""
        self._loop = asyncio.get_running_loop()
        self._spawn(self._background(self._chooser, jobs.warm_up))
        self._follow()
        self._spawn(self._watch())

    async def stop(self) -> None:
        """End all work in progress, and close everything."""
        self.end_events()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._loop.run_in_executor(None, self.close)

    def close(self) -> None:
        """End the background processes, and close the store, at once; a second call does nothing."""
        for part in (self._chooser, self._judge, self._desk):
            part.close()

    # What operators do

    def choose(self, request: TaskRequest) -> None:
        """Start to choose the next task."""
        if self.background.choosing is not None:
            raise InputError("a task is already being chosen.")
        if request.trials is not None and request.trials != len(self.snapshot.trials):
            raise InputError(
                f"another task was opened since this page was loaded, as trial {len(self.snapshot.trials) - 1}. If you "
                "need one more task, ask again."
            )
        self._update(choosing=Work.begun("choosing a task"), choice_error=None, chosen=None, enough=False)
        self._spawn(self._choose(request))

    async def tell(self, number: int, told: ToldResult, submission: str) -> Trial:
        """Record the result of an open trial, or replace an earlier result, once for each submitted form."""
        async with self._telling:
            if not submission or self._submitted.get(submission) != number:
                try:
                    await self._desk.tell(number, told)
                finally:
                    await self._look()
                self._submitted[submission] = number
                if len(self._submitted) > _REMEMBERED:
                    self._submitted.popitem(last=False)
            return self.snapshot.trials[number]

    async def files(self, number: int) -> Files:
        """Return the files of an open trial, after they are prepared."""
        if number in self._preparing:
            await asyncio.shield(self._preparing[number])
        found = self.background.files.get(number)
        if isinstance(found, dict):
            return found
        raise InputError(found or f"trial {number} is not open, so there are no files of it.")

    # What operators see

    async def events(self) -> AsyncIterator[tuple[str, Any]]:
        """Yield the version of the page after each change, the work in progress, and now and then a heartbeat."""
        seen = None
        while not self._closing:
            changed = self._changed
            if seen != self.version:
                seen = self.version
                yield "version", seen
            else:
                both = {"choosing": self.background.choosing, "judging": self.background.judging}
                work = {name: one for name, one in both.items() if one is not None}
                yield ("work", work) if work else ("heartbeat", None)
            try:
                async with asyncio.timeout(_HEARTBEAT):
                    await changed.wait()
            except TimeoutError:
                continue

    def end_events(self) -> None:
        """Let all listeners end, because the server stops."""
        self._closing = True
        self._notify()

    # Changes

    def _update(self, **changes: Any) -> None:
        self.background = replace(self.background, **changes)
        self.version += 1
        self._notify()

    def _notify(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    def _told(self, kind: str, stage: Stage) -> None:
        """Take a stage from the thread of a background process."""
        self._loop.call_soon_threadsafe(self._set_stage, kind, stage)

    def _set_stage(self, kind: str, stage: Stage) -> None:
        work: Work | None = getattr(self.background, kind)
        if work is None:
            return
        counts = stage.text == work.stage.text
        changes: dict[str, Any] = {kind: work.at(stage)}
        self.background = replace(self.background, **changes)
        self.version += not counts
        self._notify()

    def _spawn(self, work: Any) -> asyncio.Task[Any]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _background(self, process: BackgroundProcess, job: Job, *arguments: Any) -> Any:
        return await asyncio.wrap_future(process.submit(job, *arguments))

    async def _choose(self, request: TaskRequest) -> None:
        try:
            found = await self._background(self._chooser, jobs.choose, request)
        except CtxvalError as error:
            self._update(choosing=None, choice_error=str(error))
        else:
            number, files = found or (None, {})
            kept = self.background.files if number is None else {**self.background.files, number: files}
            self._update(choosing=None, chosen=number, enough=found is None, files=kept)
        await self._look()

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(_POLL)
            try:
                if await self._desk.signature() == self.snapshot.signature and self.background.store_error is None:
                    continue
            except CtxvalError:
                pass  # looking again says why
            await self._look()

    async def _look(self) -> None:
        """Read the store; if it has changed, bring everything else up to date."""
        try:
            found = await self._desk.snapshot()
        except CtxvalError as error:
            if self.background.store_error != str(error):
                self._update(store_error=str(error))
            return
        if self.background.store_error is not None:
            self._update(store_error=None)
        if not _same(found, self.snapshot):
            self.snapshot = found
            self._follow()
            self._update(enough=False)

    def _follow(self) -> None:
        """Prepare the files of open trials, forget those of others, and judge the trials that have ended."""
        waiting = {trial.number for trial in self.snapshot.waiting if not trial.attempts}
        files = self.background.files
        self.background = replace(self.background, files={n: kept for n, kept in files.items() if n in waiting})
        for number in waiting - set(files) - set(self._preparing):
            self._preparing[number] = self._spawn(self._prepare(number))
        if self.background.judging is None and self.background.judged != self.snapshot.ended:
            self.background = replace(self.background, judging=Work.begun("drawing the pictures"))
            self._spawn(self._evaluate())

    async def _prepare(self, number: int) -> None:
        found: Files | str
        try:
            found = await self._background(self._chooser, jobs.files_of, number)
        except CtxvalError as error:
            found = str(error)
        finally:
            self._preparing.pop(number, None)
        if any(trial.number == number for trial in self.snapshot.waiting):
            self._update(files={**self.background.files, number: found})

    async def _evaluate(self) -> None:
        """Draw and judge until the results are those of the present trials."""
        while self.background.judged != self.snapshot.ended:
            ended = self.snapshot.ended
            try:
                self._update(pictures=await self._background(self._judge, jobs.draw))
                judgement = await self._background(self._judge, jobs.judge)
            except CtxvalError as error:
                self._update(judged=ended, judgement=None, judgement_error=str(error))
            else:
                self._update(judged=ended, judgement=judgement, judgement_error=None)
        self._update(judging=None)


def _same(one: Snapshot, other: Snapshot) -> bool:
    """Return whether two snapshots show the same; an execution that starts changes no signature."""
    states = [[(trial.state, trial.attempts) for trial in each.trials] for each in (one, other)]
    return one.signature == other.signature and states[0] == states[1]
