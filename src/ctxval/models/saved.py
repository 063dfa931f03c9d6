"""Learned models as NPZ files: plain arrays, with the transitions that a model was learned from."""

from __future__ import annotations

import json
import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import require
from ctxval._util.files import MADE_BY, Archive, read_bytes, written_whole
from ctxval._util.refusals import reworded
from ctxval._util.registry import part
from ctxval.core.labels import units_of
from ctxval.core.model import Model
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError
from ctxval.models.corrected import Corrected, Correction, Refined
from ctxval.models.increments import FeedforwardReLU, GaussianProcessModel, IncrementScaling, SquaredExponential
from ctxval.models.linear import Linear

_FORMAT = "ctxval model"
_DATA = ("x", "u", "x_next")
_CORRECTED = "corrected_"  # before the names of the arrays of the model that a correction belongs to

_PLAIN = (Linear, FeedforwardReLU, GaussianProcessModel)
SavedModel = Linear | FeedforwardReLU | GaussianProcessModel | Corrected  #: the models that can be written to a file


def write_model(path: str | Path, model: Model, note: dict[str, Any] | None = None) -> None:
    """Write a model and the transitions that it was learned from as an NPZ file.

    The model is a ``Linear``, ``FeedforwardReLU``, ``GaussianProcessModel`` or ``Corrected``, perhaps ``Refined``. Of a
    correction of any other model, the file has the correction alone, which :func:`read_refined` adds to the model that
    it is given. The note has plain values, for :func:`read_note`.
    """
    inner: Any = model.model if isinstance(model, Refined) else model
    about: dict[str, Any] = {"kind": type(inner).__name__}
    if isinstance(inner, Corrected):
        about["linearised"], arrays = inner.linearised, dict[str, Any](inner.correction.arrays())
        if isinstance(inner.model, _PLAIN):
            about["corrects"] = type(inner.model).__name__
            arrays |= {_CORRECTED + name: array for name, array in _arrays(inner.model).items()}
    else:
        arrays = _arrays(inner)
    data = getattr(model, "data", None)
    if data is not None:
        arrays |= _data_arrays(data)
    about |= {"format": _FORMAT, "version": 1, **({"note": note} if note else {})}
    _write(path, {"about": np.array(json.dumps(about)), **arrays})


def is_savable(model: Model) -> bool:
    """Return whether :func:`write_model` can write a model."""
    return isinstance(model.model if isinstance(model, Refined) else model, SavedModel)


def read_note(source: str | Path) -> dict[str, Any]:
    """Return the plain values that were kept beside a model; empty if there are none."""
    with reworded(f"{source} cannot be read as a model", InputError, ValueError):
        arrays = Archive(read_bytes(source))
        about = json.loads(arrays.text("about")) if "about" in arrays.names else {}
    match about:
        case {"note": {} as note}:
            return dict(note)
    return {}


def write_transitions(path: str | Path, data: Transitions | None) -> None:
    """Write recorded steps as an NPZ file with x, u and x_next, as the argument ``data`` of a model takes it.

    Raises:
        InputError: if there are none.
    """
    if data is None:
        raise InputError(f"there are no recorded steps to write to {path}.")
    _write(path, _data_arrays(data))


def stored_transitions(arrays: Archive) -> Transitions | None:
    """Return the recorded steps in an NPZ file with x, u and x_next; None if there are none."""
    if "x_next" not in arrays.names:
        return None
    x, u, x_next = (arrays.numbers(name) for name in _DATA)
    named = names_in(arrays.text("names")) if "names" in arrays.names else {}
    dt = float(arrays.numbers("dt")) if "dt" in arrays.names else None
    return Transitions(x, u, x_next, dt, states=named.get("states", {}), inputs=named.get("inputs", {}))


def names_as_text(data: object) -> str:
    """Return the names of the states and inputs of a model, or of its data, with their units, as JSON."""
    return json.dumps(dict(zip(("states", "inputs"), units_of(data), strict=True)))


def names_in(text: str) -> dict[str, dict[str, str]]:
    """Return the names of states and inputs with their units that a file of a model states."""
    with reworded("the names of its states and inputs with their units cannot be read", ValueError, RecursionError):
        content = json.loads(text)
    for kind in ("states", "inputs"):
        require(f"its {kind}", dict[str, str], content.get(kind) if isinstance(content, dict) else content)
    return {kind: content[kind] for kind in ("states", "inputs")}


