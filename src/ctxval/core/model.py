"""The learned model M, and its linearisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, TypeGuard, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array, as_floats, rows_of
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError, ModelError, ShapeError

if TYPE_CHECKING:
    from ctxval.core.trajectory import Trajectory, Transitions

Step = Callable[[Array, Array], Array]


@runtime_checkable
class Model(Protocol):
    """A learned abstraction M of the system, cheap to run.

    A model may also have ``jacobian(x, u) -> (A, B)``, shapes ``(..., n, n)`` and ``(..., n, m)``. If the Jacobian does
    not depend on x and u, its batch axes may be missing.
    """

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""


@runtime_checkable
class ModelWithMemory(Model, Protocol):
    """A model whose next state depends on earlier steps too, such as on activations or the warm start of a solver.

    Each closed loop has a memory of its own, an array ``(..., k)`` with the batch axes of the states. ``step`` predicts
    one step from a recorded state alone.
    """

    def start(self, x: Array) -> Array:
        """Return the memory ``(..., k)`` of closed loops that start in states ``(..., n)``."""

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the pair of the next states ``(..., n)`` and the new memory ``(..., k)``; arguments stay unchanged."""


def has_memory(model: object) -> TypeGuard[ModelWithMemory]:
    """Return whether a model is a :class:`ModelWithMemory`; to ask Python for its protocol takes 0.1 ms."""
    return all(hasattr(model, name) for name in ("step", "start", "advance"))


def memory_in(model: Model, x: Array) -> Array:
    """Return the memory of a model at the start of closed loops in states ``(..., n)``; ``(..., 0)`` if it has none."""
    if not has_memory(model):
        return np.empty((*x.shape[:-1], 0))
    memory = np.array(model.start(x), dtype=np.float64)
    if memory.shape[:-1] != x.shape[:-1] or not memory.ndim:
        wanted = ", ".join([*map(str, x.shape[:-1]), "k"]) + "," * (x.ndim == 1)
        raise ShapeError(f"start of the model must return a memory of shape ({wanted}), got {memory.shape}.")
    return memory


