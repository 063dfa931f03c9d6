"""One closed loop on a system that keeps its own state and is advanced step by step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval._util.arrays import Array, as_floats
from ctxval.core.controller import Controller, started
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, TERMINATED, Trajectory
from ctxval.errors import InputError, ShapeError

Advance = Callable[[Array], tuple[Array, str]]  # u -> (x_next, why the episode ended), empty if it continues


def run_episode(advance: Advance, controller: Controller, task: Task, inputs: int) -> Trajectory:
    """Run a controller over the task's horizon, or until a step returns a reason why the episode has ended.

    All values after that step are NaN, and the reason is the trajectory's ``ended``. An episode that ends with the last
    step of the horizon is complete.
    """
    pi, x = started(controller, task), np.array(task.initial_state)
    states, applied = np.full((task.horizon + 1, len(x)), np.nan), np.full((task.horizon, inputs), np.nan)
    states[0] = x
    for t in range(task.horizon):
        u = as_floats("inputs of a controller", pi(t, x.copy()))
        if u.shape != (inputs,):
            wanted = f"the system's {inputs} inputs, shape ({inputs},)"
            raise ShapeError(f"the controller must return {wanted}, got {u.shape}.")
        applied[t] = u
        x, reason = advance(u) if np.isfinite(u).all() else (np.full_like(x, np.nan), "an input is not finite")
        states[t + 1] = x = as_floats("states of the system", x)
        if not np.isfinite(x).all():
            reason = reason or f"{TERMINATED}: the state is not finite"
        elif t + 1 == task.horizon:
            reason = ""
        if reason:
            return Trajectory(task.times, states, applied, f"{reason} at step {t + 1}")
    return Trajectory(task.times, states, applied, COMPLETE)


def require_one(task: Task) -> None:
    """Refuse a batch of tasks."""
    if task.batch_shape:
        raise ShapeError(f"this system executes one task at a time, got a batch of shape {task.batch_shape}.")


def require_started(task: Task, state: Array) -> None:
    """Check that a system is in the task's initial state."""
    wanted = task.initial_state
    if state.shape != wanted.shape:
        raise ShapeError(f"the task must have the system's {state.size} states, got {wanted.size}.")
    if not (np.abs(state - wanted) <= 1e-6 * np.maximum(1.0, np.abs(wanted))).all():
        raise InputError(f"the system was set to the initial state {wanted.tolist()}, but stands at {state.tolist()}.")
