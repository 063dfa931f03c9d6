"""A gymnasium environment as the true system."""

from __future__ import annotations

import contextlib
import copy
import os
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np

from ctxval._util.arrays import Array, as_floats
from ctxval._util.checked import Must, NonNegativeInt, Seconds, require
from ctxval._util.mjcf import instability, warning_of
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.registry import part
from ctxval.core.controller import Controller
from ctxval.core.task import Task
from ctxval.core.trajectory import TERMINATED, Trajectory
from ctxval.errors import InputError, ShapeError
from ctxval.systems.episode import require_one, require_started, run_episode


@part(functions={"get_state": "environment -> x", "set_state": "(environment, x)"})
class Gymnasium:
    """A gymnasium environment with continuous actions as the true system.

    An execution resets the environment with its seed, sets the task's initial state and runs the closed loop. The state
    of MuJoCo environments is ``(qpos, qvel)``; others need ``get_state`` and ``set_state``. Actions go to the
    environment unchanged, in the type of its action space; the environment clips them, and the trajectory keeps the
    unclipped inputs.

    If the environment terminates or truncates the episode, or MuJoCo warns, for instance of an unstable state, the
    trajectory ends: its remaining values are NaN and ``ended`` gives the reason, so that a campaign records a failed
    trial.

    Args:
        environment: an id such as ``"Reacher-v5"``, a function that makes an environment, or an environment, which is
            copied for executions at the same time. Of a vector environment, give the one that it repeats.
        get_state: function ``environment -> x`` of the environment without wrappers.
        set_state: function ``(environment, x)`` of the environment without wrappers; by default the first components
            of x go to MuJoCo's ``set_state``.
        dt: length of a step, seconds; by default that of the environment.
        seed: seed of every reset, so that executions are repeatable; None takes another one each time.
        ignore_termination: continue although the environment reports the end of the episode.
        options: further arguments for ``gymnasium.make`` or for the function, such as ``max_episode_steps=-1``.

    Raises:
        InputError: if the environment has no continuous actions, another dt, or no state that can be set.
    """

    def __init__(
        self,
        environment: Any,
        *,
        get_state: Callable[[Any], Any] | None = None,
        set_state: Callable[[Any, Array], None] | None = None,
        dt: Seconds | None = None,
        seed: NonNegativeInt | None = 0,
        ignore_termination: bool = False,
        **options: Any,
    ) -> None:
        self.environment, self.options = environment, options
        # Environments may be made again after the current folder has changed; other names stand for gymnasium's models.
        self._files = {
            name: os.path.abspath(value)
            for name, value in options.items()
            if isinstance(value, str) and value.startswith(("./", "../")) and os.path.exists(value)
        }
        self.get_state, self.set_state, self.seed = get_state, set_state, seed
        self.ignore_termination = ignore_termination
        self._given = hasattr(environment, "reset") and not isinstance(environment, type)
        if self._given and options:
            given = f"{', '.join(options)} for {environment}"
            raise InputError(f"options are for environments that are made, got {given}.")
        first = self._made()
        if hasattr(first, "num_envs"):
            raise InputError(f"the environment must be a single one, got {first}; give the one that it repeats.")
        if missing := [name for name in ("reset", "step", "action_space") if not hasattr(first, name)]:
            raise InputError(f"the environment must be one of gymnasium, got {first}, which has no {missing[0]}.")
        self._idle = [first]  # each execution takes its own, so that threads do not share one
        space = first.action_space
        if not np.issubdtype(space.dtype or object, np.floating) or not space.shape:
            raise InputError(f"the environment must have continuous actions, a Box, got {space}.")
        self.inputs = int(np.prod(space.shape))
        bare = first.unwrapped
        stated = getattr(bare, "dt", None)
        step: Any = stated if dt is None else dt
        positive = Must("the positive number of seconds in one step of the environment", lambda dt: 0 < dt < np.inf)
        require("dt", Annotated[float, positive], step)
        if stated is not None and not np.isclose(stated, step, rtol=1e-9, atol=0):
            raise InputError(f"dt must be that of the environment, {stated:g} s, got {step:g} s.")
        self.dt = float(step)
        is_mujoco = hasattr(bare, "set_state") and hasattr(getattr(bare, "data", None), "qpos")
        if (get_state is None or set_state is None) and not is_mujoco:
            functions = "get_state(environment) -> x and set_state(environment, x)"
            raise InputError(f"{bare} has no MuJoCo state; give the functions {functions}.")

    def describe(self) -> dict[str, Any]:
        fields = ("environment", "options", "get_state", "set_state", "seed", "ignore_termination", "dt")
        described = {name: getattr(self, name) for name in fields}
        if self._given:
            bare = self.environment.unwrapped
            described["environment"] = {"class": type(bare), "id": getattr(bare.spec, "id", None)}
        return described

    def state(self) -> Array:
        """Return the state ``(n,)`` after a reset, to see the number of states and their magnitudes."""
        environment = self._idle.pop() if self._idle else self._made()
        environment.reset(seed=self.seed)
        state = self._read(environment.unwrapped)
        self._idle.append(environment)
        return state

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        require_one(task)
        if not np.isclose(task.dt, self.dt, rtol=1e-9, atol=0):
            raise InputError(f"the task's dt must be that of the environment, {self.dt:g} s, got {task.dt:g} s.")
        environment = self._idle.pop() if self._idle else self._made()
        try:
            self._start(environment, task)
            trajectory = run_episode(lambda u: self._advance(environment, u), controller, task, self.inputs)
        except BaseException:
            with contextlib.suppress(Exception):  # the first exception is the reason to report
                environment.close()  # its state is unknown, so it is not used again
            raise
        self._idle.append(environment)
        return trajectory

    def close(self) -> None:
        """Close the environments; the next execution makes a new one."""
        while self._idle:
            self._idle.pop().close()

    def _made(self) -> Any:
        gymnasium = require_extra("gymnasium", "mujoco", "environments need")
        if self._given:
            return self.environment if not hasattr(self, "_idle") else copy.deepcopy(self.environment)
        if not isinstance(self.environment, str):
            return self.environment(**{**self.options, **self._files})
        errors = gymnasium.error.Error, ImportError, TypeError, AttributeError
        with reworded(f"the environment {self.environment!r} cannot be made", *errors):
            # The passive checker would warn of actions outside the action space, but the environment clips them.
            return gymnasium.make(self.environment, **{"disable_env_checker": True, **self.options, **self._files})

    def _start(self, environment: Any, task: Task) -> None:
        environment.reset(seed=self.seed)
        bare = environment.unwrapped
        x = np.array(task.initial_state)
        if self.set_state is not None:
            self.set_state(bare, x)
        else:
            nq, nv = len(bare.data.qpos), len(bare.data.qvel)
            if len(x) < nq + nv:
                wanted = f"{nq + nv} states, {nq} qpos and {nv} qvel"
                raise ShapeError(f"the task must have at least {wanted}, got {len(x)}.")
            bare.set_state(x[:nq], x[nq : nq + nv])
        require_started(task, self._read(bare))

    def _read(self, bare: Any) -> Array:
        if self.get_state is None:
            return np.concatenate([bare.data.qpos, bare.data.qvel])
        # A copy, because an environment may return an array that it changes later.
        return np.array(as_floats("the state of the environment", self.get_state(bare)))

    def _advance(self, environment: Any, u: Array) -> tuple[Array, str]:
        space = environment.action_space
        _, _, terminated, truncated, _ = environment.step(u.astype(space.dtype).reshape(space.shape))
        state = self._read(environment.unwrapped)
        counts = getattr(getattr(getattr(environment.unwrapped, "data", None), "warning", None), "number", None)
        if counts is not None and np.any(counts):
            name = warning_of(counts)
            return np.full_like(state, np.nan), f"{instability(name)}MuJoCo warned of {name}"
        if self.ignore_termination or not (terminated or truncated):
            return state, ""
        if terminated:
            return state, f"{TERMINATED}: the environment ended the episode"
        return state, "the environment truncated the episode"  # a time limit says nothing about the system

    def __getstate__(self) -> dict[str, Any]:
        # Environments cannot be pickled; another process makes its own.
        return {**vars(self), "_idle": []}
