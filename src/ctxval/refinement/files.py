"""The files of a refined model: the model, and its measured residual next to it."""

from __future__ import annotations

import json
from pathlib import Path

from ctxval._util.describe import describe
from ctxval.errors import InputError
from ctxval.fitting.model_file import write_model_file
from ctxval.refinement.rounds import Refinement


def write_refined(path: str | Path, found: Refinement, step: str | None = None) -> list[str]:
    """Write the last model of a refinement, and next to it its residual as JSON and as a table; return the paths.

    Args:
        path: the file of the model: ``.onnx``, ``.npz``, or ``.toml`` for the parameters of a function.
        found: the refinement.
        step: ``module:attr`` of the user's function, for its parameters.

    Raises:
        InputError: if no model was refined, a file of this suffix cannot hold the model, or a file cannot be written.
    """
    if not found.last.number:
        raise InputError("no model was refined, so there is none to write.")
    target = Path(path)
    written = write_model_file(target, found.model, step)
    if found.residual is None:
        return written
    about = {
        "model": target.name,
        "verdict": found.answer,
        "threshold": found.threshold,
        "units": found.units,
        "statement": found.statement,
        "residual": found.residual.to_dict(),
    }
    texts = {
        ".residual.json": json.dumps(describe(about, 12), indent=1, allow_nan=False) + "\n",
        ".residual.txt": f"{found.residual.text}\n\n{_REMARK.format(range=found.residual.range_text)}\n",
    }
    for suffix, text in texts.items():
        beside = target.with_suffix(suffix)
        try:
            beside.write_text(text, encoding="utf-8")
        except OSError as error:
            raise InputError(f"{beside} cannot be written: {error.strerror}.") from error
        written.append(str(beside))
    return written


_REMARK = (
    "Residual S(x, u) - M(x, u) of one step, measured on executions that the model was not learned from, and not "
    "guaranteed.\nMeasured for {range}.\nA robust controller must assume at least these disturbances."
)
