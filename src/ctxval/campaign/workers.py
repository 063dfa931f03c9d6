"""Pools of workers that execute tasks: this process, or others of this computer."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import random
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from types import FrameType
from typing import Any

import numpy as np

from ctxval._util.cores import allow_exits, can_fork, exits_as_exceptions, forking, raised_by_signal
from ctxval._util.progress import mute
from ctxval._util.texts import reason_of
from ctxval.campaign.choices import Execution
from ctxval.core.controller import Controller, each_alone
from ctxval.core.plan import Plan
from ctxval.core.system import System
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.errors import CampaignError, InputError

_GRACE_PERIOD = 2.0  # seconds that a worker has to clean up before it is killed
AHEAD = 0.5  #: seconds of work that is begun before its turn, if its choice depends on no result; Ctrl-C waits for it
_BATCH = 128  # largest number of tasks that are executed in one call
_TERMINATED = 143  # exit status of a worker that ended after SIGTERM, as in shells


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


def timed_out(timeout: float, seconds: float) -> Execution:
    """Return the result of an execution that took longer than the timeout."""
    return Execution(failed=f"the execution did not end within {timeout:g} s", seconds=seconds)


class WorkerPool(ABC):
    """``size`` workers that execute one plan each."""

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
        """Wait for the next execution that ends or takes too long; return the numbers and results of all that ended."""

    @abstractmethod
    def close(self) -> None:
        """End all workers and their executions at once."""


class SerialPool(WorkerPool):
    """This process, which executes one plan at a time, or all that wait in one call if batches of the system are exact.

    A task that fails in a batch is executed again alone, because the batch does not tell its reason.
    """

    def __init__(self, system: System) -> None:
        self.system, self.size = system, 1
        self._next: list[tuple[int, Plan]] = []
        self._seconds = np.inf

    @property
    def ahead(self) -> int:
        exact = getattr(self.system, "exact_batches", False)
        return min(_BATCH - 1, int(AHEAD / max(self._seconds, 1e-9))) if exact else 0

    def start(self, number: int, plan: Plan) -> None:
        self._next.append((number, plan))

    def wait(self) -> list[tuple[int, Execution]]:
        taken, self._next = self._next, []
        tasks, controllers = [plan.task for _, plan in taken], [plan.controller for _, plan in taken]
        kinds = {(task.horizon, task.dt, task.has_goal, task.reference.shape) for task in tasks}
        started, together = time.perf_counter(), None
        if len(taken) > 1 and len(kinds) == 1:
            try:
                together = self.system.execute(each_alone(controllers, tasks), Task.stacked(tasks))
            except BaseException as error:
                if raised_by_signal(error):
                    raise
            if not isinstance(together, Trajectory) or together.batch_shape != (len(taken),):
                together = None
            elif together.ended != COMPLETE and together.finite.all():
                together = None  # it is not known which of them failed
        seconds = (time.perf_counter() - started) / len(taken)
        ended = [
            (number, execute_task(self.system, plan.controller, plan.task))
            if together is None or not together.finite[k]
            else (number, Execution(together[k], seconds=seconds))
            for k, (number, plan) in enumerate(taken)
        ]
        self._seconds = max(execution.seconds or 0.0 for _, execution in ended)
        return ended

    def close(self) -> None:
        """Do nothing: no execution is running any more."""


@dataclass(eq=False)
class _Worker:
    """A process, and the number of the trial that it has executed since a time; None if it is free."""

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
        free = (worker for worker in self._workers if worker.number is None)
        worker = next(free, None) or self._start_worker()
        try:
            message = pickle.dumps((plan.controller, plan.task))
        except Exception as error:  # a user's object may raise any exception
            raise InputError(
                f"the controller cannot be sent to a worker: {reason_of(error)}; a policy, or what a "
                "synthesizer designs, must be a function or an object of a class of a module, not a lambda or a "
                "function in a function."
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
        while True:
            busy = [worker for worker in self._workers if worker.number is not None]
            remaining = None
            if self.timeout is not None:
                remaining = max(0.0, min(worker.started for worker in busy) + self.timeout - time.monotonic())
            ready = wait_for([worker.pipe for worker in busy], remaining)
            if ready:
                return [(worker.release(), self._received(worker)) for worker in busy if worker.pipe in ready]
            for worker in busy:
                elapsed = time.monotonic() - worker.started
                if self.timeout is not None and elapsed >= self.timeout:
                    self._stop([worker])
                    return [(worker.release(), timed_out(self.timeout, elapsed))]

    def _received(self, worker: _Worker) -> Execution:
        """Return what an execution gave: if its process has ended, a failure if the system ended it, else a loss."""
        try:
            return pickle.loads(worker.pipe.recv_bytes())  # type: ignore[no-any-return]
        except (EOFError, OSError, pickle.UnpicklingError):
            self._stop([worker])
        status = worker.process.exitcode
        if status is None:
            return Execution(lost="the worker ended for no known reason")
        if status < 0 or status == _TERMINATED:
            return Execution(lost=f"the worker ended by signal {-status if status < 0 else signal.SIGTERM:d}")
        return Execution(failed=f"the system ended its process with status {status}")

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


_leaving = False


def _exit_on_signal(_signal: int, _frame: FrameType | None) -> None:
    if _leave_once():
        raise SystemExit(_TERMINATED)


def _leave_once() -> bool:
    """Ignore signals, because the worker ends; return whether it had not yet begun to end.

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
