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
from multiprocessing.connection import Connection
from typing import Any

from ctxval._util.progress import Listener, Progress, listening, stage
from ctxval._util.texts import reason_of
from ctxval.errors import CampaignError, CtxvalError
from ctxval.web.jobs import OpenCampaign, ServedCampaign


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
        """Do a job after the earlier ones; its future raises a CampaignError if the job fails or the process ends.

        The job is a function of a module, which the child process calls with the served campaign and the arguments.
        """
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


class Innermost:
    """Sends the innermost stage of long work to a listener, and not more than five times a second if it only counts."""

    def __init__(self, send: Listener) -> None:
        self._send, self._stage, self._at = send, "", 0.0
        self._running: dict[int, Progress] = {}

    def __call__(self, progress: Progress) -> None:
        """Hear the progress of any stage."""
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
