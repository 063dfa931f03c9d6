"""A child process with a campaign of its own, for work that takes long."""

from __future__ import annotations

import concurrent.futures as cf
import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from ctxval._util.progress import Progress, listening
from ctxval._util.texts import reason_of
from ctxval.errors import CampaignError, CtxvalError
from ctxval.web.served import OpenCampaign, ServedCampaign


@dataclass(frozen=True)
class Stage:
    """What is done at present: the beginning of a sentence, and how much of it; expected is None if not known."""

    text: str
    done: float = 0.0
    expected: float | None = None
    unit: str = ""


TellStage = Callable[[Stage], None]
Job = Callable[..., Any]
"""A function of a module, called with the served campaign, a function that tells the stage, and the job's arguments."""


class BackgroundProcess:
    """A process that opens the campaign once and then does one job at a time.

    A process keeps the server responsive while Python computes, keeps users' code of two campaigns apart, and may crash
    without harm. The next job starts it again.

    Args:
        open_campaign: opens the campaign in the child process; it must be picklable.
        on_stage: called in another thread when the stage of the job changes.
    """

    def __init__(self, open_campaign: OpenCampaign, on_stage: TellStage) -> None:
        self._open, self._on_stage = open_campaign, on_stage
        self._thread = cf.ThreadPoolExecutor(1, "background")
        self._process: Any = None
        self._pipe: Connection | None = None
        self._lock = threading.Lock()  # a process must not start while this object is closed
        self._closed = False

    def submit(self, job: Job, *arguments: Any) -> cf.Future[Any]:
        """Do a job after the earlier ones; its future raises a CampaignError if the job fails or the process ends."""
        return self._thread.submit(self._do, job, arguments)

    def close(self) -> None:
        """End the process with everything that it started. Work that is not stored yet is lost."""
        with self._lock:
            self._closed = True
            self._thread.shutdown(wait=False, cancel_futures=True)
            if self._process is not None and self._process.is_alive():
                _kill(self._process.pid)
                self._process.join()
        self._thread.shutdown()

    def _do(self, job: Job, arguments: tuple[Any, ...]) -> Any:
        with self._lock:
            if self._closed:
                raise CampaignError("the server is being stopped.")
            if self._process is None or not self._process.is_alive():
                self._start()
        assert self._pipe is not None
        try:
            self._pipe.send((job, arguments))
            return self._result(self._pipe)
        except (EOFError, OSError) as error:
            self._process.join()
            status = self._process.exitcode
            raise CampaignError(f"the background process ended with the status {status}. Try again.") from error

    def _start(self) -> None:
        # A forked child would inherit the threads and the database of the server.
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, self._open), name="ctxval serve")
        self._process.start()
        other.close()

    def _result(self, pipe: Connection) -> Any:
        while True:
            kind, content = pipe.recv()
            if kind == "done":
                return content
            if kind == "failed":
                raise CampaignError(content)
            self._on_stage(content)


def _kill(process: int) -> None:
    """Kill a child and its own children, which are in its process group."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if sys.platform == "win32":
            os.kill(process, signal.SIGTERM)
            return
        if os.getpgid(process) == process:
            os.killpg(process, signal.SIGKILL)
        else:  # it has not made its group yet
            os.kill(process, signal.SIGKILL)


# In the child process


def _serve(pipe: Connection, open_campaign: OpenCampaign) -> None:
    """Do jobs until the server ends, however it ends."""
    if sys.platform != "win32":
        os.setpgid(0, 0)  # Ctrl-C at the terminal is for the server alone
    served: ServedCampaign | None = None
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            job, arguments = pipe.recv()
            try:
                if served is None:
                    pipe.send(("stage", Stage("loading the experiment")))
                    served = open_campaign()
                tell = StageSender(lambda stage: pipe.send(("stage", stage)))
                with listening(tell.hear):
                    reply = "done", job(served, tell, *arguments)
            except CtxvalError as error:
                reply = "failed", str(error)
            except BaseException as error:  # users' code may raise anything
                reply = "failed", reason_of(error)
            pipe.send(reply)


class StageSender:
    """Sends stages to somebody, and not too many of them."""

    def __init__(self, send: TellStage) -> None:
        self._send, self._text, self._at = send, "", 0.0
        self._running: dict[int, Progress] = {}

    def __call__(self, stage: Stage) -> None:
        """Send a stage, unless it only counts and was sent a moment ago."""
        now = time.monotonic()
        # Least number of seconds between two messages that only count.
        if stage.text != self._text or now - self._at >= 0.2:
            self._text, self._at = stage.text, now
            self._send(stage)

    def hear(self, progress: Progress) -> None:
        """Send the innermost stage of long work."""
        if progress.ended:
            self._running.pop(progress.depth, None)
        else:
            self._running[progress.depth] = progress
        if self._running:
            innermost = self._running[max(self._running)]
            self(Stage(innermost.stage, innermost.done, innermost.expected, innermost.unit))
