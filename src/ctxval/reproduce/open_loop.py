"""Open-loop validation (the paper's eq. 1): the inputs under which M and S differ the most.

There is no feedback here, so the distance is maximised over all input sequences within a bound. The search follows the
gradient to sequences at the bound. The maximum is there if M and S are linear, because the distance is then convex; it
is mostly there if both are affine in the input, by Pontryagin's principle. Many restarts and a test of every single
switch guard against poor local maxima. The result is a lower bound of the true maximum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows, as_finite, single_threaded, vector_norm
from ctxval._util.checked import NonNegativeInt, PositiveInt, checked
from ctxval.core.model import Model, Step, as_model, linearize
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.distances import FinalState, WholeTrajectory
from ctxval.distances.base import require_indices
from ctxval.errors import InputError, ModelError


@dataclass(frozen=True, eq=False)
class OpenLoopWorst:
    """The largest distance found between the open-loop trajectories of M and S.

    Attributes:
        distance: the largest distance, a lower bound of the paper's eq. 1.
        inputs: a sequence of inputs with this distance, shape ``(H, m)``.
        model_trajectory, system_trajectory: the trajectories of M and S under these inputs.
        restarts: the final distance of each restart, largest first, shape ``(R,)``.
    """

    distance: float
    inputs: Array
    model_trajectory: Trajectory
    system_trajectory: Trajectory
    restarts: Array


@checked
def worst_open_loop(
    system: Model | Step,
    model: Model | Step,
    task: Task,
    bound: ArrayLike,
    distance: FinalState | WholeTrajectory,
    *,
    restarts: PositiveInt = 64,
    seed: NonNegativeInt = 0,
    iterations: PositiveInt = 200,
) -> OpenLoopWorst:
    """Maximise the distance between M and S over the inputs ``|u| <= bound``, from the task's initial state.

    With ``WholeTrajectory(norm=inf)`` it is the paper's OLDT, with ``FinalState(norm=1)`` its OLCD. A restart depends
    only on the seed and on its own number, so that more restarts never find less, except for rounding.

    Args:
        system: the step of a simulated S, which is the ``model`` of ``systems.Simulated``.
        model: the model M.
        task: one task; its goal is ignored.
        bound: bound of each input's magnitude, shape ``(m,)``, or a number for one input.
        distance: the distance to maximise.
        restarts: number R of sequences that are improved.
        seed: seed of the first sequences.
        iterations: largest number of improvements of one sequence in each of the three passes of the search.
    """
    pair = _Pair(as_model(system), as_model(model), task, np.atleast_1d(as_finite("bound", bound)))
    norm = _Norm.of(distance, task)
    with single_threaded():
        U = _first_inputs(pair, restarts, seed)
        U = _ascend(pair, U, _Fixed(norm.directions(restarts)), _by_gradient, iterations)
        U = _ascend(pair, U, norm, _by_gradient, iterations)
        U = _ascend(pair, U, norm, _by_trial, iterations)
        values = norm.value(pair.gap(U), np.arange(restarts))
    best = U[np.argmax(values)]
    return OpenLoopWorst(
        float(values.max()), best, pair.run(pair.model, best), pair.run(pair.system, best), np.sort(values)[::-1]
    )


class _Pair:
    """M and S under the same inputs ``(..., H, m)``."""

    def __init__(self, system: Model, model: Model, task: Task, bound: Array) -> None:
        self.system, self.model, self.task, self.bound = system, model, task, bound
        self.shape = (task.horizon, len(bound))

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

    def gradient(self, U: Array, weights: Array) -> Array:
        """Gradient of ``sum(weights * gap)`` with respect to the inputs, shape ``(..., H, m)``."""
        return self._pulled_back(self.system, U, weights) - self._pulled_back(self.model, U, weights)

    def _pulled_back(self, model: Model, U: Array, weights: Array) -> Array:
        """Propagate the weights of the states back to the inputs by the adjoint ``l_t = w_t + A_t' l_(t+1)``."""
        A, B = linearize(model, self.run(model, U).states[..., :-1, :], U)
        A = np.broadcast_to(A, (*U.shape[:-1], *A.shape[-2:]))
        B = np.broadcast_to(B, (*U.shape[:-1], *B.shape[-2:]))
        gradient = np.empty_like(U)
        adjoint = weights[..., -1, None, :]
        for t in reversed(range(self.task.horizon)):
            gradient[..., t, :] = (adjoint @ B[..., t, :, :])[..., 0, :]
            adjoint = weights[..., t, None, :] + adjoint @ A[..., t, :, :]
        return gradient


