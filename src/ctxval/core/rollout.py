"""The closed loop: a controller on a model or on any step function, whole batches at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctxval._util.arrays import as_floats
from ctxval._util.texts import reason_of
from ctxval.core.controller import Controller, started
from ctxval.core.model import Model, Step, run_of
from ctxval.core.task import Task
from ctxval.core.trajectory import ENORMOUS, Trajectory
from ctxval.errors import CtxvalError, ShapeError


def rollout(model: Model | Step, controller: Controller, task: Task, *, partial: bool = False) -> Trajectory:
    """Run a controller in closed loop with a model, or with ``x_next = step(x, u)``, over the task's horizon.

    A loop that diverges continues with NaN and infinity; it does not stop the other loops of its batch. If it may be
    ``partial``, an exception of the user's parts after the first step ends the trajectory before it.

    Raises:
        ShapeError: if controller or step return another shape.
    """
    with np.errstate(all="ignore"):
        x = np.array(task.initial_state)
        step = run_of(model, x) if isinstance(model, Model) else model
        pi = started(controller, task)
        u = as_floats("inputs of a controller", pi(0, x.copy()))
        if u.shape[:-1] != x.shape[:-1] or u.ndim != x.ndim:
            wanted = ", ".join([*map(str, x.shape[:-1]), "m"]) + "," * (x.ndim == 1)
            raise ShapeError(f"the controller must return inputs of shape ({wanted}), got {u.shape}.")
        states = np.empty((task.horizon + 1, *x.shape))
        inputs = np.empty((task.horizon, *u.shape))
        states[0], of_states, of_inputs = x, x.shape, u.shape
        try:
            for t in range(task.horizon):
                if t:
                    # A controller or a step that works in place may not change what was recorded.
                    u = as_floats("inputs of a controller", pi(t, x.copy()))
                if u.shape != of_inputs:
                    wanted = f"inputs of shape {of_inputs} at every step"
                    raise ShapeError(f"the controller must return {wanted}, got {u.shape}.")
                inputs[t] = u
                x = as_floats("states of a step", step(x, inputs[t].copy()))
                if x.shape != of_states:
                    wanted = f"from states of shape {of_states} must return the same shape"
                    raise ShapeError(f"a step {wanted}, got {x.shape}.")
                states[t + 1] = x
        except CtxvalError:
            raise
        except Exception as error:
            if not (partial and t):
                raise
            known = np.moveaxis(states[: t + 1], 0, -2), np.moveaxis(inputs[:t], 0, -2)
            return Trajectory(task.times[: t + 1], *known, reason_of(error))
    trajectory = Trajectory(task.times, np.moveaxis(states, 0, -2), np.moveaxis(inputs, 0, -2))
    if trajectory.finite.all():
        return trajectory
    flat = states.reshape(task.horizon + 1, -1)
    bad = ~np.isfinite(flat).all(axis=1)
    first = int(bad.argmax()) if bad.any() else task.horizon
    # NaN for a state that is a number is the controller's doing, unless the loop grew beyond all numbers.
    ordinary = np.abs(flat[:first]).max(axis=1) < ENORMOUS
    without = ordinary & np.isnan(inputs.reshape(task.horizon, -1)[:first]).any(axis=1)
    if without.any():
        return replace(trajectory, ended=f"got NaN from its controller at step {without.argmax()}")
    return replace(trajectory, ended=f"diverged at step {first}" if bad.any() else "not finite in its inputs")
