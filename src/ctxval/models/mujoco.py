"""A MuJoCo model as the model M, such as one that ``mujoco.sysid`` identified."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.checked import Seconds
from ctxval._util.mjcf import compile_mjcf, is_mjcf_text, quiet
from ctxval._util.refusals import require_extra
from ctxval._util.registry import part
from ctxval.core.model import paired
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError

_SYSID = "params_x_hat.yaml"  #: A file that ``mujoco.sysid.save_results`` writes beside the identified models


@part(files=("mjcf",))
class MuJoCo:
    """An MJCF model as the model M. The state is ``(qpos, qvel)``, and the input is MuJoCo's ``ctrl``.

    A step is a function of state and input alone: it starts without activations and without a warm start of the
    constraint solver. A state at which MuJoCo warns (unstable state or acceleration) has no next state; it is NaN.

    Args:
        mjcf: the model as XML text, the path of its file, or the folder in which ``mujoco.sysid.save_results`` wrote
            one identified model. Its pickle files are never read.
        dt: length of a step in seconds, a multiple of the model's timestep; the timestep by default.
        data: the transitions that the model was identified from, if they are known.
    """

    _forces: Array | None = None  # of every step; see `changed`

    def __init__(self, mjcf: str | Path, *, dt: Seconds | None = None, data: Transitions | None = None) -> None:
        _, self._model = compile_mjcf(mjcf if is_mjcf_text(mjcf) else identified_in(Path(mjcf)))
        timestep = float(self._model.opt.timestep)
        ratio = 1.0 if dt is None else dt / timestep
        self.substeps = round(ratio)
        if self.substeps < 1 or abs(ratio - self.substeps) > 1e-6 * max(1.0, ratio):
            raise InputError(f"dt must be a multiple of the model's timestep, {timestep:g} s, got {dt:g} s.")
        self.data = data
        if (na := self._model.na) > 0:
            raise InputError(f"the model has {na} activations, which are no part of the state (qpos, qvel).")

    @property
    def dt(self) -> float:
        """Length of a step, seconds."""
        return float(self._model.opt.timestep) * self.substeps

    @property
    def compiled(self) -> Any:
        """The compiled ``mujoco.MjModel``, which must not be changed: :meth:`changed` changes a copy."""
        return self._model

    def changed(self, change: Callable[[Any], None] | None = None, *, forces: Array | None = None) -> MuJoCo:
        """Return the model after a function has changed its compiled ``mujoco.MjModel``.

        Args:
            change: sets attributes of a copy; constants that follow from them are computed again.
            forces: forces on the degrees of freedom in every step, shape ``(nv,)``.
        """
        another = copy.copy(self)
        if change is not None:
            mujoco = require_extra("mujoco", "mujoco", "models of MuJoCo need")
            another._model = copy.copy(self._model)
            change(another._model)
            mujoco.mj_setConst(another._model, mujoco.MjData(another._model))
        if forces is not None:
            another._forces = forces
        return another

    def step(self, x: Array, u: Array) -> Array:
        model, nq = self._model, self._model.nq
        if (x.shape[-1], u.shape[-1]) != (nq + model.nv, model.nu):
            got = f"{x.shape[-1]} states and {u.shape[-1]} inputs"
            raise ShapeError(f"the model has {nq} qpos, {model.nv} qvel and {model.nu} inputs, got {got}.")
        batch = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        states, inputs = map(rows_of, paired(x, u))
        reached = np.full(states.shape, np.nan)
        mujoco = require_extra("mujoco", "mujoco", "models of MuJoCo need")
        data = mujoco.MjData(model)
        with quiet():
            for k in np.flatnonzero(np.isfinite(states).all(axis=1) & np.isfinite(inputs).all(axis=1)).tolist():
                mujoco.mj_resetData(model, data)
                data.qpos, data.qvel, data.ctrl = states[k, :nq], states[k, nq:], inputs[k]
                if self._forces is not None:
                    data.qfrc_applied = self._forces
                mujoco.mj_step(model, data, self.substeps)
                if not data.warning.number.any():
                    reached[k] = np.concatenate([data.qpos, data.qvel])
        return reached.reshape(*batch, -1)


def identified_in(path: Path) -> Path:
    """Return the file of a model: the path itself, or the only identified model in a folder of ``mujoco.sysid``."""
    if not path.is_dir():
        return path
    models = sorted(path.glob("*.xml"))
    if not is_sysid_result(path) or not models:
        raise InputError(f"the folder {path} has no result of mujoco.sysid: {_SYSID} and an XML file are needed.")
    if len(models) > 1:
        names = ", ".join(file.name for file in models)
        raise InputError(f"the folder {path} has several identified models, {names}: name one of the files.")
    return models[0]


def is_sysid_result(path: Path) -> bool:
    """Return whether a path is a folder that ``mujoco.sysid.save_results`` wrote."""
    return path.is_dir() and (path / _SYSID).is_file()
