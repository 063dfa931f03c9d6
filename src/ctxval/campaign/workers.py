"""Pools of workers that execute tasks: processes of this computer, or any executor."""

from __future__ import annotations

import concurrent.futures as cf
import contextlib
import math
import multiprocessing
import os
import pickle
import random
import re
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from types import FrameType
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval._util.cores import can_fork, forking
from ctxval._util.interrupts import allow_exits, exits_as_exceptions, raised_by_signal
from ctxval._util.progress import mute
from ctxval._util.texts import reason_of
from ctxval.campaign.choices import Execution
from ctxval.core.controller import Controller
from ctxval.core.plan import Plan
from ctxval.core.system import System
from ctxval.core.task import Task
from ctxval.errors import CampaignError, InputError

_GRACE_PERIOD = 2.0
"""Seconds that a worker has to clean up before it is killed."""

_TERMINATED = 143
"""Exit status of a worker that ended after SIGTERM, as in shells."""

_SHORT = 5.0
"""Seconds of the longest execution behind which another one may wait."""


def execute_task(system: System, controller: Controller, task: Task) -> Execution:
    """Execute a task on the system, here or in a worker; an exception of the system is returned as a failure."""
    started = time.perf_counter()
    try:
        trajectory = system.execute(controller, task)
    except BaseException as error:
        if raised_by_signal(error):
            raise
        return Execution(failed=reason_of(error), seconds=time.perf_counter() - started)
    return Execution(trajectory, seconds=time.perf_counter() - started)


def _timed_out(timeout: float, seconds: float) -> Execution:
    return Execution(failed=f"the execution did not end within {timeout:g} s", seconds=seconds)


class WorkerPool(ABC):
    """Workers that execute one plan each.

    Attributes:
        size: the number of workers.
    """

    size: int

    @property
    def ahead(self) -> int:
        """The number of further plans that may wait for a free worker, if their choice depends on no result."""
        return 0

    @abstractmethod
    def start(self, number: int, plan: Plan) -> None:
        """Start the execution of a trial on a free worker, or let it wait for one."""

    @abstractmethod
    def wait(self) -> list[tuple[int, Execution]]:
        """Wait for the next execution that ends; return the numbers and results of all trials that have ended."""

    @abstractmethod
    def close(self) -> None:
        """End all workers and their executions at once."""


class SerialPool(WorkerPool):
    """This process, which executes one plan at a time."""

    def __init__(self, system: System) -> None:
        self.system, self.size = system, 1

    def start(self, number: int, plan: Plan) -> None:
        """Take a plan, which :meth:`wait` executes."""
        self._next = number, plan

    def wait(self) -> list[tuple[int, Execution]]:
        """Execute the plan; return the number of its trial, and what the execution gave."""
        number, plan = self._next
        return [(number, execute_task(self.system, plan.controller, plan.task))]

    def close(self) -> None:
        """Do nothing: no execution is running any more."""


# Processes of this computer


@dataclass(eq=False)
class _Worker:
    """A process, the number of the trial that it executes, None if it is free, and the start time of the execution."""

    process: Any
    pipe: Connection
    number: int | None = None
    started: float = 0.0

    def release(self) -> int:
        number, self.number = self.number, None
        assert number is not None
        return number


