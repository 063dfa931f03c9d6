"""MJCF models of MuJoCo, for systems and for models; needs mujoco (extra ``mujoco``)."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.extras import require_extra
from ctxval._util.files import read_bytes
from ctxval._util.texts import shortened
from ctxval.errors import InputError


def is_mjcf_text(mjcf: str | Path) -> bool:
    """Return whether a model is given as its text, and not as the path of its file."""
    return isinstance(mjcf, str) and "<" in mjcf


def compile_mjcf(mjcf: str | Path) -> tuple[str, Any]:
    """Return the text of a model, and the compiled ``mujoco.MjModel``.

    Args:
        mjcf: the model as XML text, or the path of its file.

    Raises:
        InputError: if MuJoCo is not installed, or the model cannot be read or compiled.
    """
    loader = require_extra("mujoco", "mujoco", "models of MuJoCo").MjModel
    try:
        if is_mjcf_text(mjcf):
            return str(mjcf), loader.from_xml_string(str(mjcf))
        return read_bytes(mjcf).decode("utf-8"), loader.from_xml_path(str(mjcf))
    except (InputError, UnicodeDecodeError) as error:
        raise InputError(f"the MuJoCo model {str(mjcf)!r} cannot be read: {error}.") from error
    except ValueError as error:
        reason = shortened(" ".join(str(error).split())).rstrip(".")  # MuJoCo writes several lines
        raise InputError(f"MuJoCo cannot compile the model: {reason}.") from error


def identity_of_mjcf(text: str, model: Any) -> dict[str, Any]:
    """Return what identifies a compiled model in a store.

    The text does not contain the files that it names: other MJCF files, meshes and height fields. If it names any, the
    numbers of the compiled model that its dynamics depend on are listed too.
    """
    known = {"mjcf": hashlib.sha256(text.encode()).hexdigest()[:16], "mass": model.body_mass.tolist()}
    return {**known, COMPILED: _numbers(model)} if _NAMES_FILES.search(text) else known


COMPILED = "compiled"
"""The key of the numbers of a compiled model; descriptions of older versions have none."""

_NAMES_FILES = re.compile(r"\bfile\s*=")
_DYNAMIC = (
    *("actuator_", "body_", "dof_", "eq_", "exclude_", "flex_", "geom_", "hfield_", "jnt_", "mesh_", "pair_", "qpos"),
    *("site_", "tendon_", "wrap_"),
)
"""How the names of arrays begin on which the dynamics depend."""
_DRAWN = ("adr", "group", "matid", "num", "rgba", "shadow", "texcoord", "normal")
"""How the names of arrays end that are addresses in memory, or are only drawn."""


def _numbers(model: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for owner, names in ((model, _DYNAMIC), (model.opt, ("",))):
        for name in dir(owner):
            value = getattr(owner, name) if name.startswith(names) and not name.startswith("_") else None
            if isinstance(value, np.ndarray | int | float) and np.size(value) and not name.endswith(_DRAWN):
                found[name] = value
    return found
