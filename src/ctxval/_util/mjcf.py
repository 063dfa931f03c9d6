"""MJCF models of MuJoCo, for systems and for models; needs mujoco (extra ``mujoco``)."""

from __future__ import annotations

import copy
import hashlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, rows_of
from ctxval._util.checked import require_known
from ctxval._util.files import read_bytes
from ctxval._util.refusals import require_extra, reworded
from ctxval.errors import InputError, ShapeError


def is_mjcf_text(mjcf: str | Path) -> bool:
    return isinstance(mjcf, str) and "<" in mjcf


def compile_mjcf(mjcf: str | Path, *, simple: bool = True) -> tuple[str, Any]:
    """Return the digest of a model's files, and the compiled ``mujoco.MjModel``.

    MuJoCo takes bodies whose centre of mass is the origin of their joints as simple; these centres cannot move.
    """
    mujoco = require_extra("mujoco", "mujoco", "models of MuJoCo need")
    with reworded(f"the MuJoCo model {str(mjcf)!r} cannot be read", InputError):
        digest, is_text = digest_of(mjcf), is_mjcf_text(mjcf)
    with reworded("MuJoCo cannot compile the model", ValueError):
        if simple:
            loader = mujoco.MjModel
            return digest, loader.from_xml_string(str(mjcf)) if is_text else loader.from_xml_path(str(mjcf))
        spec = mujoco.MjSpec.from_string(str(mjcf)) if is_text else mujoco.MjSpec.from_file(str(mjcf))
        for body in spec.bodies:
            body.simple = 0
        return digest, spec.compile()


class Simulator:
    """Simulations of a compiled model, whose states are ``(qpos, qvel)`` and chosen coordinates of sites.

    The memory of a simulation is its whole state of integration: activations, the warm start of the constraint solver,
    states of plugins, histories of inputs. A step follows from state, input and memory alone, in any batch.
    """

    def __init__(
        self, model: Any, substeps: int = 1, sites: str | Sequence[str] = (), axes: str = "xy", threads: int = 1
    ) -> None:
        self.model, self.substeps, self.threads = model, substeps, threads
        self.sites, self.axes = (sites,) if isinstance(sites, str) else tuple(sites), axes
        if not axes or not set(axes) <= set("xyz"):
            raise InputError(f"axes must be letters of 'xyz', got {axes!r}.")
        known = [model.site(i).name for i in range(model.nsite)]
        require_known("site", self.sites, known)
        # The indices of the coordinates of sites in positions (nsite, 3).
        rows = np.array([known.index(site) for site in self.sites], dtype=np.intp)
        self._coordinates = np.ix_(rows, np.array(["xyz".index(axis) for axis in axes], dtype=np.intp))
        self._idle: dict[int, list[_Batch]] = {}  # batches by their number of simulations; making one costs 10 steps
        # Fields of the model with a value for each draw, (S, ...), and the simulator of the model itself.
        self._drawn: Mapping[str, Array] = {}
        self._given = self

    def drawn(self, fields: Mapping[str, Array]) -> Simulator:
        """Return simulations of S models that differ in fields ``(S, ...)``; a draw is the first axis of states."""
        another = copy.copy(self)
        another._idle, another._drawn = {}, fields
        return another

    @property
    def states(self) -> int:
        """The number of states."""
        return int(self.model.nq + self.model.nv + self._coordinates[0].size * self._coordinates[1].size)

    @contextmanager
    def _batch(self, count: int) -> Iterator[_Batch]:
        size = max(count, 1) if self._drawn else 1 << (count - 1).bit_length() if count else 1
        idle = self._idle.setdefault(size, [])
        try:
            batch = idle.pop()
        except IndexError:
            batch = _Batch(self.model, size, self.threads)
            for name, values in self._drawn.items():
                batch.batch.expand(name)[:] = np.repeat(values, size // len(values), axis=0)
            if self._drawn:
                batch.batch.set_const()
        batch.warning[:] = 0
        yield batch
        idle.append(batch)

    def start(self, x: Array, forces: Array | None = None) -> Array:
        """Return the memory ``(..., k)`` of simulations that start from the model's defaults in states ``(..., n)``."""
        if self._drawn:
            return self._given.start(x, forces)
        rows, nq = rows_of(x), self.model.nq
        with self._batch(1) as batch:
            batch.batch.reset(stage=batch.nothing)
            if forces is not None:
                batch.batch.bind("qfrc_applied")[:] = forces
            memory = np.repeat(batch.state[:1], len(rows), axis=0)
        with self._batch(len(rows)) as batch:
            batch.state[: len(rows)] = memory
            batch.qpos[: len(rows)], batch.qvel[: len(rows)] = rows[:, :nq], rows[:, nq : nq + self.model.nv]
            return batch.state[: len(rows)].reshape(*x.shape[:-1], -1).copy()

    def require(self, x: Array, u: Array) -> None:
        """Refuse other numbers of states or inputs than those of the model."""
        nq, nv, nu = self.model.nq, self.model.nv, self.model.nu
        if x.shape[-1] != self.states or u.shape[-1] != nu:
            got = f"{x.shape[-1]} states and {u.shape[-1]} inputs"
            sites = f", {self.states - nq - nv} coordinates of sites" if self.sites else ""
            raise ShapeError(f"the model has {nq} qpos, {nv} qvel{sites} and {nu} inputs, got {got}.")

    def observed(self, x: Array) -> Array:
        """Return whole states ``(..., n)`` of states that begin with qpos and qvel, with the sites where they are."""
        rows = rows_of(self.start(x))
        with self._batch(len(rows)) as batch:
            batch.state[: len(rows)] = rows
            batch.batch.forward(np.arange(len(rows)), stage=batch.positions)
            return self._observed(batch, len(rows)).reshape(*x.shape[:-1], -1)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array, Mask]:
        """Return next states ``(..., n)``, NaN after a warning or if x or u is not finite, memory and warnings.

        The warnings ``(..., 7)`` of MuJoCo are booleans.
        """
        self.require(x, u)
        nq, nv = self.model.nq, self.model.nv
        states, inputs, memories = map(rows_of, (x, u, memory))
        count = len(states)
        healthy = np.asarray(np.isfinite(states).all(axis=1) & np.isfinite(inputs).all(axis=1))
        ids = np.flatnonzero(healthy)
        rows = slice(count) if len(ids) == count else ids  # views are faster than copies
        with self._batch(count) as batch:
            batch.state[:count] = memories
            batch.qpos[rows], batch.qvel[rows] = states[rows, :nq], states[rows, nq : nq + nv]
            batch.ctrl[rows] = inputs[rows]
            if len(ids):
                batch.batch.step(ids, self.substeps, batch.positions if self.sites else batch.nothing)
            warned: Mask = np.asarray(batch.warning[:count, :, 1] > 0)
            reached = self._observed(batch, count)
            following = batch.state[:count].copy()
        reached[~healthy | warned.any(axis=1)] = np.nan
        shape = x.shape[:-1]
        return reached.reshape(x.shape), following.reshape(*shape, -1), warned.reshape(*shape, -1)

    def _observed(self, batch: _Batch, count: int) -> Array:
        parts = [batch.qpos[:count], batch.qvel[:count]]
        if self.sites:
            sites, axes = self._coordinates
            parts.append(batch.site_positions[:count, sites, axes].reshape(count, -1))
        return np.concatenate(parts, axis=1)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_idle": {}}


