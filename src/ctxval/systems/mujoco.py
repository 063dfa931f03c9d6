"""A MuJoCo model as the true system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, as_finite, require_shape
from ctxval._util.checked import PositiveInt, require_known
from ctxval._util.mjcf import compile_mjcf, warning_of
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
        self.sites, self.axes = (sites,) if isinstance(sites, str) else tuple(sites), axes
        if not axes or not set(axes) <= set("xyz"):
            raise InputError(f"axes must be letters of 'xyz', got {axes!r}.")
        known = [self._model.site(i).name for i in range(self._model.nsite)]
        require_known("site", self.sites, known)
        # The indices of the coordinates of sites in positions (nsite, 3).
        rows = np.array([known.index(site) for site in self.sites], dtype=np.intp)
        self._coordinates = np.ix_(rows, np.array(["xyz".index(axis) for axis in axes], dtype=np.intp))

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
        simulations = _Batch(self._model, int(np.prod(batch)), 1)
        simulations.qpos[:] = np.broadcast_to(positions, (*batch, self._model.nq)).reshape(-1, self._model.nq)
        simulations.qvel[:] = np.broadcast_to(velocities, (*batch, self._model.nv)).reshape(-1, self._model.nv)
        simulations.locate()
        return self._observed(simulations).reshape(*batch, -1)

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        if not np.isclose(task.dt, self.dt, rtol=1e-9, atol=0):
            wanted = f"{self._model.opt.timestep:g} s x {self.substeps} = {self.dt:g} s"
            raise InputError(f"the task's dt must be the model's timestep times substeps, {wanted}, got {task.dt:g} s.")
        from mujoco import mjtStage

        simulations, steps, failure = self._started(task), 0, ""
        stage = int(mjtStage.mjSTAGE_POS if self.sites else mjtStage.mjSTAGE_NONE)  # whether sites are located
        ctrl, healthy = simulations.ctrl, np.ones(len(simulations.qpos), dtype=bool)

        def mark(failed: Mask, reason: str) -> None:
            nonlocal failure
            if (failed & healthy).any():
                failure = failure or f"{reason} at step {steps}"
                healthy[failed] = False

        def step(x: Array, u: Array) -> Array:
            nonlocal steps
            if u.shape[-1] != ctrl.shape[1]:
                raise ShapeError(f"the controller must return the model's {ctrl.shape[1]} inputs, got {u.shape[-1]}.")
            inputs = u.reshape(ctrl.shape)
            steps += 1
            mark(np.asarray(~np.isfinite(inputs).all(axis=1)), "an input is not finite")
            ctrl[healthy] = inputs[healthy]
            ids = None if healthy.all() else np.flatnonzero(healthy)
            simulations.batch.step(ids, self.substeps, stage)
            warned: Mask = np.asarray(simulations.batch.warning[:, :, 1] > 0)
            if warned.any():
                mark(np.asarray(warned.any(axis=1)), f"MuJoCo warned of {warning_of(warned.any(axis=0))}")
            states = self._observed(simulations)
            states[~healthy] = np.nan
            return states.reshape(x.shape)

        trajectory = rollout(step, controller, task)
        return replace(trajectory, ended=failure or trajectory.ended)

    def _started(self, task: Task) -> _Batch:
        nq, nv, sites = self._model.nq, self._model.nv, self._coordinates[0].size * self._coordinates[1].size
        states = task.initial_state.reshape(-1, task.initial_state.shape[-1])
        if states.shape[1] != nq + nv + sites:
            wanted = f"{nq + nv + sites} states, {nq} qpos, {nv} qvel and {sites} coordinates of sites"
            raise ShapeError(f"the task must have {wanted}, got {states.shape[1]}.")
        simulations = _Batch(self._model, len(states), self.threads)
        simulations.qpos[:], simulations.qvel[:] = states[:, :nq], states[:, nq : nq + nv]
        if sites:
            simulations.locate()
            given, actual = states[:, nq + nv :], self._observed(simulations)[:, nq + nv :]
            misses = np.abs(given - actual).max(axis=1)
            if misses.max() > 1e-6:  # metres
                wanted, got = (part[misses.argmax()].tolist() for part in (actual, given))
                sentence = f"the initial state must end with the sites' positions at its qpos, {wanted}, got {got}"
                raise InputError(f"{sentence}; state(qpos, qvel) returns the whole state.")
        return simulations

    def _observed(self, simulations: _Batch) -> Array:
        sites, axes = self._coordinates
        positions = simulations.site_positions[:, sites, axes]
        return np.concatenate([simulations.qpos, simulations.qvel, positions.reshape(len(positions), -1)], axis=1)


class _Batch:
    """Simulations of one model: qpos ``(N, nq)``, qvel ``(N, nv)``, ctrl ``(N, nu)``, sites ``(N, nsite, 3)``."""

    def __init__(self, model: Any, count: int, threads: int) -> None:
        from mujoco.batch import Batch

        self.batch = Batch(model, count, threads)
        self.qpos, self.qvel, self.ctrl = (self.batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self.site_positions: Array = self.batch.bind("site_xpos")

    def locate(self) -> None:
        from mujoco import mjtStage

        self.batch.forward(stage=int(mjtStage.mjSTAGE_POS))
