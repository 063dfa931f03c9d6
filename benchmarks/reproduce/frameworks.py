"""The paper's Example 1, in which four frameworks compare M and S of the running example.

Two frameworks compare open loops, by whole trajectories (OLDT) or by final states (OLCD). The other two compare closed
loops, by whole trajectories (CCDT) or by final states (CuSTOM).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval import Task, Trajectory, Validation, rollout, systems
from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval.core.model import Model, linearize
from ctxval.distances import FinalState, WholeTrajectory
from ctxval.errors import ModelError
from ctxval.paper.cases import pendulum

WHOLE, FINAL = WholeTrajectory(norm=np.inf), FinalState(norm=1)
"""The distance of OLDT and CCDT, and that of OLCD and CuSTOM."""


@dataclass(frozen=True)
class PaperNumbers:
    """What the paper states, and the sizes of its experiments."""

    goal: float = 0.04  #: the goal angle of the paper's Fig. 2, rad, where CCDT is largest in the paper
    discarded: int = 5  # the paper's k in sampling and discarding
    random: int = 500  # executions of the passive searches
    arm: int = 60  # executions of the active searches
    car: int = 100
    pendulum: int = 100
    common: int = 5  # number of common first samples
    near: float = 2.5  # per cent of d*: the paper says of SC that it is so near after 60 samples
    tasks: int = 200  # random tasks that are simulated for Aspect 1
    shown: int = 0  # the seed of figures that show a single trial


PAPER = PaperNumbers()

BOUND = pendulum.Settings().torque
"""Bound of the open-loop torques, N m. It is that of the training data, so that the model does not extrapolate.

The paper leaves the torque unbounded, but then no largest open-loop distance exists. The distance grows with the bound:
if it exceeds the closed-loop distance here, it also does so with the far larger torques of the closed loops.
"""


def frameworks(seed: int = 0, *, per_axis: int = 2001, restarts: int = 64) -> dict[str, Any]:
    """Return the goal angles, and the distance between M and S in each framework, as a stored result has them.

    Those of CCDT and CuSTOM are for each goal; those of OLDT and OLCD, the same for every goal, are for each restart of
    the search, largest first.
    """
    validation = pendulum.experiment(seed).validation
    goals = validation.space.grid(per_axis)
    task = validation.task(validation.space.parameters(goals))
    on_model, on_system = closed_loops(validation, task)
    hanging = validation.task(validation.space.parameters([0.0]))
    assert isinstance(validation.system, systems.Simulated)  # as in the running example
    steps = validation.system.model, validation.model
    result: dict[str, Any] = {"goals": goals[:, 0].tolist()}
    result |= {"ccdt": WHOLE(on_model, on_system, task).tolist(), "custom": FINAL(on_model, on_system, task).tolist()}
    for name, distance in (("oldt", WHOLE), ("olcd", FINAL)):
        result[name] = worst_open_loop(*steps, hanging, BOUND, distance, restarts=restarts, seed=seed)[1].tolist()
    largest = max(float(np.abs(loop.inputs).max()) for loop in (on_model, on_system))
    return {**result, "bound": BOUND, "closed_loop_torque": largest}


def closed_loops(validation: Validation, task: Task) -> tuple[Trajectory, Trajectory]:
    """Return the closed loops on M and on S for a batch of tasks."""
    controller = validation.synthesizer.design(task, validation.model)
    on_model = systems.Simulated(validation.model).execute(controller, task)
    return on_model, validation.system.execute(controller, task)


# Open-loop validation (the paper's eq. 1): the inputs under which M and S differ the most.
#
# There is no feedback here, so the distance is maximised over all input sequences within a bound. The search follows
# the gradient to sequences at the bound. The maximum is there if M and S are linear, because the distance is then
# convex; it is mostly there if both are affine in the input, by Pontryagin's principle. Many restarts and a test of
# every single switch guard against poor local maxima. The result is a lower bound of the true maximum.

Slope = Callable[[Array, Rows], Array]
"""The subgradient W of a function of the gaps ``(..., N, H + 1, n)``, linear or a norm, which is ``sum(W * gap)``."""


def worst_open_loop(
    system: Model,
    model: Model,
    task: Task,
    bound: float,
    distance: FinalState | WholeTrajectory,
    *,
    restarts: int = 64,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Return the inputs ``(H, 1)`` within the bound under which M and S differ most, and the distances ``(R,)``.

    The distance, with norm 1 or infinity, is ``WholeTrajectory(norm=inf)`` for OLDT and ``FinalState(norm=1)`` for OLCD
    in the paper. The system is the step of a simulated S with one input. The distances are those of R improved
    sequences, largest first. Each depends only on the seed and its number, so more restarts never find less, except for
    rounding.
    """
    pair = _Pair(system, model, task, bound)
    counts = np.ones((task.horizon + 1, task.initial_state.size))
    if isinstance(distance, FinalState):
        counts[:-1] = 0.0
    first = _directions(distance.norm, counts, restarts)

    def norm(gap: Array, rows: Rows) -> Array:
        if distance.norm == 1:
            return np.sign(gap * counts) * counts
        flat = (gap * counts).reshape(*gap.shape[:-2], -1)
        largest = np.abs(flat).argmax(axis=-1)[..., None]
        chosen = np.zeros_like(flat)
        np.put_along_axis(chosen, largest, np.sign(np.take_along_axis(flat, largest, axis=-1)), axis=-1)
        return chosen.reshape(gap.shape) * counts

    # Random sequences at the bound, with few to many switches.
    sequences = []
    for r in range(restarts):
        rng = np.random.default_rng(np.random.SeedSequence([seed, r]))
        switches = rng.random((task.horizon, 1)) < rng.uniform() ** 3
        sequences.append(1.0 - 2.0 * ((rng.integers(2, size=1) + switches.cumsum(axis=0)) % 2))
    with single_threaded():
        U = np.array(sequences) * bound
        U = _ascend(pair, U, lambda gap, rows: first[rows], _by_gradient)
        U = _ascend(pair, U, norm, _by_gradient)
        U = _ascend(pair, U, norm, _by_trial)
        values = pair.values(U, norm, np.arange(restarts))
    return U[np.argmax(values)], np.sort(values)[::-1]


