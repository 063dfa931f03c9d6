"""Executions on many workers: processes of this computer, or any executor of ``concurrent.futures``."""

from __future__ import annotations

import concurrent.futures as cf
import contextlib
import multiprocessing
import os
import pickle
import random
import signal
import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from types import FrameType
from typing import Any, NoReturn

import numpy as np

from ctxval._util.cores import can_fork, forking
from ctxval._util.interrupts import kept_alive, raised_by_signal
from ctxval._util.texts import reason_of
from ctxval.core.controller import Controller
from ctxval.core.system import System
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Plan
from ctxval.errors import CampaignError, InputError

_GRACE = 2.0
"""Seconds that a worker has to clean up before it is killed."""

_TERMINATED = 143
"""Exit status of a worker that was asked to leave, as shells have it for SIGTERM."""

_POLL = 0.5
"""Seconds between two looks at what cannot be waited for."""


@dataclass(frozen=True, eq=False)
class Ended:
    """How an execution on a worker ended.

    Attributes:
        number: of its trial.
        trajectory: what the system returned, whole or not; None where there is none.
        failure: why there is none: the system's own failure, or that it took too long.
        lost: why the worker is gone, which says nothing of the system.
        seconds: how long the execution took.
    """

    number: int
    trajectory: Trajectory | None = None
    failure: str | None = None
    lost: str | None = None
    seconds: float | None = None


def _not_ended_within(timeout: float, number: int, seconds: float) -> Ended:
    return Ended(number, failure=f"the execution did not end within {timeout:g} s", seconds=seconds)


Answer = tuple[Trajectory | None, str | None, float]
"""What a worker returns: a trajectory, or why there is none; and the seconds."""


def execute_task(system: System, controller: Controller, task: Task) -> Answer:
    """Execute a task on the system, in a worker; what the system raises is an answer too."""
    started = time.perf_counter()
    try:
        trajectory = system.execute(controller, task)
    except BaseException as error:
        if raised_by_signal(error):
            raise
        return None, reason_of(error), time.perf_counter() - started
    return trajectory, None, time.perf_counter() - started


class Crew(ABC):
    """Workers that execute one plan each.

    Attributes:
        size: how many there are.
    """

    size: int

    @abstractmethod
    def start(self, number: int, plan: Plan) -> None:
        """Start the execution of a trial on a free worker.

        Raises:
            InputError: system or controller cannot be sent to another process.
            CampaignError: there is no worker any more.
        """

    @abstractmethod
    def wait(self) -> Ended:
        """Return the next execution that has ended."""

    @abstractmethod
    def close(self) -> None:
        """End all workers at once, with what they are executing."""


# Processes of this computer


@dataclass(eq=False)
class _Worker:
    """A process, what it executes, and until when."""

    process: Any
    pipe: Connection
    number: int | None = None
    started: float = 0.0


