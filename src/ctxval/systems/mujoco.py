"""A MuJoCo model as the true system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, require_shape, rows_of
from ctxval._util.checked import PositiveInt
from ctxval._util.mjcf import Simulator, compile_mjcf, instability, warning_of
from ctxval._util.registry import part
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError


@part(files=("mjcf",))
class MuJoCo:
    """An MJCF model as the true system, with feedback, for whole batches of closed loops at once.

    The state is ``(qpos, qvel)``, followed by the selected coordinates of each selected site. An execution starts from
    the model's defaults (activations, mocap bodies, ...) at the task's qpos and qvel. Inputs are MuJoCo's ``ctrl``,
    held over a step. MuJoCo clamps them to a ``ctrlrange``; the trajectory keeps the unclamped inputs.

    If MuJoCo warns (unstable state or acceleration, full contact buffer), it silently resets the simulation and
    continues. Such a simulation has failed: its states are NaN from that step on, and the trajectory's ``ended`` names
    the warning.

    Args:
        mjcf: the model as XML text, or the path of its file.
        substeps: number of MuJoCo steps in one control step; a task's dt must be the model's timestep times this.
        sites: names of sites whose positions are part of the state, such as an end effector.
        axes: world coordinates of the sites that are part of the state, letters of ``"xyz"``.
        threads: number of threads for a batch; the results do not depend on it.
    """

    batched = exact_batches = True

    def __init__(
        self,
        mjcf: str | Path,
        *,
        substeps: PositiveInt = 1,
        sites: str | Sequence[str] = (),
        axes: str = "xy",
        threads: PositiveInt = 1,
    ) -> None:
        self._digest, self._model = compile_mjcf(mjcf)
        self.substeps, self.threads = substeps, threads
        self._simulator = Simulator(self._model, substeps, sites, axes, threads)
        self.sites, self.axes = self._simulator.sites, axes

    @property
    def dt(self) -> float:
        """Length of a control step, seconds."""
        return float(self._model.opt.timestep) * self.substeps

    def describe(self) -> dict[str, Any]:
        return {"mjcf": self._digest, "substeps": self.substeps, "sites": self.sites, "axes": self.axes}

    def state(self, qpos: ArrayLike, qvel: ArrayLike | None = None) -> Array:
        """Return the complete states for configurations ``(..., nq)`` and velocities ``(..., nv)``, zero by default."""
        positions = require_shape("qpos", as_finite("qpos", qpos), (self._model.nq,))
        velocities = np.zeros(self._model.nv) if qvel is None else as_finite("qvel", qvel)
        require_shape("qvel", velocities, (self._model.nv,))
        batch = np.broadcast_shapes(positions.shape[:-1], velocities.shape[:-1])
        parts = [np.broadcast_to(part, (*batch, part.shape[-1])) for part in (positions, velocities)]
        return self._simulator.observed(np.concatenate(parts, axis=-1))

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        if not np.isclose(task.dt, self.dt, rtol=1e-9, atol=0):
            wanted = f"{self._model.opt.timestep:g} s x {self.substeps} = {self.dt:g} s"
            raise InputError(f"the task's dt must be the model's timestep times substeps, {wanted}, got {task.dt:g} s.")
        self._require_start(task.initial_state)
        memory, steps, failure = self._simulator.start(task.initial_state), 0, ""

        def step(x: Array, u: Array) -> Array:
            nonlocal memory, steps, failure
            if u.shape[-1] != self._model.nu:
                raise ShapeError(f"the controller must return the model's {self._model.nu} inputs, got {u.shape[-1]}.")
            steps += 1
            if not (failure or (np.isfinite(u).all(axis=-1) | np.isnan(x).any(axis=-1)).all()):
                failure = f"an input is not finite at step {steps}"
            x, memory, warned = self._simulator.advance(x, u, memory)
            if warned.any() and not failure:
                name = warning_of(warned.reshape(-1, warned.shape[-1]).any(axis=0))
                failure = f"{instability(name)}MuJoCo warned of {name} at step {steps}"
            return x

        trajectory = rollout(step, controller, task)
        return replace(trajectory, ended=failure or trajectory.ended)

    def _require_start(self, x: Array) -> None:
        nq, nv = self._model.nq, self._model.nv
        sites = self._simulator.states - nq - nv
        if x.shape[-1] != nq + nv + sites:
            wanted = f"{nq + nv + sites} states, {nq} qpos, {nv} qvel and {sites} coordinates of sites"
            raise ShapeError(f"the task must have {wanted}, got {x.shape[-1]}.")
        if sites:
            given, actual = (rows_of(states)[:, nq + nv :] for states in (x, self._simulator.observed(x)))
            misses = np.abs(given - actual).max(axis=1)
            if misses.max() > 1e-6:  # metres
                wanted, got = (part[misses.argmax()].tolist() for part in (actual, given))
                sentence = f"the initial state must end with the sites' positions at its qpos, {wanted}, got {got}"
                raise InputError(f"{sentence}; state(qpos, qvel) returns the whole state.")