@dataclass(frozen=True, eq=False)
class _Pair:
    """M and S under the same inputs ``(..., H, 1)``."""

    system: Model
    model: Model
    task: Task
    bound: float

    def run(self, model: Model, U: Array) -> Trajectory:
        x = np.broadcast_to(self.task.initial_state, (*U.shape[:-2], self.task.initial_state.shape[-1]))
        task = Task(x, horizon=self.task.horizon, dt=self.task.dt)
        trajectory = rollout(model.step, lambda t, x: U[..., t, :], task)
        if not trajectory.finite.all():
            raise ModelError("M or S is not finite under inputs within the bound, so their distance has no maximum.")
        return trajectory

    def gap(self, U: Array) -> Array:
        """Return the states of S minus those of M, shape ``(..., H + 1, n)``."""
        return self.run(self.system, U).states - self.run(self.model, U).states

    def values(self, U: Array, slope: Slope, rows: Rows) -> Array:
        """Return the values of a function of the gap, shape ``(..., N)``."""
        gap = self.gap(U)
        return np.asarray((slope(gap, rows) * gap).sum(axis=(-1, -2)))

    def gradient(self, U: Array, weights: Array) -> Array:
        """Gradient of ``sum(weights * gap)`` in the inputs, by the adjoint ``l_t = w_t + A_t' l_(t+1)``."""
        of_system, of_model = np.empty_like(U), np.empty_like(U)
        for model, gradient in ((self.system, of_system), (self.model, of_model)):
            A, B = linearize(model, self.run(model, U).states[..., :-1, :], U)
            A, B = (np.broadcast_to(matrix, (*U.shape[:-1], *matrix.shape[-2:])) for matrix in (A, B))
            adjoint = weights[..., -1, None, :]
            for t in reversed(range(self.task.horizon)):
                gradient[..., t, :] = (adjoint @ B[..., t, :, :])[..., 0, :]
                adjoint = weights[..., t, None, :] + adjoint @ A[..., t, :, :]
        return of_system - of_model