class Processes(Crew):
    """Processes of this computer, each with its own copy of the system.

    Where processes can be forked the system need not be picklable. A worker that dies or takes too long is replaced.

    Args:
        system: what they execute.
        size: how many.
        timeout: seconds after which an execution is ended and has failed.
    """

    def __init__(self, system: System, size: int, timeout: float | None = None) -> None:
        self.system, self.size, self.timeout = system, size, timeout
        self._context: Any = multiprocessing.get_context("fork" if can_fork() else "spawn")
        self._workers: list[_Worker] = []

    def start(self, number: int, plan: Plan) -> None:
        """Start the execution of a trial on a free worker."""
        worker = next((one for one in self._workers if one.number is None), None) or self._hire()
        try:
            message = pickle.dumps((plan.controller, plan.task))
        except Exception as error:
            # Whatever a user's object raises.
            raise InputError(
                f"the controller cannot be sent to a worker: {reason_of(error)}; a policy must be a function of a "
                "module, not a lambda or a function in a function."
            ) from error
        worker.number, worker.started = number, time.monotonic()
        with contextlib.suppress(OSError):  # it died meanwhile, which wait() finds
            worker.pipe.send_bytes(message)

    def _hire(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        others = [worker.pipe for worker in self._workers] + [ours]
        forked = self._context.get_start_method() == "fork"
        arguments = (self.system, theirs, others if forked else [], os.getpid())
        process = self._context.Process(target=_serve, args=arguments, daemon=False)
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

    def wait(self) -> Ended:
        """Return the next execution that has ended."""
        while True:
            busy = [worker for worker in self._workers if worker.number is not None]
            ready = wait_for([worker.pipe for worker in busy], self._remaining(busy))
            for worker in busy:
                if worker.pipe in ready:
                    return self._received(worker)
            for worker in busy:
                if self.timeout is not None and time.monotonic() - worker.started >= self.timeout:
                    return self._too_late(worker)

    def _remaining(self, busy: list[_Worker]) -> float | None:
        if self.timeout is None:
            return None
        return max(0.0, min(worker.started for worker in busy) + self.timeout - time.monotonic())

    def _received(self, worker: _Worker) -> Ended:
        number, worker.number = worker.number, None
        assert number is not None
        try:
            trajectory, failure, seconds = pickle.loads(worker.pipe.recv_bytes())
        except (EOFError, OSError, pickle.UnpicklingError):
            self._dismiss(worker)
            return _gone(number, worker.process.exitcode)
        return Ended(number, trajectory, failure, seconds=seconds)

    def _too_late(self, worker: _Worker) -> Ended:
        number, worker.number = worker.number, None
        assert number is not None
        assert self.timeout is not None
        self._dismiss(worker)
        seconds = time.monotonic() - worker.started
        return _not_ended_within(self.timeout, number, seconds)

    def _dismiss(self, worker: _Worker) -> None:
        """End a worker: it may clean up first, as a command's process must go with it."""
        worker.process.terminate()
        worker.process.join(_GRACE)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        worker.pipe.close()
        self._workers.remove(worker)

    def close(self) -> None:
        """End all workers at once, with what they are executing."""
        for worker in self._workers:
            worker.process.terminate()
        for worker in list(self._workers):
            self._dismiss(worker)


def _serve(system: System, pipe: Connection, others: list[Connection], parent: int) -> None:
    """Execute what comes through the pipe, until it is closed."""
    # Ctrl-C reaches every process of a terminal; which execution ends is decided by the campaign.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    for other in others:
        other.close()
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    # A copy of the campaign's randomness would give every worker the same noise.
    np.random.seed()  # noqa: NPY002
    random.seed()
    while True:
        try:
            controller, task = pickle.loads(pipe.recv_bytes())
        except EOFError:
            return
        with kept_alive():
            answer = execute_task(system, controller, task)
        pipe.send_bytes(pickle.dumps(answer))


def _gone(number: int, status: int | None) -> Ended:
    """Return what the end of a worker's process says: who ends by itself has failed, who is killed is lost."""
    if status is None or status < 0 or status == _TERMINATED:
        how = (
            "by signal 15"
            if status == _TERMINATED
            else "for no known reason"
            if status is None
            else f"by signal {-status}"
        )
        return Ended(number, lost=f"the worker ended {how}")
    return Ended(number, failure=f"the system ended its process with status {status}")


def _leave(_signal: int, _frame: FrameType | None) -> NoReturn:
    raise SystemExit(_TERMINATED)


def _watch(parent: int) -> None:
    """Leave with the campaign: an execution whose result nobody takes must not go on beside its repetition."""
    while os.getppid() == parent:
        time.sleep(_POLL)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE)
    os._exit(1)


# Any executor


