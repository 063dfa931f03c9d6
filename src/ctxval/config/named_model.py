"""A model from what a command line names: a file, an experiment, ``module:attr`` or a name of the registry."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ctxval.config.parts import part
from ctxval.config.settings import read_settings
from ctxval.core.model import Model, as_model
from ctxval.errors import InputError
from ctxval.models import REGISTRY, read_model
from ctxval.models.mujoco import is_sysid_result


def named_model(text: str, options: Mapping[str, Any], dt: float | None = None) -> Model:
    """Return a model."""
    path = Path(text)
    if path.suffix == ".toml":
        _require_no(options, f"the model of {text}")
        return read_settings(text, {}).load().validation.model
    if path.suffix == ".onnx":
        return as_model(part("model", {"type": "Onnx", "source": text, **options}))
    if path.suffix == ".xml" or is_sysid_result(path):
        return as_model(part("model", {"type": "MuJoCo", "mjcf": text, "dt": dt, **options}))
    if path.suffix == ".npz":
        _require_no(options, f"the model in {text}")
        return read_model(path)
    if ":" not in text and text not in REGISTRY.built_in and text not in REGISTRY.installed:
        raise InputError(
            f"a model must be a file that ends in .onnx, .npz, .xml or .toml, a result of mujoco.sysid, module:attr, "
            f"or one of {', '.join(REGISTRY.built_in)}, got {text!r}."
        )
    return as_model(part("model", {"type": text, **options}))


def _require_no(options: Mapping[str, Any], what: str) -> None:
    if options:
        raise InputError(f"{what} takes no options, got {', '.join(options)}.")