def _directions(order: float, counts: Array, restarts: int) -> Array:
    """Return linear functions below a norm that the restarts maximise first, shape ``(R, H + 1, n)``.

    The norm is the maximum of such functions. For the infinity norm each of them is one state at one time, with a sign;
    for the other norm it has a sign for each state. The first few cover every state, every sign and the final time.
    """
    times, n = np.flatnonzero(counts.any(axis=1)), counts.shape[1]
    directions = np.zeros((restarts, *counts.shape))
    for r in range(restarts):
        if order == 1:
            directions[r] = [1 - 2 * (r >> j & 1) for j in range(n)]
            continue
        index, sign = divmod(r, 2)
        level, component = divmod(index, n)
        # 0, 1/2, 1/4, 3/4, 1/8, ... (van der Corput): each entry falls into the largest gap.
        share = sum((level >> j & 1) * 0.5 ** (j + 1) for j in range(level.bit_length()))
        directions[r, times[-1 - int(share * len(times))], component] = 1 - 2 * sign
    return directions * counts


def _ascend(
    pair: _Pair, U: Array, slope: Slope, proposal: Callable[[_Pair, Array, Slope, Rows], tuple[Array, Array]]
) -> Array:
    """Improve each restart's inputs ``(R, H, 1)`` until no proposal improves them, at most 200 times.

    A proposal returns a target for each entry of the inputs, and the gain of the function by that entry alone.
    """
    U, rows = U.copy(), np.arange(len(U))
    values = pair.values(U, slope, rows)
    for _ in range(200):
        if not len(rows):
            break
        targets, gains = proposal(pair, U[rows], slope, rows)
        # The 1, 2, 4, ... entries with the largest gains move all the way, or all entries move a part of the way.
        size = U[0].size
        order = np.argsort(-gains.reshape(len(rows), -1), axis=1, kind="stable")
        rank = np.argsort(order, axis=1).reshape(targets.shape)
        counts = [*(2**j for j in range(size.bit_length()) if 2**j < size), size]
        whole = [np.where(rank < count, targets, U[rows]) for count in counts]
        parts = [U[rows] + share * (targets - U[rows]) for share in 0.5 ** np.arange(1, 7)]
        candidates = np.stack([*whole, *parts])
        reached = pair.values(candidates, slope, rows)
        best, columns = reached.argmax(axis=0), np.arange(len(rows))
        improved = reached[best, columns] > values[rows] + 1e-10 * np.abs(values[rows])
        best, columns, rows = best[improved], columns[improved], rows[improved]
        U[rows], values[rows] = candidates[best, columns], reached[best, columns]
    return U


def _by_gradient(pair: _Pair, U: Array, slope: Slope, rows: Rows) -> tuple[Array, Array]:
    """Propose the bound in the direction of the gradient, as the Frank-Wolfe method does."""
    gradient = pair.gradient(U, slope(pair.gap(U), rows))
    targets = np.where(gradient == 0, U, np.copysign(pair.bound, gradient))
    return targets, gradient * (targets - U)


def _by_trial(pair: _Pair, U: Array, slope: Slope, rows: Rows) -> tuple[Array, Array]:
    """Propose the opposite bound, with the true gain of each single switch."""
    targets, gains, step = -np.copysign(pair.bound, U), [], max(1, 4096 // U[0].size)  # 4096 rollouts in one batch
    for i in range(0, len(U), step):
        batch, some = U[i : i + step], rows[i : i + step]
        switched = np.repeat(batch[None], U.shape[1], axis=0)
        entries = np.arange(U.shape[1])
        switched[entries, :, entries] = targets[i : i + step].swapaxes(0, 1)
        gains.append((pair.values(switched, slope, some) - pair.values(batch, slope, some)).T[..., None])
    return targets, np.concatenate(gains)