class Executor(Crew):
    """An executor of ``concurrent.futures``: a pool of threads or processes, Dask, and others.

    A system in a pool of threads is shared by all of them. What takes too long is cancelled; a thread cannot be, and
    goes on behind our back.

    Args:
        system: what the workers execute.
        executor: where to.
        size: how many executions at a time.
        timeout: seconds after which an execution has failed.
    """

    def __init__(self, system: System, executor: cf.Executor, size: int, timeout: float | None = None) -> None:
        self.system, self.executor, self.size, self.timeout = system, executor, size, timeout
        self._running: dict[cf.Future[Answer], tuple[int, float]] = {}

    def start(self, number: int, plan: Plan) -> None:
        """Start the execution of a trial."""
        self._await_scheduler()
        try:
            future = self.executor.submit(execute_task, self.system, plan.controller, plan.task)
        except Exception as error:
            if _is_loss(error) or isinstance(error, RuntimeError):
                raise CampaignError(f"the executor takes no more work: {reason_of(error).rstrip('.')}.") from error
            raise InputError(f"the execution cannot be sent to a worker: {reason_of(error)}.") from error
        self._running[future] = number, time.monotonic()

    def wait(self) -> Ended:
        """Return the next execution that has ended."""
        while True:
            cf.wait(self._running, timeout=_POLL, return_when=cf.FIRST_COMPLETED)
            for future, (number, started) in list(self._running.items()):
                seconds = time.monotonic() - started
                if future.done():
                    del self._running[future]
                    return self._ended(number, future)
                if self.timeout is not None and seconds >= self.timeout:
                    del self._running[future]
                    future.cancel()
                    return _not_ended_within(self.timeout, number, seconds)
            # What was sent while a client looked for its scheduler stays pending for ever.
            self._await_scheduler()

    def _await_scheduler(self) -> None:
        """Wait as long as a Dask client looks for a scheduler that it has lost.

        Raises:
            CampaignError: it has given up. The trials stay open, so that the campaign can go on with another.
        """
        while self._status() == "connecting":
            time.sleep(_POLL)
        if self._status() == "closed":
            raise CampaignError("the executor takes no more work: its scheduler is gone.")

    def _status(self) -> str:
        return str(getattr(getattr(self.executor, "_client", None), "status", "running"))

    def _ended(self, number: int, future: cf.Future[Answer]) -> Ended:
        try:
            trajectory, failure, seconds = future.result()
        except (Exception, cf.CancelledError) as error:
            if _is_loss(error):
                self._await_scheduler()
                return Ended(number, lost=reason_of(error))
            raise InputError(f"the execution cannot be sent to a worker: {reason_of(error)}.") from error
        return Ended(number, trajectory, failure, seconds=seconds)

    def close(self) -> None:
        """Cancel what has not started; the executor is its owner's."""
        for future in self._running:
            future.cancel()


def _is_loss(error: BaseException) -> bool:
    """Return whether a worker was lost, which is no fault of the system."""
    known = (cf.BrokenExecutor, cf.CancelledError, EOFError, OSError)
    return isinstance(error, known) or type(error).__module__.split(".")[0] == "distributed"


def crew(
    system: System,
    *,
    workers: int | None = None,
    executor: cf.Executor | None = None,
    timeout: float | None = None,
) -> Crew | None:
    """Return the workers that are asked for; None where one execution after the other runs here.

    Raises:
        InputError: a value cannot be used.
    """
    if workers is not None and (not isinstance(workers, int) or isinstance(workers, bool) or workers < 1):
        raise InputError(f"workers must be a positive integer, got {workers!r}.")
    if timeout is not None and not (isinstance(timeout, int | float) and 0 < timeout < float("inf")):
        raise InputError(f"timeout must be a positive number of seconds, got {timeout!r}.")
    if executor is not None:
        if not isinstance(executor, cf.Executor):
            raise InputError(f"executor must be one of concurrent.futures, got {type(executor).__name__}.")
        # Every pool of the standard library has it, under this name.
        size = getattr(executor, "_max_workers", 1) if workers is None else workers
        return Executor(system, executor, int(size), timeout)
    if (workers or 1) > 1 or timeout is not None:
        return Processes(system, workers or 1, timeout)
    return None
