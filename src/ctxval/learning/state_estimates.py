"""States of M along executions of which outputs are recorded, so that what M misses can be learned.

The learned dynamics need states. Each execution gets those that M, its recorded inputs and its recorded outputs make
most probable, by an extended Kalman smoother; the recorded outputs are reproduced. How much M misses in what is
recorded, beside what it misses in the other states, is chosen by how well the filter predicts the next outputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.kalman import Estimate, corrected, predicted, smoothed
from ctxval.core.model import Model
from ctxval.core.system import Outputs
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.prediction import Executed
from ctxval.models.corrected import before_refinement
from ctxval.models.increments import standard_deviations


class RecordedStates:
    """The states of M along executions, if they are recorded."""

    def of(self, executed: Executed, judged: int) -> list[Trajectory]:
        """Return the executions as they are."""
        return [trajectory for _, trajectory in executed]


class StateEstimates:
    """The states of M along executions, estimated from their inputs and outputs; they are kept like these.

    A refined model is estimated as the model before, whose residual is learned. States of closed loops on M
    ``(..., H + 1, n)`` have typical changes in one step. What M misses in recorded directions is one of the ``shares``
    of what it misses in all others, in units of their steps.
    """

    def __init__(
        self,
        validation: Validation,
        outputs: Outputs,
        states: Array,
        shares: Sequence[float] = (1.0, 1e-1, 1e-2, 1e-3, 1e-4),
    ) -> None:
        self.validation, self.outputs, self.shares = validation, outputs, np.array(shares)
        changes = np.diff(states, axis=-2).reshape(-1, states.shape[-1])
        steps = standard_deviations(changes[np.isfinite(changes).all(axis=1)])
        self.steps = np.maximum(steps, 1e-9 * max(float(steps.max(initial=0.0)), 1e-300))
        self._known: WeakKeyDictionary[Trajectory, tuple[Array, Array]] = WeakKeyDictionary()

    def of(self, executed: Executed, judged: int) -> list[Trajectory] | None:
        """Return the executions, points of the unit cube with recorded outputs, with states ``(H + 1, n)``.

        The first ``judged`` of them choose how much M misses in what is recorded. It is None if some states cannot be
        estimated, because M or its outputs are not defined or not finite there.
        """
        space, model = self.validation.space, before_refinement(self.validation.model)
        try:
            with np.errstate(all="ignore"):
                for point, trajectory in executed:
                    if trajectory not in self._known:
                        task = self.validation.task(space.parameters(space.from_unit(point)))
                        start = np.asarray(task.initial_state, dtype=np.float64)
                        recorded = trajectory.states, trajectory.inputs
                        self._known[trajectory] = smoothed_states(
                            model, self.outputs, start, *recorded, self.steps, self.shares
                        )
        except Exception:  # the user's parts, at states that M never reaches by itself
            return None
        known = [(*self._known[trajectory], trajectory) for _, trajectory in executed]
        if not known:
            return []
        errors = np.sum([np.log(np.maximum(errors, 1e-300)) for _, errors, _ in known[: max(judged, 1)]], axis=(0, 2))
        finite = np.all([np.isfinite(states).all(axis=(0, 2)) for states, _, _ in known], axis=0)
        if not finite.any():
            return None
        chosen, estimated = int(np.argmin(np.where(finite & np.isfinite(errors), errors, np.inf))), []
        for states, _, trajectory in known:
            # The last states are left out, because only later outputs would show them.
            end = min(-(-states.shape[-1] // trajectory.states.shape[-1]) - 1, trajectory.horizon - 1)
            kept, times = trajectory.horizon - end, trajectory.times
            estimated.append(Trajectory(times[: kept + 1], states[: kept + 1, chosen], trajectory.inputs[:kept]))
        return estimated


States = RecordedStates | StateEstimates


def smoothed_states(
    model: Model, outputs: Outputs, start: Array, y: Array, u: Array, steps: Array, shares: Array
) -> tuple[Array, Array]:
    """Return the most probable states of a model with these inputs and outputs, and how well outputs are predicted.

    These are states ``(H + 1, k, n)``, and mean squared innovations ``(k, p)``, for each of k shares of what the model
    misses in recorded directions. They begin at a state ``(n,)`` before the first of the outputs y ``(H + 1, p)``
    correct it, have inputs u ``(H, m)``, and change by typical steps ``(n,)``.
    """
    k, scale = len(shares), np.diag(steps)
    C = outputs.jacobian(start) @ scale
    # The recorded directions of the space in which each state is measured in its steps.
    recorded = np.linalg.pinv(C) @ C
    roots = shares[:, None, None] * recorded + np.eye(len(steps)) - recorded
    process = scale @ roots @ np.swapaxes(roots, -1, -2) @ scale
    spreads = np.sqrt(np.maximum(np.einsum("ij,ij->i", C, C), 1e-300))
    # Error of the recorded outputs, as a share of their smallest step: they are reproduced.
    measurement = np.diag((1e-6 * shares[-1] * spreads) ** 2)
    inputs = np.repeat(u[:, None], k, axis=1)
    known, _ = corrected(outputs, Estimate(np.repeat(start[None], k, axis=0), process), y[0], measurement)
    steps_back, innovations = list[tuple[Estimate, Array, Estimate]](), list[Array]()
    for t in range(len(u)):
        before, (prior, A) = known, predicted(model, known, inputs[t], process)
        known, innovation = corrected(outputs, prior, y[t + 1], measurement)
        steps_back.append((before, A, prior))
        innovations.append(innovation)
    states = [known.mean]
    for step_back in reversed(steps_back):
        states.append(smoothed(*step_back, states[-1]))
    return np.stack(states[::-1]), np.square(innovations).mean(axis=0)
