"""The files of a refined model: the model, and its measured residual next to it."""

from __future__ import annotations

import json
from pathlib import Path

from ctxval._util.describe import describe
from ctxval._util.files import MADE_BY, write_text
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.fitting.model_file import SUFFIXES, require_reference, require_suffix, write_model_file
from ctxval.fitting.onnx_file import require_onnx
from ctxval.models import Corrected, Parametric
from ctxval.models.corrected import before_refinement
from ctxval.refinement.methods import Method
from ctxval.refinement.rounds import Refinement


def require_file_of(path: Path, method: Method, model: Model, step: str | None = None) -> None:
    """Check that a file can hold the model that a method will learn, before executions are paid for.

    A function of the user may return any model, so what it returns is checked when it is written.
    """
    require_suffix(path)
    if method.makes is None:
        return
    suitable = [suffix for suffix, held in SUFFIXES.items() if issubclass(method.makes, held)]
    if path.suffix not in suitable:
        raise InputError(
            f"the model of the method {method.name!r} cannot be written to a file that ends in {path.suffix}: give one "
            f"that ends in {' or '.join(suitable)}."
        )
    if issubclass(method.makes, Parametric):
        require_reference(step)
    if path.suffix == ".onnx":
        require_onnx(before_refinement(model) if issubclass(method.makes, Corrected) else None)


def write_refined(path: str | Path, refinement: Refinement, step: str | None = None) -> list[str]:
    """Write the last model of a refinement, and next to it its residual as JSON and as a table; return the paths."""
    if not refinement.last.number:
        raise InputError("no model was refined, so there is none to write.")
    target = Path(path)
    written = write_model_file(target, refinement.model, step)
    if refinement.residual is None:
        return written
    about = {
        "made_by": MADE_BY,
        "model": target.name,
        "verdict": refinement.answer,
        "threshold": refinement.threshold,
        "units": refinement.units,
        "statement": refinement.statement,
        "residual": refinement.residual.to_dict(),
    }
    remark = (
        f"{MADE_BY}. Residual S(x, u) - M(x, u) of one step, measured on executions that the model was not learned "
        f"from, and not guaranteed.\nMeasured for {refinement.residual.range_text}.\nA robust controller must assume "
        "at least these disturbances."
    )
    texts = {
        ".residual.json": json.dumps(describe(about, 12), indent=1, allow_nan=False) + "\n",
        ".residual.txt": f"{refinement.residual.text}\n\n{remark}\n",
    }
    for suffix, text in texts.items():
        beside = target.with_suffix(suffix)
        write_text(beside, text)
        written.append(str(beside))
    return written