def _data_arrays(data: Transitions) -> dict[str, Any]:
    step = {} if data.dt is None else {"dt": np.array(data.dt)}
    names = {"names": np.array(names_as_text(data))}
    return {name: getattr(data, name) for name in _DATA} | step | (names if data.states or data.inputs else {})


def _write(path: str | Path, arrays: dict[str, Any]) -> None:
    with written_whole(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
        with zipfile.ZipFile(file, "a") as archive:
            archive.comment = MADE_BY.encode()  # which stands at the end of the file, and is not compressed


@part("Saved", files=("source",))
def read_model(source: str | Path) -> SavedModel:
    """Return a model from an NPZ file that ``write_model`` or ``ctxval fit`` wrote; nothing in it is ever run.

    An NPZ file with the matrices ``A`` and ``B``, and perhaps ``c``, is a linear model.
    """
    return read_refined(source, None)


def read_refined(source: str | Path, before: Model | None) -> SavedModel:
    """Return a model from a file, as :func:`read_model` does; a correction alone is added to the model before.

    Raises:
        InputError: if the file has another format.
    """
    known_kinds = "an NPZ file of ctxval, or one with the matrices A (n, n) and B (n, m)"
    with reworded(f"{source} cannot be read as a model ({known_kinds})", ValueError, TypeError, IndexError):
        arrays = Archive(read_bytes(source))
        about: Any = {"format": _FORMAT, "version": 1, "kind": "Linear"}
        if "about" in arrays.names:
            about = json.loads(arrays.text("about"))
        plain = tuple(kind.__name__ for kind in _PLAIN)
        if not isinstance(about, dict) or (about.get("format"), about.get("version")) != (_FORMAT, 1):
            raise InputError(f"its format must be {_FORMAT!r} of version 1")
        for key, kinds in (("kind", (*plain, "Corrected")), ("corrects", (*plain, None))):
            if about.get(key) not in kinds:
                known = ", ".join(filter(None, kinds))
                raise InputError(f"its {key} must be one of {known}, got {str(about.get(key))[:40]!r}")
        data = stored_transitions(arrays)
        if about["kind"] != "Corrected":
            return _plain_model(arrays, about["kind"], data)
        kind = about.get("corrects")
        corrected = before if kind is None else _plain_model(arrays, kind, None, _CORRECTED)
        if corrected is None:
            raise InputError("it has a correction alone, without the model that is corrected: use read_refined")
        linearised = about.get("linearised")
        if linearised not in ("corrected", "model"):
            raise InputError(f"it does not state whose Jacobian is used, got {str(linearised)[:40]!r}")
        correction = Correction(*(arrays.numbers(field.name) for field in fields(Correction)))
        return Corrected(corrected, correction, linearised=linearised, data=data)


def _plain_model(arrays: Archive, kind: str, data: Transitions | None, prefix: str = "") -> SavedModel:
    def numbers(name: str) -> Array:
        return arrays.numbers(prefix + name)

    if kind == "Linear":
        return Linear(numbers("A"), numbers("B"), numbers("c") if f"{prefix}c" in arrays.names else None, data)
    scaling = IncrementScaling(*(numbers(field.name) for field in fields(IncrementScaling)))
    if kind == "FeedforwardReLU":
        layers = range(min(100, sum(name.startswith(f"{prefix}weights_") for name in arrays.names)))
        weights, biases = ([numbers(f"{name}_{i}") for i in layers] for name in ("weights", "biases"))
        return FeedforwardReLU(weights, biases, scaling, data)
    covariance = SquaredExponential(float(numbers("variance")), numbers("length_scales"))
    return GaussianProcessModel(covariance, numbers("centres"), numbers("weights"), scaling, data)


def _arrays(model: Model) -> dict[str, Any]:
    match model:
        case Linear():
            return {name: getattr(model, name) for name in "ABc"}
        case FeedforwardReLU():
            layers = {"weights": model.weights, "biases": model.biases}
            named = {f"{name}_{i}": array for name, arrays in layers.items() for i, array in enumerate(arrays)}
            return vars(model.scaling) | named
        case GaussianProcessModel():
            return vars(model.scaling) | vars(model.covariance) | {"centres": model.centres, "weights": model.weights}
    known = "linear models, networks, Gaussian processes and corrections"
    raise InputError(f"only {known} can be written, got {model!r}.")
