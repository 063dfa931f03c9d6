"""A campaign that people execute: what changes the state of its page, and the processes that choose, judge and draw."""

from __future__ import annotations

import asyncio
import concurrent.futures as cf
import contextlib
import functools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from ctxval._util.latest import Latest
from ctxval._util.progress import Listener, listening, stage
from ctxval._util.texts import reason_of
from ctxval.campaign.by_hand import tell_result
from ctxval.campaign.telling import SuppliedResult
from ctxval.core.trial import Trial
from ctxval.errors import CampaignError, CtxvalError, DistanceError, InputError
from ctxval.web import jobs
from ctxval.web.jobs import Files, Interval, OpenCampaign, ServedCampaign, TaskRequest
from ctxval.web.state import Innermost, PageState, Work

Result = TypeVar("Result")


class CampaignService(PageState):
    """One campaign, with the work in progress, for any number of operators.

    The server's own campaign lives in one thread, which reads the store and records results. Choosing, judging and
    drawing are jobs of two background processes.
    """

    def __init__(self, open_campaign: OpenCampaign, reopen: OpenCampaign) -> None:
        self._thread, self._closed = cf.ThreadPoolExecutor(1, "campaign"), False
        try:
            served = self._thread.submit(open_campaign).result()
            super().__init__(served, self._thread.submit(served.read).result())
        except BaseException:
            self._thread.shutdown()
            raise
        self._preparing: dict[int, asyncio.Task[None]] = {}
        self._submitted = Latest[str, int](1_000)  # forms that are remembered, to recognise one that is sent twice
        self._telling = asyncio.Lock()
        self._chooser, self._judge = (
            BackgroundProcess(reopen, functools.partial(self.post, self._progressed, kind))
            for kind in ("choosing", "judging")
        )

    async def start(self) -> None:
        await super().start()
        self._spawn(self._background(self._chooser, jobs.warm_up))
        self._follow()
        self._spawn(self._watch())

    async def stop(self) -> None:
        await super().stop()
        await self._loop.run_in_executor(None, self.close)

    def close(self) -> None:
        """End the background processes, and close the store, at once; a second call does nothing."""
        self._chooser.close()
        self._judge.close()
        if not self._closed:
            self._closed = True
            self._thread.submit(lambda: self.served.campaign.store.close()).result()
            self._thread.shutdown()

    # What operators do

    def choose(self, request: TaskRequest) -> None:
        if self.choosing is not None:
            raise InputError("a task is already being chosen.")
        request.require_current(len(self.snapshot.trials))
        self.update(choosing=Work.begun("choosing a task"), choice_error=None, chosen=None, enough=False)
        self._spawn(self._choose(request))

    async def tell(self, number: int, result: SuppliedResult, submission: str) -> Trial:
        """Record the result of an open trial, or replace an earlier result, once for each submitted form."""

        def record() -> None:
            try:
                ended = tell_result(self.served.campaign, self.served.experiment, number, result)
                self.input_differences[number] = self.served.campaign.input_difference(ended)
            except DistanceError:
                if self.served.campaign.trials[number].state != "unmeasured":
                    raise

        async with self._telling:
            if not submission or self._submitted.get(submission) != number:
                try:
                    await self._in_thread(record)
                finally:
                    await self._look()
                self._submitted[submission] = number
            return self.snapshot.trials[number]

    async def files_of(self, number: int) -> Files:
        if number in self._preparing:
            await asyncio.shield(self._preparing[number])
        files = self.files.get(number)
        if isinstance(files, dict):
            return files
        raise InputError(files or f"trial {number} is not open, so there are no files of it.")

    # Changes

    async def _in_thread(self, function: Callable[[], Result]) -> Result:
        """Call a function in the thread of the campaign; errors of users' code become errors of ctxval."""

        def guarded() -> Result:
            try:
                return function()
            except CtxvalError:
                raise
            except Exception as error:
                raise CampaignError(f"{reason_of(error)}.") from error

        return await asyncio.get_running_loop().run_in_executor(self._thread, guarded)

    async def _background(self, process: BackgroundProcess, job: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.wrap_future(process.submit(job, *arguments))

    async def _choose(self, request: TaskRequest) -> None:
        try:
            opened = await self._background(self._chooser, jobs.choose, request)
        except CtxvalError as error:
            self.update(choosing=None, choice_error=str(error))
        else:
            number, files = opened or (None, {})
            kept = self.files if number is None else {**self.files, number: files}
            self.update(choosing=None, chosen=number, enough=opened is None, files=kept)
        await self._look()

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(1.0)
            with contextlib.suppress(CtxvalError):  # looking again says why
                signature = await self._in_thread(lambda: self.served.campaign.store.signature())
                if signature == self.snapshot.signature and self.store_error is None:
                    continue
            await self._look()

    async def _look(self) -> None:
        """Read the store; if it has changed, bring everything else up to date."""
        try:
            snapshot = await self._in_thread(self.served.read)
        except CtxvalError as error:
            if self.store_error != str(error):
                self.update(store_error=str(error))
            return
        if self.store_error is not None:
            self.update(store_error=None)
        # An execution that starts changes no signature.
        states = [[(trial.state, trial.attempts) for trial in each.trials] for each in (snapshot, self.snapshot)]
        if snapshot.signature != self.snapshot.signature or states[0] != states[1]:
            self.snapshot = snapshot
            self._follow()
            self.update(enough=False)

    def _follow(self) -> None:
        """Prepare the files of open trials, forget those of others, and judge the trials that have ended."""
        waiting = {trial.number for trial in self.snapshot.trials.open if not trial.attempts}
        self.files = {number: kept for number, kept in self.files.items() if number in waiting}
        for number in waiting - set(self.files) - set(self._preparing):
            self._preparing[number] = self._spawn(self._prepare(number))
        if self.judging is None and self.judged != self.snapshot.ended:
            self.judging = Work.begun("drawing the pictures")
            self._spawn(self._evaluate())

    async def _prepare(self, number: int) -> None:
        files: Files | str
        try:
            files = await self._background(self._chooser, jobs.files_of, number)
        except CtxvalError as error:
            files = str(error)
        finally:
            self._preparing.pop(number, None)
        if any(trial.number == number for trial in self.snapshot.trials.open):
            self.update(files={**self.files, number: files})

    async def _evaluate(self) -> None:
        """Draw and judge until the results are those of the present trials."""
        while self.judged != self.snapshot.ended:
            ended = self.snapshot.ended
            try:
                self.update(pictures=await self._background(self._judge, jobs.draw))
                verdict = await self._background(self._judge, jobs.judge)
            except CtxvalError as error:
                self.update(judged=ended, verdict=None, judgement_error=str(error))
            else:
                worst, bound = self.snapshot.trials.worst, None if verdict is None else verdict.bound
                known = [] if worst is None else [Interval(self.snapshot.trials.executions, worst.least, bound)]
                history = (*self.history, *known)
                self.update(judged=ended, verdict=verdict, judgement_error=None, history=history)
        self.update(judging=None)


class BackgroundProcess:
    """A process that opens the campaign once and then does one job at a time; after a crash, the next job restarts it.

    It keeps the server responsive while Python computes, and users' code of two campaigns apart. The listener is called
    in another thread.
    """

    def __init__(self, open_campaign: OpenCampaign, on_progress: Listener) -> None:
        self._open, self._on_progress = open_campaign, on_progress
        self._thread = cf.ThreadPoolExecutor(1, "background")
        self._process: Any = None
        self._pipe: Connection | None = None
        self._lock = threading.Lock()  # a process must not start while this object is closed
        self._closed = False

    def submit(self, job: Callable[..., Any], *arguments: Any) -> cf.Future[Any]:
        """Do a job, a function of a module, after the earlier ones; its future raises a CampaignError if this fails."""
        return self._thread.submit(self._do, job, arguments)

    def close(self) -> None:
        """End the process with everything that it started. Work that is not stored yet is lost."""
        with self._lock:
            self._closed = True
            self._thread.shutdown(wait=False, cancel_futures=True)
            if self._process is not None and self._process.is_alive():
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    own_group = sys.platform != "win32" and os.getpgid(self._process.pid) == self._process.pid
                    if own_group:  # with its own children
                        os.killpg(self._process.pid, signal.SIGKILL)
                    else:
                        self._process.kill()
                self._process.join()
        self._thread.shutdown()

    def _do(self, job: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        with self._lock:
            if self._closed:
                raise CampaignError("the server is being stopped.")
            if self._process is None or not self._process.is_alive():
                # A forked child would inherit the threads and the database of the server.
                context = multiprocessing.get_context("spawn")
                self._pipe, other = context.Pipe()
                self._process = context.Process(target=_serve, args=(other, self._open), name="ctxval serve")
                self._process.start()
                other.close()
        assert self._pipe is not None
        try:
            self._pipe.send((job, arguments))
            while True:
                kind, content = self._pipe.recv()
                if kind == "done":
                    return content
                if kind == "failed":
                    raise CampaignError(content)
                self._on_progress(content)
        except (EOFError, OSError) as error:
            self._process.join()
            status = self._process.exitcode
            raise CampaignError(f"the background process ended with the status {status}. Try again.") from error


def _serve(pipe: Connection, open_campaign: OpenCampaign) -> None:
    """Do jobs in the child process until the server ends, however it ends."""
    if sys.platform != "win32":
        os.setpgid(0, 0)  # Ctrl-C at the terminal is for the server alone
    served: ServedCampaign | None = None
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            job, arguments = pipe.recv()
            try:
                with listening(Innermost(lambda progress: pipe.send(("progress", progress)))):
                    if served is None:
                        with stage("loading the experiment"):
                            served = open_campaign()
                    reply = "done", job(served, *arguments)
            except CtxvalError as error:
                reply = "failed", str(error)
            except BaseException as error:  # users' code may raise anything
                reply = "failed", reason_of(error)
            pipe.send(reply)
