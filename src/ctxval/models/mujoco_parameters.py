"""Uncertain parameters of MuJoCo models: which fields of the compiled model a name stands for."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.core.uncertain import UncertainParameter, prior_of
from ctxval.errors import InputError


@dataclass(frozen=True)
class _Quantity:
    """A quantity of elements of a model: what is multiplied or added to."""

    element: str  #: ``body``, ``geom``, ``joint``, ``actuator`` or, without a name, ``model``
    fields: tuple[tuple[str, tuple[int, ...]], ...]  #: fields, and the components of each; all of them if none is named
    ratio_only: bool = False  #: whether only ratios make sense, because several numbers scale together


_QUANTITIES = {
    "mass": _Quantity("body", (("body_mass", ()), ("body_inertia", ())), True),
    "centre_x": _Quantity("body", (("body_ipos", (0,)),)),
    "centre_y": _Quantity("body", (("body_ipos", (1,)),)),
    "centre_z": _Quantity("body", (("body_ipos", (2,)),)),
    "friction": _Quantity("geom", (("geom_friction", (0,)),)),
    "damping": _Quantity("joint", (("dof_damping", ()),)),
    "armature": _Quantity("joint", (("dof_armature", ()),)),
    "frictionloss": _Quantity("joint", (("dof_frictionloss", ()),)),
    "stiffness": _Quantity("joint", (("jnt_stiffness", ()),)),
    "gain": _Quantity("actuator", (("actuator_gainprm", (0,)), ("actuator_biasprm", (1, 2))), True),
    "gravity_x": _Quantity("model", (("opt.gravity", (0,)),)),
    "gravity_y": _Quantity("model", (("opt.gravity", (1,)),)),
    "gravity_z": _Quantity("model", (("opt.gravity", (2,)),)),
}
_NAME = re.compile(r"(?P<quantity>\w+)(\[(?P<elements>.+)\])?")
_SIGNED = ("centre", "gravity")  # quantities that may be negative


@dataclass(frozen=True)
class MuJoCoParameter:
    """An uncertain parameter of a model of MuJoCo, with the places of the compiled model that it changes."""

    prior: UncertainParameter  #: of the factor of all places, with the value 1, or of what is added to them, with 0
    places: tuple[tuple[str, tuple[Any, ...]], ...]  #: fields with the indices of the values that change

    def change(self, fields: dict[str, Array], z: Array) -> None:
        """Change fields ``(S, ...)`` as standardised values ``(S,)`` of the parameter say."""
        values = self.prior.at(z)
        for field, at in self.places:
            old = fields[field][(slice(None), *at)]
            of_draws = values.reshape(-1, *[1] * (old.ndim - 1))
            if self.prior.relative:
                fields[field][(slice(None), *at)] = old * of_draws
            else:  # a friction, a stiffness and an armature are not negative
                low = -np.inf if self.prior.name.startswith(_SIGNED) else 0.0
                fields[field][(slice(None), *at)] = np.maximum(old + of_draws, low)


def uncertain_parameters(compiled: Any, given: Mapping[str, float | str]) -> tuple[MuJoCoParameter, ...]:
    """Return the parameters of a ``mujoco.MjModel`` that a table of deviations names.

    Args:
        compiled: the model.
        given: deviations by name: ``"friction"`` for all geoms, ``"mass[trunk]"`` for a body, ``"damping[FR_*]"`` for
            joints whose names match; a number in SI units, or a share as ``"20 %"``. Without a name, a number is of the
            joints that actuators drive, if there are any.
    """
    return tuple(_parameter(compiled, name, deviation) for name, deviation in given.items())


def _parameter(compiled: Any, name: str, deviation: float | str) -> MuJoCoParameter:
    match = _NAME.fullmatch(name)
    quantity = _QUANTITIES.get(match["quantity"]) if match else None
    if match is None or quantity is None:
        known = ", ".join(_QUANTITIES)
        raise InputError(f"{name!r} is no uncertain parameter of a MuJoCo model: {known}, each also as mass[name].")
    relative = str(deviation).strip().endswith("%")
    if quantity.ratio_only and not relative:
        raise InputError(f"the deviation of {name!r} must be a share as '20 %', got {deviation!r}.")
    rows = _rows(compiled, quantity.element, match["elements"], name, relative)
    places = []
    for field, components in quantity.fields:
        values = _values(compiled, field)
        at: tuple[Any, ...] = (_of_field(compiled, field, rows),)
        if components:
            at = at if values.ndim > 1 else ()
            at = (*(each[:, None] for each in at), np.array(components))
        if relative and not np.any(values[at]):
            continue
        places.append((field, at))
    if not places:
        raise InputError(f"{name!r} is 0 in the model, so its deviation must be a number, got {deviation!r}.")
    prior = prior_of(name, 1.0 if relative else 0.0, deviation)
    return MuJoCoParameter(prior, tuple(places))


def _values(compiled: Any, field: str) -> Array:
    return np.asarray(compiled.opt.gravity if field == "opt.gravity" else getattr(compiled, field))


def _of_field(compiled: Any, field: str, rows: Rows) -> Rows:
    """Return the rows of a field for the rows of elements: joints have one row for each degree of freedom."""
    if field.startswith("dof_"):
        return np.flatnonzero(np.isin(compiled.dof_jntid, rows))
    return rows


def _rows(compiled: Any, element: str, pattern: str | None, name: str, relative: bool) -> Rows:
    if element == "model":
        return np.arange(1)
    if element == "joint" and pattern is None and not relative and compiled.nu:
        # What is added to all joints is not added to a floating base.
        return np.unique(compiled.actuator_trnid[compiled.actuator_trntype == 0, 0]).astype(np.intp)
    count = {"body": compiled.nbody, "geom": compiled.ngeom, "joint": compiled.njnt, "actuator": compiled.nu}[element]
    names: Sequence[str] = [getattr(compiled, element)(k).name for k in range(count)]
    first = 1 if element == "body" else 0  # the world has no mass
    rows = [k for k in range(first, count) if pattern is None or fnmatch.fnmatchcase(names[k], pattern)]
    if not rows:
        known = ", ".join(filter(None, names[first:])) or "none has a name"
        raise InputError(f"no {element} of the model is named by {name!r}: {known}.")
    return np.array(rows, dtype=np.intp)


def drawn_fields(compiled: Any, parameters: Sequence[MuJoCoParameter], z: Array) -> dict[str, Array]:
    """Return the fields of a model that standardised parameters ``(S, K)`` change, each ``(S, ...)``."""
    names = dict.fromkeys(field for each in parameters for field, _ in each.places)
    fields = {name: np.repeat(_values(compiled, name)[None], len(z), axis=0) for name in names}
    for each, values in zip(parameters, z.T, strict=True):
        each.change(fields, values)
    return fields