# Objectives: convex functions of the gap (..., N, H + 1, n) of the restarts ``rows``, and a subgradient of each


@dataclass(frozen=True, eq=False)
class _Fixed:
    """One linear function of the gap for each restart, ``W`` of shape ``(R, H + 1, n)``."""

    W: Array

    def value(self, gap: Array, rows: Rows) -> Array:
        return np.asarray((self.W[rows] * gap).sum(axis=(-1, -2)))

    def weights(self, gap: Array, rows: Rows) -> Array:
        return self.W[rows]


@dataclass(frozen=True, eq=False)
class _Norm:
    """The norm of the gap's entries, each times its factor; the factor is zero for entries that do not count."""

    order: float
    factors: Array

    @staticmethod
    def of(distance: FinalState | WholeTrajectory, task: Task) -> _Norm:
        if not isinstance(distance, FinalState | WholeTrajectory):
            raise InputError(f"open-loop validation needs a FinalState or WholeTrajectory distance, got {distance!r}.")
        if len(distance.angles):
            raise InputError("open-loop validation needs a distance without angles, which are no linear function.")
        factors = np.zeros((task.horizon + 1, task.initial_state.shape[-1]))
        states = range(factors.shape[-1]) if distance.components is None else distance.components
        components = require_indices("components", states, factors.shape[-1])
        if isinstance(distance, FinalState):
            factors[-1, components] = 1.0
        else:
            factors[:, components] = 1 / task.horizon if distance.per_step else 1.0
        if distance.factors is not None:
            factors[:, components] *= distance.factors
        return _Norm(distance.norm, factors)

    def value(self, gap: Array, rows: Rows) -> Array:
        return vector_norm(self._flat(gap), self.order)

    def weights(self, gap: Array, rows: Rows) -> Array:
        return _dual(self._flat(gap), self.order).reshape(gap.shape) * self.factors

    def _flat(self, gap: Array) -> Array:
        return (gap * self.factors).reshape(*gap.shape[:-2], -1)

    def directions(self, count: int) -> Array:
        """Return the linear functions below the norm that the restarts maximise first, shape ``(R, H + 1, n)``.

        The norm is the maximum of such functions. For the infinity norm each of them is one state at one time, with a
        sign; for the other norms it has a sign for each state. The first few cover every state, every sign and the
        final time.
        """
        times, components = np.flatnonzero(self.factors.any(axis=1)), np.flatnonzero(self.factors.any(axis=0))
        directions = np.zeros((count, *self.factors.shape))
        for r in range(count):
            if self.order == np.inf:
                index, sign = divmod(r, 2)
                level, component = divmod(index, len(components))
                # 0, 1/2, 1/4, 3/4, 1/8, ... (van der Corput): each entry falls into the largest gap.
                share = sum((level >> j & 1) * 0.5 ** (j + 1) for j in range(level.bit_length()))
                time = times[-1 - int(share * len(times))]
                directions[r, time, components[component]] = 1 - 2 * sign
            else:
                directions[r, :, components] = np.array([[1 - 2 * (r >> j & 1)] for j in range(len(components))])
        return directions * self.factors


