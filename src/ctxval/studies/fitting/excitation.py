"""Executions that teach a model: a signal is added to the inputs of the controllers of random tasks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, get_args

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite
from ctxval._util.representation import ShortRepr
from ctxval.campaign.workers import SerialPool
from ctxval.core.controller import Controller, Limits, memory_of, stepped
from ctxval.core.plan import Plan
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, ExecutionError, InputError, ShapeError, UnknownNameError

SignalKind = Literal["random", "multisine", "chirp"]


def excitation(kind: SignalKind, horizon: int, amplitude: ArrayLike, rng: np.random.Generator) -> Array:
    """Return a signal for each input, shape ``(H, m)``, with magnitudes up to the amplitude.

    ``random`` holds uniform values for four steps. ``multisine`` is a sum of sines of equally spaced frequencies with
    random phases, of which those with a small peak are used. ``chirp`` is a sine of growing frequency. The highest
    frequency is a tenth of a cycle per step. The amplitude is the largest magnitude for each input, shape ``(m,)``.
    """
    if kind not in get_args(SignalKind):
        raise UnknownNameError.among("kind of excitation", str(kind), get_args(SignalKind))
    sizes = np.atleast_1d(as_finite("amplitude", amplitude))
    if sizes.ndim != 1 or (sizes < 0).any() or not sizes.any():
        raise InputError(f"amplitude must be numbers >= 0, not all of them 0, got {np.asarray(amplitude).tolist()}.")
    return np.stack([size * _signal(kind, horizon, rng) for size in sizes], axis=-1)


def _signal(kind: SignalKind, horizon: int, rng: np.random.Generator) -> Array:
    fastest = 0.1  # cycles per step
    if kind == "random":
        return np.asarray(np.repeat(rng.uniform(-1, 1, -(-horizon // 4)), 4)[:horizon])
    if kind == "chirp":
        steps, first = np.arange(horizon), min(1 / horizon, fastest)
        turns = first * steps + 0.5 * (fastest - first) * steps**2 / horizon
        return np.asarray(np.sin(2 * np.pi * (turns + rng.uniform())))
    cycles = np.unique(np.linspace(1, max(1, fastest * horizon), 12).round())
    t = np.arange(horizon)[:, None] / horizon
    # Of several sets of random phases, that with the smallest peak is used.
    waves = [np.sin(2 * np.pi * (cycles * t + rng.uniform(size=len(cycles)))).sum(axis=1) for _ in range(20)]
    best = min(waves, key=lambda wave: float(np.abs(wave).max()))
    return np.asarray(best / max(float(np.abs(best).max()), 1e-12))


@dataclass(frozen=True, eq=False)
class Excited(ShortRepr):
    """A controller with a signal ``(H, m)`` added to its inputs, within limits; its memory knows no signal."""

    controller: Controller
    signal: Array
    limits: Limits

    def start(self, task: Task) -> Any:
        """Return the memory of the controller before its first step."""
        return memory_of(self.controller, task)

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        """Return the input at step t, shape ``(..., m)``, and the new memory."""
        u, memory = stepped(self.controller, t, x, memory)
        return self.limits.clip(np.asarray(u) + self.signal[t]), memory


class Excitation(ShortRepr):
    """Executes random tasks of an experiment with a signal added to the inputs. Run k depends only on the seed and k.

    Args:
        kind: ``random``, ``multisine`` or ``chirp``; see :func:`excitation`.
        amplitude: the largest magnitude of the signal for each input, shape ``(m,)``, or a number.
        limits: the limits of the inputs; by default those of the controllers.
    """

    def __init__(
        self, validation: Validation, kind: SignalKind, amplitude: ArrayLike, limits: Any = None, seed: int = 0
    ) -> None:
        if getattr(validation.system, "manual", False):
            raise InputError("people execute the tasks of this system, so it cannot be run here.")
        self.validation, self.kind, self.seed = validation, kind, seed
        plan = self.plan(0)
        m = plan.model_trajectory.inputs.shape[-1]
        sizes = np.atleast_1d(as_finite("amplitude", amplitude))
        if sizes.shape not in ((1,), (m,)):
            raise ShapeError(f"amplitude must be one number for each of {m} inputs, got {sizes.tolist()}.")
        self.amplitude: Array = np.broadcast_to(sizes, (m,))
        excitation(kind, 2, self.amplitude, np.random.default_rng(0))
        limits = getattr(plan.controller, "limits", None) if limits is None else limits
        if limits is None:
            raise InputError("the controllers have no limits: give the limits within which the inputs must stay.")
        self.limits = Limits.of(limits, m)

    def plan(self, number: int) -> Plan:
        """Return the plan of a run: a random task."""
        rng = np.random.default_rng([self.seed, number, 0])
        return self.validation.plan(self.validation.space.iid(1, rng)[0])

    def run(self, number: int) -> Trajectory:
        """Execute S once and return its trajectory."""
        return self.validation.execute(self._excited(number))

    def runs(self, numbers: Iterable[int]) -> Iterator[tuple[int, Trajectory | ExecutionError]]:
        """Execute S once for each number; yield numbers with the trajectories, or with the errors of failed runs."""
        # Runs are executed together if batches of the system are exact, and are the same as alone.
        pool, waiting, stopped = SerialPool(self.validation.system), iter(numbers), None
        while stopped is None:
            plans = dict[int, Plan]()
            try:
                for number in islice(waiting, 1 + pool.ahead):
                    plans[number] = self._excited(number)
                    pool.start(number, plans[number])
            except CtxvalError as error:  # after the runs before it
                stopped = error
            if not plans:
                break
            for number, execution in pool.wait():
                try:
                    run: Trajectory | ExecutionError = self.validation.require(plans[number], execution.trajectory)
                except (ExecutionError, InputError) as error:
                    run = ExecutionError(execution.failed or str(error))
                yield number, run
        if stopped is not None:
            raise stopped

    def _excited(self, number: int) -> Plan:
        plan = self.plan(number)
        signal = excitation(self.kind, plan.task.horizon, self.amplitude, np.random.default_rng([self.seed, number, 1]))
        excited = Excited(plan.controller, signal, self.limits)
        return Plan(plan.parameters, plan.task, excited, plan.model_trajectory)
