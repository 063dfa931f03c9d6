"""Executors as pools of workers: threads and processes of ``concurrent.futures``, Dask, Slurm, Ray, and others."""

from __future__ import annotations

import concurrent.futures as cf
import contextlib
import math
import re
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval._util.texts import reason_of
from ctxval.campaign.choices import Execution
from ctxval.campaign.workers import AHEAD, ProcessPool, WorkerPool, execute_task, timed_out
from ctxval.core.plan import Plan
from ctxval.core.system import System
from ctxval.errors import CampaignError, InputError


@runtime_checkable
class Executor(Protocol):
    """An executor of ``concurrent.futures``, or what submits functions as these do, such as those of Dask and Slurm."""

    @abstractmethod
    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Return a job that calls the function: it has the methods ``done``, ``result`` and ``cancel`` of a future."""


class ExecutorPool(WorkerPool):
    """An executor: a pool of threads or processes, Dask, Slurm, Ray, and others.

    All threads of a pool share one system. An execution that takes longer than ``timeout`` seconds is cancelled; a
    thread cannot be cancelled and continues in the background.
    """

    def __init__(self, system: System, executor: Executor, size: int, timeout: float | None = None) -> None:
        self.system, self.executor, self.size, self.timeout = system, executor, size, timeout
        self._running: dict[int, tuple[Any, float]] = {}
        self._seconds = np.inf

    @property
    def ahead(self) -> int:
        # Half a second of work, for which Ctrl-C waits; with a time limit none, as it is not known when they start.
        # Seconds of the longest execution behind which another one may wait.
        short = self.timeout is None and self._seconds <= 5.0
        return self.size * min(8, math.ceil(AHEAD / self._seconds)) if short else 0

    def start(self, number: int, plan: Plan) -> None:
        self._await_scheduler()
        try:
            job = self.executor.submit(execute_task, self.system, plan.controller, plan.task)
        except Exception as error:
            if _is_loss(error) or isinstance(error, RuntimeError):
                raise CampaignError(f"the executor takes no more work: {reason_of(error).rstrip('.')}.") from error
            raise InputError(f"the execution cannot be sent to a worker: {reason_of(error)}.") from error
        self._running[number] = job, time.monotonic()

    def wait(self) -> list[tuple[int, Execution]]:
        while True:
            jobs = [job for job, _ in self._running.values()]
            if all(isinstance(job, cf.Future) for job in jobs):
                cf.wait(jobs, timeout=0.5, return_when=cf.FIRST_COMPLETED)
            elif not any(job.done() for job in jobs):
                time.sleep(0.1)  # jobs of a cluster take longer to start, and to be asked means to look for a file
            ended = list[tuple[int, Execution]]()
            for number, (job, started) in list(self._running.items()):
                seconds = time.monotonic() - started
                if job.done():
                    del self._running[number]
                    ended.append((number, self._result(job)))
                elif self.timeout is not None and seconds >= self.timeout:
                    del self._running[number]
                    _cancel(job)
                    ended.append((number, timed_out(self.timeout, seconds)))
            if ended:
                self._seconds = next((each.seconds for _, each in ended if each.seconds), self._seconds)
                return ended
            # A task that was sent while a client searched for its scheduler stays pending for ever.
            self._await_scheduler()

    def _await_scheduler(self) -> None:
        """Wait while a Dask client searches for a scheduler that it has lost."""
        client = getattr(self.executor, "_client", None)
        while (status := getattr(client, "status", "running")) == "connecting":
            time.sleep(0.5)
        if status == "closed":
            raise CampaignError("the executor takes no more work: its scheduler is gone.")

    def _result(self, job: Any) -> Execution:
        try:
            return job.result()  # type: ignore[no-any-return]
        except (Exception, cf.CancelledError) as error:
            if _is_loss(error):
                self._await_scheduler()
                return Execution(lost=reason_of(error))
            # The message may be the traceback of another process, whose last error is the reason.
            errors = re.findall(r"^[\w.]*(?:Error|Exception): .*$", str(error), re.MULTILINE)
            reason = errors[-1] if errors else reason_of(error)
            raise InputError(f"the execution cannot be sent to a worker: {reason.rstrip('.')}.") from error

    def close(self) -> None:
        # Executions that have not started are cancelled; the owner of the executor closes it.
        for job, _ in self._running.values():
            _cancel(job)


def _cancel(job: Any) -> None:
    with contextlib.suppress(Exception):  # the command of a cluster that cancels its job may fail
        job.cancel()


def _is_loss(error: BaseException) -> bool:
    """Return whether an error means that a worker was lost, which is not a failure of the system."""
    if isinstance(error, cf.BrokenExecutor | cf.CancelledError | EOFError | OSError):
        return True
    of_engine = type(error).__module__.split(".")[0] in {"distributed", "ray", "submitit"}
    raised_by_function = {"FailedJobError", "RayTaskError", "RaySystemError", "RuntimeEnvSetupError"}
    return of_engine and raised_by_function.isdisjoint(kind.__name__ for kind in type(error).__mro__)


def worker_pool(
    system: System, *, workers: int | None, executor: Executor | None, timeout: float | None
) -> WorkerPool | None:
    """Return a pool of workers; None if the executions run one after the other in this process."""
    if getattr(system, "manual", False):
        raise InputError(
            "this system is executed by people, not by run or audit: get tasks with `ctxval ask` and record the "
            "results with `ctxval tell` (ask and tell in Python)."
        )
    if executor is not None:
        # Every pool of the standard library has its size under this name.
        size = getattr(executor, "_max_workers", 1) if workers is None else workers
        return ExecutorPool(system, executor, int(size), timeout)
    if (workers or 1) > 1 or timeout is not None:
        return ProcessPool(system, workers or 1, timeout)
    return None