def _dual(vectors: Array, order: float) -> Array:
    """Return vectors w of unit dual norm with ``w'v = ||v||``."""
    if order == 1:
        return np.sign(vectors)
    if order == np.inf:
        largest = np.abs(vectors).argmax(axis=-1)[..., None]
        chosen = np.zeros_like(vectors)
        np.put_along_axis(chosen, largest, np.sign(np.take_along_axis(vectors, largest, axis=-1)), axis=-1)
        return chosen
    norms = vector_norm(vectors, 2)[..., None]
    return np.divide(vectors, norms, out=np.zeros_like(vectors), where=norms > 0)


# Maximisation

_Objective = _Fixed | _Norm
# A proposal returns a target for each entry of the inputs, and the gain of the objective by that entry alone.
_Proposal = Callable[[_Pair, Array, _Objective, Rows], tuple[Array, Array]]


def _first_inputs(pair: _Pair, restarts: int, seed: int) -> Array:
    """Return random sequences at the bound, with few to many switches, shape ``(R, H, m)``."""
    sequences = []
    for r in range(restarts):
        rng = np.random.default_rng(np.random.SeedSequence([seed, r]))
        switches = rng.random(pair.shape) < rng.uniform() ** 3
        start = rng.integers(2, size=pair.shape[1])
        sequences.append(1.0 - 2.0 * ((start + switches.cumsum(axis=0)) % 2))
    return np.array(sequences) * pair.bound


def _ascend(pair: _Pair, U: Array, objective: _Objective, proposal: _Proposal, iterations: int) -> Array:
    """Improve each restart's inputs ``(R, H, m)`` until no proposal improves them."""
    U = U.copy()
    rows = np.arange(len(U))
    values = objective.value(pair.gap(U), rows)
    for _ in range(iterations):
        if not len(rows):
            break
        candidates = _moves(U[rows], *proposal(pair, U[rows], objective, rows))
        reached = objective.value(pair.gap(candidates), rows)
        best, columns = reached.argmax(axis=0), np.arange(len(rows))
        improved = reached[best, columns] > values[rows] + 1e-10 * np.abs(values[rows])
        best, columns, rows = best[improved], columns[improved], rows[improved]
        U[rows], values[rows] = candidates[best, columns], reached[best, columns]
    return U


def _moves(U: Array, targets: Array, gains: Array) -> Array:
    """Return moves of the inputs towards the targets, shape ``(K, N, H, m)``.

    Either the 1, 2, 4, ... entries with the largest gains move all the way, or all entries move a part of the way.
    """
    size = U[0].size
    order = np.argsort(-gains.reshape(len(U), -1), axis=1, kind="stable")
    rank = np.argsort(order, axis=1).reshape(U.shape)
    counts = [*(2**j for j in range(size.bit_length()) if 2**j < size), size]
    whole = [np.where(rank < count, targets, U) for count in counts]
    return np.stack([*whole, *(U + share * (targets - U) for share in 0.5 ** np.arange(1, 7))])


def _by_gradient(pair: _Pair, U: Array, objective: _Objective, rows: Rows) -> tuple[Array, Array]:
    """Propose the bound in the direction of the gradient, as the Frank-Wolfe method does."""
    gradient = pair.gradient(U, objective.weights(pair.gap(U), rows))
    targets = np.where(gradient == 0, U, np.copysign(pair.bound, gradient))
    return targets, gradient * (targets - U)


def _by_trial(pair: _Pair, U: Array, objective: _Objective, rows: Rows) -> tuple[Array, Array]:
    """Propose the opposite bound, with the true gain of each single switch."""
    targets = -np.copysign(pair.bound, U)
    step = max(1, 4096 // U[0].size)  # rollouts in one batch
    gains = []
    for i in range(0, len(U), step):
        batch, some = U[i : i + step], rows[i : i + step]
        flat = batch.reshape(len(batch), -1)
        entries = np.arange(flat.shape[1])
        trials = np.repeat(flat[None], len(entries), axis=0)
        trials[entries, :, entries] = targets[i : i + step].reshape(flat.shape).T
        switched = objective.value(pair.gap(trials.reshape(-1, *batch.shape)), some)
        gains.append((switched - objective.value(pair.gap(batch), some)).T.reshape(batch.shape))
    return targets, np.concatenate(gains)
