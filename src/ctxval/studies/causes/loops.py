"""Closed loops on models with causes, and how far executions are from them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.plan import Plan
from ctxval.core.system import System, WithOutputs
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.errors import DistanceError
from ctxval.studies.causes.cause import Repaired

_DRAWS = 12  # of noise


@dataclass(frozen=True, eq=False)
class ExecutedTask(ShortRepr):
    """An executed task: its plan, what the system did, and the same with states of M if only outputs are recorded.

    Of an execution that failed, these are the steps before its failure.
    """

    plan: Plan
    executed: Trajectory
    states: Trajectory


@dataclass(frozen=True, eq=False)
class Predicted(ShortRepr):
    """What a model with causes predicts of an execution."""

    deviation: float  #: the mean squared deviation of the execution from the mean of the loops, in shares of ranges
    by_noise: Array  #: those of loops with noise from their mean, shape ``(K,)``; 0 without noise
    distance: float  #: between the execution and the mean of the loops


class ClosedLoops:
    """Executions, and the closed loops of their plans on models with causes.

    Attributes:
        without, distances: squared deviations and distances of the executions from the loops on M.
    """

    def __init__(self, validation: Validation, executions: Sequence[ExecutedTask]) -> None:
        self.validation, self.executions = validation, executions
        whole = np.concatenate([each.executed.states for each in executions])
        self.ranges = np.maximum(np.ptp(whole, axis=0), 1e-12)
        efforts = np.concatenate([each.executed.inputs for each in executions])
        self.efforts = np.maximum(np.ptp(efforts, axis=0), 1e-12)
        on_model = [each.plan.model_trajectory.first(each.executed.horizon) for each in executions]
        pairs = list(zip(executions, on_model, strict=True))
        self.without = [self._deviation(each.executed, loop) for each, loop in pairs]
        self.distances = [self._distance(each, loop) for each, loop in pairs]

    def predicted(self, repaired: Repaired, execution: ExecutedTask, noise: Array) -> Predicted:
        """Return the prediction of an execution from where it began.

        Noise of measurements acts on the system through the controller, and may move it out of dead zones and plays.
        The prediction is therefore the mean of loops with noise.

        Args:
            noise: standard deviations ``(n,)`` of white noise of the recorded states.
        """
        outputs = self.validation.outputs is not None
        loops = [] if outputs else self._noisy(repaired, execution, noise)
        if not loops:
            start = None if outputs else execution.executed.states[0]
            loop = self.of_plan(repaired, execution.plan, start, execution.executed.horizon)
            if loop is None:
                return Predicted(np.inf, np.zeros(1), np.inf)
            loops = [loop]
        count, first = len(loops), loops[0]
        states, inputs = (np.mean([getattr(loop, name) for loop in loops], axis=0) for name in ("states", "inputs"))
        mean = Trajectory(first.times, states, inputs)
        by_noise = np.array([self._deviation(loop, mean) for loop in loops]) * (count + 1) / max(count - 1, 1)
        return Predicted(self._deviation(execution.executed, mean), by_noise, self._distance(execution, mean))

    def distance_from_tasks(self, repaired: Repaired) -> float | None:
        """Return the largest distance of the executions from loops that begin where their tasks begin.

        Returns None if one of these loops fails.
        """
        loops = ((each, self.of_plan(repaired, each.plan, steps=each.executed.horizon)) for each in self.executions)
        largest = max(np.inf if loop is None else self._distance(each, loop) for each, loop in loops)
        return largest if np.isfinite(largest) else None

    def of_plan(
        self, repaired: Repaired, plan: Plan, start: Array | None = None, steps: int | None = None
    ) -> Trajectory | None:
        """Return the first steps of a plan's closed loop on a model with causes, without noise; None if it fails."""
        system: System = repaired
        if self.validation.outputs is not None:
            system = WithOutputs(repaired, self.validation.outputs)
        try:
            loop = system.execute(plan.controller, plan.task if start is None else plan.task.starting_at(start))
        except Exception:  # the user's own parts, at states that they never saw
            return None
        loop = loop.first(plan.task.horizon if steps is None else steps)
        return loop if loop.finite.all() else None

    def _noisy(self, repaired: Repaired, execution: ExecutedTask, noise: Array) -> list[Trajectory]:
        """Return loops with noise; none if there is no noise, or if one fails."""
        if not noise.any():
            return []
        plan, start = execution.plan, execution.executed.states[0]
        drawn = noise * np.random.default_rng(0).standard_normal((plan.task.horizon + 1, _DRAWS, len(noise)))

        def of(draws: int | slice) -> Trajectory:
            initial = np.broadcast_to(start, drawn[0, draws].shape)
            loop = repaired.execute(plan.controller, plan.task.starting_at(initial), drawn[:, draws])
            return loop.first(execution.executed.horizon)

        loops: list[Trajectory] = []
        with contextlib.suppress(Exception):  # the user's own parts, at states that they never saw
            first = of(0)
            with contextlib.suppress(Exception):  # a controller that takes no batch
                together = of(slice(None))
                if np.allclose(together.states[0], first.states, rtol=1e-6, atol=1e-9 * float(self.ranges.max())):
                    loops = [together[k] for k in range(_DRAWS)]
            loops = loops or [first, *(of(k) for k in range(1, _DRAWS))]
        return loops if all(loop.finite.all() for loop in loops) else []

    def _deviation(self, executed: Trajectory, loop: Trajectory) -> float:
        """Return the mean squared deviation of a loop from another one without white noise, in shares of ranges.

        White noise is what second differences over time show: the deviation that a cause makes is smooth beside it.
        """
        squares = 0.0
        for each in ((loop.states - executed.states) / self.ranges, (loop.inputs - executed.inputs) / self.efforts):
            noise = (np.diff(each, 2, axis=0) ** 2).mean(axis=0) / 6 if len(each) > 2 else 0.0
            squares += float(np.maximum((each**2).mean(axis=0) - noise, 0.0).mean())
        return squares

    def _distance(self, execution: ExecutedTask, loop: Trajectory) -> float:
        with contextlib.suppress(DistanceError):
            return float(self.validation.distance_between(loop, execution.executed, execution.plan.task))
        return np.inf
