"""Learned models as NPZ files: plain arrays, with the transitions that a model was learned from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import read_bytes
from ctxval._util.npz import Archive
from ctxval._util.registry import part
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError
from ctxval.models.gaussian_process import GaussianProcessModel, SquaredExponential
from ctxval.models.linear import Linear
from ctxval.models.neural_network import FeedforwardReLU
from ctxval.models.scaling import IncrementScaling

_FORMAT = "ctxval model"
_SCALING = ("shift_in", "scale_in", "shift_out", "scale_out")
_DATA = ("x", "u", "x_next")
_MOST_LAYERS = 100

SavedModel = Linear | FeedforwardReLU | GaussianProcessModel
"""The models that can be written to a file."""


def write_model(path: str | Path, model: SavedModel) -> None:
    """Write a model and the transitions that it was learned from as an NPZ file.

    Args:
        path: the file.
        model: a ``Linear``, ``FeedforwardReLU`` or ``GaussianProcessModel``.

    Raises:
        InputError: if the model is another one, or the file cannot be written.
    """
    arrays = _arrays(model)
    if model.data is not None:
        arrays |= {name: getattr(model.data, name) for name in _DATA}
    about = json.dumps({"format": _FORMAT, "version": 1, "kind": type(model).__name__})
    _write(path, {"about": np.array(about), **arrays})


def write_transitions(path: str | Path, data: Transitions | None) -> None:
    """Write recorded steps as an NPZ file with x, u and x_next, as the argument ``data`` of a model takes it.

    Raises:
        InputError: if there are no steps, or the file cannot be written.
    """
    if data is None:
        raise InputError(f"there are no recorded steps to write to {path}.")
    _write(path, {name: getattr(data, name) for name in _DATA})


def _write(path: str | Path, arrays: dict[str, Any]) -> None:
    try:
        with Path(path).open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error


@part("Saved", files=("source",))
def read_model(source: str | Path) -> SavedModel:
    """Return a model from an NPZ file that ``write_model`` or ``ctxval fit`` wrote; nothing in it is ever run.

    An NPZ file with the matrices ``A`` and ``B``, and perhaps ``c``, is a linear model.

    Args:
        source: the file.

    Raises:
        InputError: if the file is not a model, or is damaged.
    """
    try:
        arrays = Archive(read_bytes(source))
        kind = _kind(arrays)
        data = Transitions(*(arrays.numbers(name) for name in _DATA)) if set(_DATA) <= set(arrays.names) else None
        if kind == "Linear":
            return Linear(arrays.numbers("A"), arrays.numbers("B"), _optional(arrays, "c"), data)
        scaling = IncrementScaling(*(arrays.numbers(name) for name in _SCALING))
        if kind == "FeedforwardReLU":
            count = sum(name.startswith("weights_") for name in arrays.names)
            layers = range(min(count, _MOST_LAYERS))
            weights, biases = ([arrays.numbers(f"{name}_{i}") for i in layers] for name in ("weights", "biases"))
            return FeedforwardReLU(weights, biases, scaling, data)
        covariance = SquaredExponential(float(arrays.numbers("variance")), arrays.numbers("length_scales"))
        return GaussianProcessModel(covariance, arrays.numbers("centres"), arrays.numbers("weights"), scaling, data)
    except (InputError, ValueError, TypeError, IndexError) as error:
        raise InputError(
            f"{source} cannot be read as a model (an NPZ file of ctxval, or one with the matrices A (n, n) and B "
            f"(n, m)): {str(error).removesuffix('.')}."
        ) from error


def _kind(arrays: Archive) -> str:
    if "about" not in arrays:
        return "Linear"
    about: Any = json.loads(arrays.text("about"))
    kinds = ("Linear", "FeedforwardReLU", "GaussianProcessModel")
    if not isinstance(about, dict) or about.get("format") != _FORMAT or about.get("version") != 1:
        raise InputError(f"its format must be {_FORMAT!r} of version 1")
    if about.get("kind") not in kinds:
        raise InputError(f"its kind must be one of {', '.join(kinds)}, got {str(about.get('kind'))[:40]!r}")
    return str(about["kind"])


def _optional(arrays: Archive, name: str) -> Array | None:
    return arrays.numbers(name) if name in arrays else None


def _arrays(model: SavedModel) -> dict[str, Any]:
    if isinstance(model, Linear):
        return {"A": model.A, "B": model.B, "c": model.c}
    if not isinstance(model, FeedforwardReLU | GaussianProcessModel):
        raise InputError(f"only linear models, networks and Gaussian processes can be written, got {model!r}.")
    scaling = {name: getattr(model.scaling, name) for name in _SCALING}
    if isinstance(model, FeedforwardReLU):
        layers = {f"weights_{i}": weight for i, weight in enumerate(model.weights)}
        return scaling | layers | {f"biases_{i}": bias for i, bias in enumerate(model.biases)}
    found = {"variance": model.covariance.variance, "length_scales": model.covariance.length_scales}
    return scaling | found | {"centres": model.centres, "weights": model.weights}
