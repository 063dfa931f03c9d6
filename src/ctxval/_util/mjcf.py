"""MJCF models of MuJoCo, for systems and for models; needs mujoco (extra ``mujoco``)."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from ctxval._util.extras import require_extra
from ctxval._util.files import read_bytes
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
        raise InputError(f"MuJoCo cannot compile the model: {error}") from error


def identity_of_mjcf(text: str, model: Any) -> dict[str, Any]:
    """Return what identifies a compiled model in a store; the masses of meshes are not in its text."""
    return {"mjcf": hashlib.sha256(text.encode()).hexdigest()[:16], "mass": model.body_mass.tolist()}
