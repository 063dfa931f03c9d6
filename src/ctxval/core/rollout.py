"""The closed loop: a controller on a model or on any step function, whole batches at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from ctxval.core.model import Step
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import ShapeError


def rollout(step: Step, controller: Controller, task: Task) -> Trajectory:
    """Run a controller in closed loop with ``x_next = step(x, u)`` over the task's horizon.

    A loop that diverges continues with NaN and infinity; it does not stop the other loops of its batch.

    Args:
        step: ``x_next = step(x, u)``.
        controller: ``u = controller(t, x)``.
        task: one task, or a batch.
    """
    with np.errstate(all="ignore"):
        x = np.array(task.initial_state)
        u = _first_input(controller, x)
        states = np.empty((task.horizon + 1, *x.shape))
        inputs = np.empty((task.horizon, *u.shape))
        states[0] = x
        for t in range(task.horizon):
            if t:
                u = controller(t, x)
                # Anything but an array of the right shape is looked at closely, for checks take as long as small steps.
                if type(u) is not np.ndarray or u.shape != inputs.shape[1:]:
                    u = _require_input(u, inputs[0])
            inputs[t] = u
            x = step(x, inputs[t])
            if type(x) is not np.ndarray or x.shape != states.shape[1:]:
                _require_state(x, states[t])
            states[t + 1] = x
    trajectory = Trajectory(task.times, np.moveaxis(states, 0, -2), np.moveaxis(inputs, 0, -2))
    if trajectory.finite.all():
        return trajectory
    bad = ~np.isfinite(states).reshape(task.horizon + 1, -1).all(axis=1)
    return replace(trajectory, ended=f"diverged at step {bad.argmax()}" if bad.any() else "not finite in its inputs")


def _first_input(controller: Controller, x: Array) -> Array:
    u = np.asarray(controller(0, x), dtype=np.float64)
    if u.shape[:-1] != x.shape[:-1] or u.ndim != x.ndim:
        raise ShapeError(f"the controller must return inputs of shape {(*x.shape[:-1], 'm')}, got {u.shape}.")
    return u


def _require_input(u: Array, first: Array) -> Array:
    if np.shape(u) != first.shape:
        raise ShapeError(f"the controller must return inputs of shape {first.shape} at every step, got {np.shape(u)}.")
    return u


def _require_state(x_next: Array, x: Array) -> None:
    if np.shape(x_next) != x.shape:
        raise ShapeError(f"a step from states of shape {x.shape} must return the same shape, got {np.shape(x_next)}.")