class _Batch:
    """Simulations with the arrays that they share: state ``(N, k)``, of which qpos, qvel and ctrl are views."""

    def __init__(self, model: Any, count: int, threads: int) -> None:
        from mujoco import mjtStage
        from mujoco.batch import Batch

        self.batch = Batch(model, count, threads)
        self.qpos, self.qvel, self.ctrl = (self.batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self.site_positions: Array = self.batch.bind("site_xpos")  # (N, nsite, 3)
        self.state: Array = self.batch.state
        self.warning: Array = self.batch.warning
        self.nothing, self.positions = int(mjtStage.mjSTAGE_NONE), int(mjtStage.mjSTAGE_POS)


@contextmanager
def quiet() -> Iterator[None]:
    """Let MuJoCo print no warnings, and write none to a file ``MUJOCO_LOG.TXT``, while its caller counts them."""
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def warning_of(counts: Any) -> str:
    """Return the name of the first warning of MuJoCo whose count is not 0."""
    from mujoco import mjtWarning

    return str(mjtWarning(int(np.argmax(np.asarray(counts) > 0))).name.removeprefix("mjWARN_"))


def instability(warning: str) -> str:
    """Return how the reason of an end begins: an unstable state is an outcome, and a full buffer of contacts is not."""
    return "terminated: " if warning.startswith("BADQ") else ""


def digest_of(file: str | Path) -> str:
    """Return the digest of an MJCF or a URDF and of the files that it names: other models, meshes, height fields."""
    text, home = (str(file).encode(), Path()) if is_mjcf_text(file) else (read_bytes(file), Path(file).parent)
    digest, waiting, folders, known = hashlib.sha256(), [text], {home}, set[Path]()
    while waiting:
        text = waiting.pop()
        digest.update(hashlib.sha256(text).digest())
        folders |= {home / os.fsdecode(name) for name in _FOLDERS.findall(text)}
        named = {folder / os.fsdecode(name) for folder in folders for name in _FILES.findall(text)}
        files = sorted(path for path in named - known if path.is_file())
        known |= named
        waiting += map(read_bytes, files)
    return digest.hexdigest()[:16]


_FILES = re.compile(rb"""\bfile(?:name)?\s*=\s*["']([^"'\0]+)""")
_FOLDERS = re.compile(rb"""\b(?:mesh|asset)dir\s*=\s*["']([^"'\0]+)""")
