"""A MuJoCo model as the model M, such as one that ``mujoco.sysid`` identified."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import Seconds, require_known
from ctxval._util.mjcf import Simulator, compile_mjcf, is_mjcf_text, quiet
from ctxval._util.refusals import require_extra
from ctxval._util.registry import part
from ctxval.core.model import paired
from ctxval.core.state_geometry import StateGeometry
from ctxval.core.trajectory import Transitions
from ctxval.core.uncertain import UncertainParameter
from ctxval.errors import InputError
from ctxval.models.mujoco_parameters import MuJoCoParameter, drawn_fields, uncertain_parameters

_CONVERGING = 100  # iterations of the solver after which a step hardly depends on its warm start: MuJoCo's default
_SYSID = "params_x_hat.yaml"  #: A file that ``mujoco.sysid.save_results`` writes beside the identified models


@part(files=("mjcf",))
class MuJoCo:
    """An MJCF model as the model M. The state is ``(qpos, qvel)`` and coordinates of sites; inputs are ``ctrl``.

    Its closed loops have a memory, as simulations have: activations, the warm start of the constraint solver, states of
    plugins. So M is exactly :class:`ctxval.systems.MuJoCo` if both have one MJCF. ``step`` predicts from a recorded
    state without memory: activations have their defaults, and the solver converges. A state at which MuJoCo warns
    (unstable state or acceleration) has no next state; it is NaN.

    Args:
        mjcf: the model as XML text, the path of its file, or the folder in which ``mujoco.sysid.save_results`` wrote
            one identified model. Its pickle files are never read.
        dt: length of a step in seconds, a multiple of the model's timestep; the timestep by default.
        data: the transitions that the model was identified from, if they are known.
        sites, axes: sites whose positions are part of the state, as in :class:`ctxval.systems.MuJoCo`.
        uncertain: standard deviations of parameters that are not known exactly, such as ``{"friction": "30 %",
            "mass[trunk]": "20 %", "frictionloss": 0.5}``; executions tell more of them. Names are ``mass``,
            ``centre_x`` (``_y``, ``_z``), ``friction``, ``damping``, ``armature``, ``frictionloss``, ``stiffness``,
            ``gain`` and ``gravity_x`` (``_y``, ``_z``), of all elements, or of those that a name or a pattern in
            brackets matches. A share multiplies them, a number in SI units is added.
        invariant: what the dynamics do not depend on: ``["x", "y", "yaw"]`` of the only free joint, on flat ground
            without walls, or names of hinges and slides. What M misses is then learned as a function of the other
            states, in the heading frame, and records need not cover these. If executions contradict, all states count.

    Raises:
        InputError: if dt is no multiple of the MJCF's time step.
    """

    uncertain: tuple[UncertainParameter, ...] = ()
    _parameters: tuple[MuJoCoParameter, ...] = ()
    _changes: tuple[Callable[[Any], None], ...] = ()  # of the compiled model
    _forces: Array | None = None  # of every step; see `changed`

    def __init__(
        self,
        mjcf: str | Path,
        *,
        dt: Seconds | None = None,
        data: Transitions | None = None,
        sites: str | Sequence[str] = (),
        axes: str = "xy",
        uncertain: Mapping[str, float | str] | None = None,
        invariant: Sequence[str] = (),
    ) -> None:
        self._mjcf = mjcf if is_mjcf_text(mjcf) else identified_in(Path(mjcf)).absolute()
        _, model = compile_mjcf(self._mjcf)
        timestep = float(model.opt.timestep)
        ratio = 1.0 if dt is None else dt / timestep
        self.substeps = round(ratio)
        if self.substeps < 1 or abs(ratio - self.substeps) > 1e-6 * max(1.0, ratio):
            raise InputError(f"dt must be a multiple of the model's timestep, {timestep:g} s, got {dt:g} s.")
        self.data, self.sites, self.axes = data, sites, axes
        self._simulate(model)
        self._geometry = _geometry_of(model, tuple(invariant), bool(self.sites))
        self._add_uncertain(uncertain or {})

    def _simulate(self, model: Any) -> None:
        self._simulator = self._converging = Simulator(model, self.substeps, self.sites, self.axes)
        if min(model.opt.iterations, 2 * model.opt.ls_iterations) < _CONVERGING:
            converging = copy.copy(model)
            converging.opt.iterations = max(model.opt.iterations, _CONVERGING)
            converging.opt.ls_iterations = max(model.opt.ls_iterations, _CONVERGING // 2)
            self._converging = Simulator(converging, self.substeps, self.sites, self.axes)

    @property
    def dt(self) -> float:
        """Length of a step, seconds."""
        return float(self.compiled.opt.timestep) * self.substeps

    @property
    def compiled(self) -> Any:
        """The compiled ``mujoco.MjModel``, which must not be changed: :meth:`changed` changes a copy."""
        return self._simulator.model

    @property
    def geometry(self) -> StateGeometry:
        """The quaternions of free and of ball joints in the state, and what the dynamics do not depend on."""
        return self._geometry

    def changed(self, change: Callable[[Any], None] | None = None, *, forces: Array | None = None) -> MuJoCo:
        """Return the model after a function has changed its compiled ``mujoco.MjModel``.

        Args:
            change: sets attributes of a copy; constants that follow from them are computed again.
            forces: forces on the degrees of freedom in every step, shape ``(nv,)``.
        """
        another = copy.copy(self)
        if change is not None:
            model = copy.copy(self.compiled)
            change(model)
            another._changes = (*self._changes, change)
            moved = (model.body_ipos != self.compiled.body_ipos).any(axis=1)
            another._simulate_changed(model, simple=not model.body_simple[moved].any())
        if forces is not None:
            another._forces = forces
        return another

    def _simulate_changed(self, model: Any, *, simple: bool) -> None:
        """Simulate a changed model, in which bodies may be simple if their centres of mass do not move."""
        mujoco = require_extra("mujoco", "mujoco", "models of MuJoCo need")
        if not simple:
            _, model = compile_mjcf(self._mjcf, simple=False)
            for change in self._changes:
                change(model)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self._simulate(model)

    def _add_uncertain(self, uncertain: Mapping[str, float | str]) -> None:
        self._parameters = (*self._parameters, *uncertain_parameters(self.compiled, uncertain))
        self.uncertain = tuple(each.prior for each in self._parameters)
        moving = (at[0] for each in self._parameters for field, at in each.places if field == "body_ipos")
        if any(self.compiled.body_simple[bodies].any() for bodies in moving):
            self._simulate_changed(self.compiled, simple=False)

    def with_uncertain(self, uncertain: Mapping[str, float | str]) -> MuJoCo:
        """Return the model with further uncertain parameters, which follow its own."""
        another = copy.copy(self)
        another._add_uncertain(uncertain)
        return another

    def drawn(self, z: Array) -> MuJoCo:
        """Return S models with standardised uncertain parameters ``(S, K)``; a draw is the first axis of states."""
        another, fields = copy.copy(self), drawn_fields(self.compiled, self._parameters, z)
        another._simulator = self._simulator.drawn(fields)
        another._converging = (
            another._simulator if self._converging is self._simulator else self._converging.drawn(fields)
        )
        return another

    def step(self, x: Array, u: Array) -> Array:
        self._simulator.require(x, u)
        x, u = paired(x, u)
        with quiet():
            return self._converging.advance(x, u, self.start(x))[0]

    def start(self, x: Array) -> Array:
        """Return the memory ``(..., k)`` of simulations that start in states ``(..., n)`` from the model's defaults."""
        return self._simulator.start(x, self._forces)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states ``(..., n)`` of simulations and their memory ``(..., k)``."""
        x, u = paired(x, u)
        with quiet():
            return self._simulator.advance(x, u, memory)[:2]


def _geometry_of(compiled: Any, invariant: tuple[str, ...], sites: bool) -> StateGeometry:
    places, kinds = compiled.jnt_qposadr.tolist(), compiled.jnt_type.tolist()
    quaternions = tuple(at + 3 * (kind == 0) for at, kind in zip(places, kinds, strict=True) if kind <= 1)
    if not invariant:
        return StateGeometry(quaternions)
    if sites or kinds.count(0) > 1:
        raise InputError("invariant states need one free joint at most, and no sites, whose places depend on them.")
    named, heading = {compiled.joint(k).name: at for k, at in enumerate(places) if kinds[k] > 1}, None
    if 0 in kinds:
        first = places[kinds.index(0)]
        named |= {"x": first, "y": first + 1, "yaw": first}
        heading = first, compiled.nq + int(compiled.jnt_dofadr[kinds.index(0)])
    require_known("invariant state", invariant, named)
    if "yaw" in invariant and not {"x", "y"} <= {*invariant}:
        raise InputError("dynamics that do not depend on yaw do not depend on x and y either: name all three.")
    of_states = tuple(named[name] for name in invariant if name != "yaw")
    return StateGeometry(quaternions, of_states, heading if "yaw" in invariant else None)


def proposed_invariant(compiled: Any) -> tuple[str, ...]:
    """Return what the dynamics do not depend on if one robot moves freely above flat ground; empty otherwise."""
    collides = (compiled.geom_contype | compiled.geom_conaffinity) != 0
    fixed = np.flatnonzero(collides & (compiled.body_weldid[compiled.geom_bodyid] == 0))
    planes = (compiled.geom_type[fixed] == 0) & (compiled.geom_bodyid[fixed] == 0)
    upright = np.abs(compiled.geom_quat[fixed, 1:3]).max(axis=1, initial=0.0) < 1e-9
    flat = bool((planes & upright).all()) and not compiled.opt.gravity[:2].any()
    return ("x", "y", "yaw") if flat and compiled.jnt_type.tolist().count(0) == 1 else ()


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