def advanced(model: Model, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
    """Return the next states of a model with memory or without, and its new memory."""
    return model.advance(x, u, memory) if has_memory(model) else (model.step(x, u), memory)


def run_of(model: Model, x: Array) -> Step:
    """Return the steps of a closed loop that starts in states ``(..., n)``; each run has a memory of its own."""
    memory = memory_in(model, x)
    if not memory.shape[-1]:
        return model.step

    def step(x: Array, u: Array) -> Array:
        nonlocal memory
        x_next, memory = advanced(model, x, u, memory)
        return x_next

    return step


def predicted_steps(model: Model, recorded: Transitions) -> Array:
    """Return the next states ``(N, n)`` that a model predicts for recorded transitions, with its memory if recorded."""
    memory = recorded.memory
    if memory is None or not has_memory(model):
        return model.step(recorded.x, recorded.u)
    rows = np.flatnonzero(~np.isnan(memory).any(axis=1))
    if len(rows) == len(memory):
        return advanced(model, recorded.x, recorded.u, memory)[0]
    predicted = np.array(model.step(recorded.x, recorded.u))
    predicted[rows] = advanced(model, recorded.x[rows], recorded.u[rows], memory[rows])[0]
    return predicted


def with_memory(model: Model, recorded: Trajectory, *, started: bool = True) -> Transitions:
    """Return the transitions of a trajectory with the memory that a model has if it follows the recorded states.

    The memory of the first step is not known if the system was not ``started`` there.
    """
    transitions, memory = recorded.transitions(), memory_in(model, recorded.states[..., 0, :])
    if not memory.shape[-1]:
        return transitions
    memories = []
    for t in range(recorded.horizon):
        memories.append(np.array(memory) if t or started else np.full_like(memory, np.nan))
        memory = advanced(model, recorded.states[..., t, :], recorded.inputs[..., t, :], memory)[1]
    return replace(transitions, memory=rows_of(np.stack(memories, axis=-2)))


@part(functions={"step": "(x, u) -> x_next"})
class Function(ShortRepr):
    """A plain function ``(x, u) -> x_next`` of one state ``(n,)`` and one input ``(m,)`` as a model.

    A vectorized one takes whole batches ``(..., n)`` and ``(..., m)``.
    """

    def __init__(self, step: Step, *, vectorized: bool = False) -> None:
        self.function = step
        self.vectorized = vectorized

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        if self.vectorized or x.ndim == 1:
            return as_floats("states of a step", self.function(x, u))
        states, inputs = paired(x, u)
        pairs = zip(rows_of(states), rows_of(inputs), strict=True)
        rows = [as_floats("states of a step", self.function(xi, ui)) for xi, ui in pairs]
        return np.stack(rows).reshape(*states.shape[:-1], -1)


def paired(x: Array, u: Array) -> tuple[Array, Array]:
    """Return states ``(..., n)`` and inputs ``(..., m)`` with the same batch axes."""
    batch = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
    return np.broadcast_to(x, (*batch, x.shape[-1])), np.broadcast_to(u, (*batch, u.shape[-1]))


def as_model(model: Model | Step, *, vectorized: bool = False) -> Model:
    """Return a model unchanged, and a plain function as a model."""
    return model if isinstance(model, Model) else Function(model, vectorized=vectorized)


def require_time_step(model: object, dt: float, whose: str) -> None:
    """Refuse a model whose own ``dt``, or that of its ``data``, is not the step of what it is used with."""
    step = getattr(model, "dt", None) or getattr(getattr(model, "data", None), "dt", None)
    if isinstance(step, int | float) and not np.isclose(step, dt, rtol=1e-3, atol=0):
        steps = f"steps of {step:g} s and {whose} has steps of {dt:g} s"
        raise InputError(f"the model has {steps}: use a model of these steps.")


def linearize(model: Model, x: Array, u: Array) -> tuple[Array, Array]:
    """Return the Jacobians A = df/dx and B = df/du of a model at (x, u), by its ``jacobian`` or by central differences.

    Shapes ``(..., n), (..., m) -> (..., n, n), (..., n, m)``; a constant Jacobian may have no batch axes.

    Raises:
        ModelError: if a Jacobian is not finite, or a step has another shape.
    """
    jacobian = getattr(model, "jacobian", None)

    def step(x: Array, u: Array) -> Array:
        reached = model.step(x, u)
        if np.shape(reached) != np.shape(x):
            raise ModelError(f"step of the model must return states of shape {np.shape(x)}, got {np.shape(reached)}.")
        return reached

    pair = jacobian(x, u) if jacobian is not None else central_differences(step, x, u)
    A, B = (as_floats("the model's Jacobian", each) for each in pair)
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise ModelError("the model's Jacobian is not finite along its own trajectory.")
    return A, B


def central_differences(step: Step, x: Array, u: Array, precision: float | None = None) -> tuple[Array, Array]:
    """Return A ``(..., p, n)`` and B ``(..., p, m)`` at states ``(..., n)`` and inputs ``(..., m)`` by differences.

    The steps suit the precision of the function, which is found out if it is not given: 6e-6 in double precision, 5e-3
    in single precision. All differences are taken in one batch, in blocks that fit into the processor's cache. Complex
    steps would be silently wrong wherever a model uses ``abs``, ``maximum`` or a branch.
    """
    n, width, batch = x.shape[-1], x.shape[-1] + u.shape[-1], x.shape[:-1]
    z = np.concatenate([x, u], axis=-1).reshape(-1, width)
    # The cube root of the precision balances truncation against rounding.
    h = np.cbrt(_precision(step, z, n) if precision is None else precision) * np.maximum(1.0, np.abs(z))
    size = max(1, 4096 // (2 * width))
    columns, derivatives = np.arange(width), []
    for first in range(0, max(1, len(z)), size):
        rows, steps = z[first : first + size], h[first : first + size].T
        moved = np.empty((2, width, *rows.shape))
        moved[:] = rows
        moved[0, columns, :, columns] += steps
        moved[1, columns, :, columns] -= steps
        points = moved.reshape(-1, width)
        states, inputs = np.ascontiguousarray(points[:, :n]), np.ascontiguousarray(points[:, n:])
        reached = np.asarray(step(states, inputs))
        up, down = reached.reshape(2, width, len(rows), reached.shape[-1])
        derivatives.append(np.swapaxes((up - down) / (2 * steps)[:, :, None], 0, 1))
    whole = np.swapaxes(np.concatenate(derivatives), -1, -2).reshape(*batch, reached.shape[-1], width)
    return whole[..., :n], whole[..., n:]


def _precision(step: Step, z: Array, n: int) -> float:
    """Return the relative rounding of a model's numbers: that of single precision if it loses a change of 1e-8.

    A change a thousand times as large shows how much the model should change. Most points decide, as few are next to a
    kink.
    """
    some = z[:: max(1, len(z) // 3)][:3]
    # A change that single precision hardly resolves, and one that it does.
    size, little, much = np.maximum(1.0, np.abs(some)), 2.0**-27, 2.0**-17
    moved = np.concatenate([some, some + little * size, some - much * size, some + much * size])
    still, fine, down, up = np.split(np.asarray(step(moved[:, :n], moved[:, n:])), 4)
    with np.errstate(all="ignore"):  # a model that is not finite is refused later
        expected = (up - down) * (0.5 * little / much)
        margin = 1e-3 * np.abs(expected) + 1e-5 * little * np.abs(still).max(initial=0.0)
        lost = np.abs(fine - still - expected) > margin
    single = lost.any(axis=1).sum() > len(some) / 2
    return float(np.finfo(np.float32 if single else np.float64).eps)