class ProcessPool(WorkerPool):
    """Processes of this computer, each with its own copy of the system.

    If processes can be forked, the system need not be picklable. A worker that dies, or whose execution takes longer
    than ``timeout`` seconds, is ended and replaced.
    """

    def __init__(self, system: System, size: int, timeout: float | None = None) -> None:
        self.system, self.size, self.timeout = system, size, timeout
        self._context: Any = multiprocessing.get_context("fork" if can_fork() else "spawn")
        self._workers: list[_Worker] = []

    def start(self, number: int, plan: Plan) -> None:
        """Start the execution of a trial on a free worker."""
        free = (worker for worker in self._workers if worker.number is None)
        worker = next(free, None) or self._start_worker()
        try:
            message = pickle.dumps((plan.controller, plan.task))
        except Exception as error:
            # A user's object may raise any exception.
            raise InputError(
                f"the controller cannot be sent to a worker: {reason_of(error)}; a policy must be a function of a "
                "module, not a lambda or a function in a function."
            ) from error
        worker.number, worker.started = number, time.monotonic()
        with contextlib.suppress(OSError):  # the worker has died; wait() detects this
            worker.pipe.send_bytes(message)

    def _start_worker(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        others = [worker.pipe for worker in self._workers] + [ours]
        forked = self._context.get_start_method() == "fork"
        arguments = (self.system, theirs, others if forked else [], os.getpid())
        process = self._context.Process(target=_run_worker, args=arguments, daemon=False)
        try:
            with forking():
                process.start()
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(f"the system cannot be sent to a worker: {reason_of(error)}.") from error
        except OSError as error:
            raise CampaignError(f"no worker can be started: {error.strerror}.") from error
        theirs.close()
        worker = _Worker(process, ours)
        self._workers.append(worker)
        return worker

    def wait(self) -> list[tuple[int, Execution]]:
        """Wait for the next execution that ends, or that takes too long."""
        while True:
            busy = [worker for worker in self._workers if worker.number is not None]
            remaining = None
            if self.timeout is not None:
                remaining = max(0.0, min(worker.started for worker in busy) + self.timeout - time.monotonic())
            ready = wait_for([worker.pipe for worker in busy], remaining)
            if ready:
                return [self._received(worker) for worker in busy if worker.pipe in ready]
            for worker in busy:
                elapsed = time.monotonic() - worker.started
                if self.timeout is not None and elapsed >= self.timeout:
                    self._stop([worker])
                    return [(worker.release(), _timed_out(self.timeout, elapsed))]

    def _received(self, worker: _Worker) -> tuple[int, Execution]:
        number = worker.release()
        try:
            execution: Execution = pickle.loads(worker.pipe.recv_bytes())
        except (EOFError, OSError, pickle.UnpicklingError):
            self._stop([worker])
            return number, _result_of_exit(worker.process.exitcode)
        return number, execution

    def _stop(self, workers: Sequence[_Worker]) -> None:
        """End workers, with some time to clean up, because they must end the process of a command too."""
        for worker in workers:
            worker.process.terminate()
        for worker in workers:
            worker.process.join(_GRACE_PERIOD)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.pipe.close()
            self._workers.remove(worker)

    def close(self) -> None:
        """End all workers and their executions at once."""
        self._stop(list(self._workers))


def _run_worker(system: System, pipe: Connection, others: list[Connection], parent: int) -> None:
    """Execute the tasks that come through the pipe, until it is closed."""
    # Ctrl-C reaches every process of a terminal, but the campaign decides which executions end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit_on_signal)
    allow_exits()
    for other in others:
        other.close()
    mute()  # a forked worker would draw over the progress of the campaign, and may wait for its lock for ever
    threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()
    # With a copy of the campaign's random state, every worker would have the same noise.
    np.random.seed()  # noqa: NPY002
    random.seed()
    try:
        while True:
            try:
                controller, task = pickle.loads(pipe.recv_bytes())
            except EOFError:
                return
            with exits_as_exceptions():
                execution = execute_task(system, controller, task)
            pipe.send_bytes(pickle.dumps(execution))
    finally:
        _leave_once()


def _result_of_exit(status: int | None) -> Execution:
    """Return what an execution gave whose process has ended: it failed if the system ended it, else it is lost."""
    if status is None:
        return Execution(lost="the worker ended for no known reason")
    if status < 0 or status == _TERMINATED:
        return Execution(lost=f"the worker ended by signal {-status if status < 0 else signal.SIGTERM:d}")
    return Execution(failed=f"the system ended its process with status {status}")


_leaving = False


def _exit_on_signal(_signal: int, _frame: FrameType | None) -> None:
    if _leave_once():
        raise SystemExit(_TERMINATED)


def _leave_once() -> bool:
    """Ignore signals from now on, because the worker ends; return whether it had not yet begun to end.

    An exception while a forked process ends would let it go on where it was forked, as a copy of the campaign.
    """
    global _leaving
    first, _leaving = not _leaving, True
    allow_exits()
    return first


def _exit_with_parent(parent: int) -> None:
    """End if the campaign's process has ended, because a resumed campaign repeats the execution."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE_PERIOD)
    allow_exits()  # the execution may be going on, in code that no signal handler interrupts
    os._exit(1)


# Any executor


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
        """The number of further plans that wait for a free worker: half a second of work, if executions are short.

        Ctrl-C waits for them. There are none with a time limit, because it is not known when they start.
        """
        short = self.timeout is None and self._seconds <= _SHORT
        return self.size * min(8, math.ceil(0.5 / self._seconds)) if short else 0

    def start(self, number: int, plan: Plan) -> None:
        """Start the execution of a trial."""
        self._await_scheduler()
        try:
            job = self.executor.submit(execute_task, self.system, plan.controller, plan.task)
        except Exception as error:
            if _is_loss(error) or isinstance(error, RuntimeError):
                raise CampaignError(f"the executor takes no more work: {reason_of(error).rstrip('.')}.") from error
            raise InputError(f"the execution cannot be sent to a worker: {reason_of(error)}.") from error
        self._running[number] = job, time.monotonic()

    def wait(self) -> list[tuple[int, Execution]]:
        """Wait for the next execution that ends, or that takes too long."""
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
                    ended.append((number, _timed_out(self.timeout, seconds)))
            if ended:
                self._seconds = next((each.seconds for _, each in ended if each.seconds), self._seconds)
                return ended
            # A task that was sent while a client searched for its scheduler stays pending for ever.
            self._await_scheduler()

    def _await_scheduler(self) -> None:
        """Wait while a Dask client searches for a scheduler that it has lost."""
        while self._status() == "connecting":
            time.sleep(0.5)
        if self._status() == "closed":
            raise CampaignError("the executor takes no more work: its scheduler is gone.")

    def _status(self) -> str:
        return str(getattr(getattr(self.executor, "_client", None), "status", "running"))

    def _result(self, job: Any) -> Execution:
        try:
            execution: Execution = job.result()
        except (Exception, cf.CancelledError) as error:
            if _is_loss(error):
                self._await_scheduler()
                return Execution(lost=reason_of(error))
            # The message may be the traceback of another process, whose last error is the reason.
            errors = re.findall(r"^[\w.]*(?:Error|Exception): .*$", str(error), re.MULTILINE)
            reason = errors[-1] if errors else reason_of(error)
            raise InputError(f"the execution cannot be sent to a worker: {reason.rstrip('.')}.") from error
        return execution

    def close(self) -> None:
        """Cancel the executions that have not started; the owner of the executor closes it."""
        for job, _ in self._running.values():
            _cancel(job)


def _cancel(job: Any) -> None:
    with contextlib.suppress(Exception):  # the command of a cluster that cancels its job may fail
        job.cancel()


_ENGINES = {"distributed", "ray", "submitit"}
_RAISED_BY_FUNCTION = {"FailedJobError", "RayTaskError", "RaySystemError", "RuntimeEnvSetupError"}


def _is_loss(error: BaseException) -> bool:
    """Return whether an error means that a worker was lost, which is not a failure of the system."""
    known = (cf.BrokenExecutor, cf.CancelledError, EOFError, OSError)
    of_engine = type(error).__module__.split(".")[0] in _ENGINES
    raised = not _RAISED_BY_FUNCTION.isdisjoint(cls.__name__ for cls in type(error).__mro__)
    return isinstance(error, known) or (of_engine and not raised)


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
