"""A learned model as a file, in the format that the suffix of the file names."""

from __future__ import annotations

from pathlib import Path

from ctxval._util.files import MADE_BY, write_text
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.fitting.onnx_file import write_onnx
from ctxval.models import (
    Corrected,
    FeedforwardReLU,
    GaussianProcessModel,
    Linear,
    Parametric,
    write_model,
    write_transitions,
)

SUFFIXES: dict[str, tuple[type, ...]] = {
    ".npz": (Linear, FeedforwardReLU, GaussianProcessModel, Corrected),
    ".onnx": (Linear, FeedforwardReLU, GaussianProcessModel, Corrected),
    ".toml": (Parametric,),
}
"""The models that a file of each suffix can hold."""

BESIDE = (".data.npz", ".residual.json", ".residual.txt")
"""The suffixes of the files that may be written beside a model."""


def require_suffix(path: Path) -> None:
    """Check that the name of the file of a model ends as one that can be written."""
    if path.suffix not in SUFFIXES:
        raise InputError(f"the file of a model must end in {', '.join(SUFFIXES)}, got {str(path)!r}.")


def require_file_for(path: Path, model: Model) -> None:
    """Check that a file of this suffix can hold a model."""
    require_suffix(path)
    if not isinstance(model, SUFFIXES[path.suffix]):
        raise InputError(f"the model {model!r} cannot be written to a file that ends in {path.suffix}.")


def write_model_file(path: Path, model: Model, step: str | None = None) -> list[str]:
    """Write a model to a file, and the data of an ONNX file to another one; return their paths."""
    require_file_for(path, model)
    if isinstance(model, Parametric):
        values = ", ".join(f"{name} = {value!r}" for name, value in model.theta.items())
        dt = model.dt or getattr(model.data, "dt", None)
        lines = [
            f"# {MADE_BY}",
            "[model]",
            'type = "Parametric"',
            f'step = {{ ref = "{require_reference(step)}" }}',
            f"theta = {{ {values} }}",
            *([] if dt is None else [f"dt = {dt!r}"]),
            *(["vectorized = true"] if model.vectorized else []),
        ]
        write_text(path, "\n".join([*lines, ""]))
        return [str(path)]
    if path.suffix == ".npz":
        write_model(path, model)
        return [str(path)]
    write_onnx(path, model)
    data = getattr(model, "data", None)
    if data is None:
        return [str(path)]
    beside = path.with_suffix(".data.npz")
    write_transitions(beside, data)
    return [str(path), str(beside)]


def require_reference(step: str | None) -> str:
    """Return the reference ``module:attr`` to the user's function, without which its parameters cannot be written."""
    if step is None:
        raise InputError(
            "the parameters of a function can only be written with the reference module:attr to it (--step)."
        )
    return step
