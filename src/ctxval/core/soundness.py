"""Whether controllers are sound on the model: whether they flip, saturate, and bring M to its goals.

Reports ask this of executed tasks, and ``ctxval check --aspect1`` of simulated ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.core.controller import Limits, Synthesizer
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation

MISSED = 0.1  # M misses its goal if it ends farther away than this, as a share of the range of a state

SATURATED = 0.01  # least share of steps at a limit that is worth a note


@dataclass(frozen=True)
class Flips:
    """How much the controllers of neighbouring tasks differ."""

    pairs: int  # of neighbouring tasks
    flipped: int  # pairs whose controllers differ abruptly
    largest: float  # the largest difference between their inputs on M, as a share of the range of the inputs
    example: tuple[int, int]  # the tasks of the pair with the largest difference; of a flipped pair, if there is one


def flips(points: Array, inputs: Sequence[Array]) -> Flips | None:
    """Return how much the inputs on M, ``(H, m)``, of neighbouring tasks ``(N, d)`` differ; None if there are none.

    Neighbours are nearer than a tenth of the diagonal of the task space. A pair flips if the inputs differ at some time
    by more than half of their range, and as signals by more than half of the sum of their norms, so that two
    controllers that only leave a limit at another time are alike.
    """
    near = scipy.spatial.KDTree(points / np.sqrt(points.shape[1])).query_pairs(0.1)
    pairs = [(i, j) for i, j in sorted(near) if inputs[i].shape == inputs[j].shape and inputs[i].size]
    if not pairs:
        return None
    spans = ranges(inputs)
    changes, flipped = list[float](), list[bool]()
    for i, j in pairs:
        changes.append(float((np.abs(inputs[i] - inputs[j]) / spans).max()))
        sizes = float(np.linalg.norm(inputs[i] / spans) + np.linalg.norm(inputs[j] / spans))
        contrast = float(np.linalg.norm((inputs[i] - inputs[j]) / spans)) / sizes if sizes > 0 else 0.0
        flipped.append(changes[-1] > 0.5 and contrast > 0.5)
    largest = max(range(len(pairs)), key=lambda k: (flipped[k], changes[k]))
    return Flips(len(pairs), sum(flipped), changes[largest], pairs[largest])


@dataclass(frozen=True, eq=False)
class InputSaturation:
    """How often inputs are at their limits: the share of the steps for each input, shape ``(m,)``."""

    shares: Array
    known: bool  # whether the synthesizer states the limits; otherwise they are taken from the inputs themselves


def saturation(inputs: Sequence[Array], synthesizer: Synthesizer | None) -> InputSaturation | None:
    """Return how often inputs are at their limits; None if there are no inputs.

    The inputs of each task have shape ``(H, m)``. If the synthesizer has no attribute ``limits``, or is not known, the
    extreme values of all tasks are taken to be limits in those tasks that stay there for three steps.
    """
    signals = [signal for signal in inputs if signal.size]
    if not signals:
        return None
    together = np.concatenate(signals)
    spans, given = np.maximum(np.ptp(together, axis=0), 1e-300), getattr(synthesizer, "limits", None)
    if given is not None:
        limits = Limits.of(given, together.shape[-1])
        at_limit = (together <= limits.low + 1e-6 * spans) | (together >= limits.high - 1e-6 * spans)
        return InputSaturation(at_limit.mean(axis=0), True)
    low, high = together.min(axis=0) + 1e-9 * spans, together.max(axis=0) - 1e-9 * spans
    ends = [(signal <= low, signal >= high) for signal in signals]
    held = [np.logical_or(*(at & (at.sum(axis=0) >= 3) for at in at_ends)) & (low < high) for at_ends in ends]
    return InputSaturation(np.concatenate(held).mean(axis=0), False)


@dataclass(frozen=True, eq=False)
class GoalMisses:
    """How far M ends from the goals of tasks, in the k states that its controllers bring to a goal and d compares."""

    states: Rows
    misses: Array  # errors of final states, ``(N, k)``
    shares: Array  # these over the range of each state in all tasks

    @property
    def missed(self) -> Mask:
        """The tasks in which M misses its goal, shape ``(N,)``."""
        return np.asarray(self.shares.max(axis=1) > MISSED)

    @property
    def worst(self) -> tuple[int, int, float]:
        """The task and the state with the largest share, and the error of this final state."""
        row, column = np.unravel_index(int(self.shares.argmax()), self.shares.shape)
        return int(row), int(self.states[column]), float(self.misses[row, column])


def goal_misses(validation: Validation, on_model: Sequence[Trajectory], goals: Sequence[Array]) -> GoalMisses | None:
    """Return how far trajectories of M end from their goals ``(n,)``; None if no state is known to have a goal."""
    aimed = aimed_states(validation, on_model[0].states.shape[-1])
    if not len(aimed):
        return None
    spans = ranges([trajectory.states for trajectory in on_model])[aimed]
    ends = np.array([trajectory.final_state for trajectory in on_model])
    misses = np.abs(ends - np.array(goals))[:, aimed]
    return GoalMisses(aimed, misses, misses / spans)


def aimed_states(validation: Validation, count: int) -> Rows:
    """Return the indices of the states, of ``count``, that controllers bring to their goals; none if it is not known.

    The weights ``Q_final`` or ``Q`` of the synthesizer's attribute ``cost`` show them. If the distance compares some
    states only (``components``), the others are left out.
    """
    cost = getattr(validation.synthesizer, "cost", None)
    weights = getattr(cost, "Q_final", getattr(cost, "Q", None))
    if weights is None or np.shape(weights) != (count, count):
        return np.empty(0, dtype=np.intp)
    compared = getattr(validation.distance, "components", None)
    aimed = np.diag(weights) > 0
    if compared is not None:
        # An index that no state has is left to the distance, which refuses it.
        aimed = aimed & np.isin(np.arange(count), [index + count * (index < 0) for index in compared])
    return np.flatnonzero(aimed)


def ranges(parts: Sequence[Array]) -> Array:
    """Return the range of each column over arrays ``(H, k)``, shape ``(k,)``; it is never 0."""
    ends = np.array([[part.min(axis=0), part.max(axis=0)] for part in parts if part.size])
    return np.asarray(np.maximum(ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0), 1e-300))
