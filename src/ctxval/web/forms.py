"""The forms of the page, read into values; what cannot be read is refused in one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np

from ctxval._util.checked import NonNegativeFloat, require
from ctxval.campaign.telling import SuppliedResult
from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TASK, TaskSuite
from ctxval.errors import InputError
from ctxval.web.jobs import TaskRequest

Number = TypeVar("Number", int, float)

Fields = Mapping[str, str]  #: the fields of a form that are texts


def task_request(fields: Fields, space: TaskSpace) -> TaskRequest:
    seen = _read(fields, "seen", "the number of trials on the page must be a whole number", int)
    match fields.get("how"):
        case "next":
            return TaskRequest(trials=seen)
        case "decides":
            return TaskRequest(decides=True, trials=seen)
        case "draw":
            return TaskRequest(draw=True, trials=seen)
        case "own" if isinstance(space, TaskSuite):
            named = {TASK: fields.get(TASK, "")}
            space.point(named)
            return TaskRequest(named, trials=seen)
        case "own":
            names = zip(space.names, range(space.dimension), strict=True)
            point = np.array([_number(fields, f"parameter-{place}", name) for name, place in names])
            parameters = space.describe_point(point)
            space.point(parameters)
            return TaskRequest(parameters, trials=seen)
        case "again":
            number = _read(fields, "trial", "the trial must be a whole number", int)
            return TaskRequest(again=number, because=fields.get("because", "").strip() or None, trials=seen)
    raise InputError("choose how the next task is to be found.")


def result(kind: str, fields: Fields, recording: Path | None) -> SuppliedResult:
    """Return what an operator reports of a trial, with the reason if it replaces an earlier result."""
    replace = fields.get("replace")
    if kind == "failure":
        reason = fields.get("reason", "").strip()
        if not reason:
            raise InputError('a failure needs a reason, such as "the motor cut out".')
        return SuppliedResult(failed=reason, replace=replace)
    if kind == "distance":
        return SuppliedResult(distance=_number(fields, "distance", "the distance"), replace=replace)
    if recording is None:
        raise InputError("choose the file of the recording.")
    tolerance = _number(fields, "tolerance", "the start tolerance") if fields.get("tolerance", "").strip() else None
    require("the start tolerance", NonNegativeFloat | None, tolerance)
    resample = "resample" in fields
    failed = fields.get("reason", "").strip() or None
    return SuppliedResult(
        recording, failed=failed, resample=resample, start_tolerance=tolerance, replace=replace, uploaded=True
    )


def _number(fields: Fields, field: str, name: str) -> float:
    return _read(fields, field, f"{name} must be a number", float)


def _read(fields: Fields, field: str, sentence: str, kind: Callable[[str], Number]) -> Number:
    given = fields.get(field, "").strip()
    with suppress(ValueError, OverflowError):  # a whole number may be too large for a float
        value = kind(given)
        if math.isfinite(value):
            return value
    raise InputError(f"{sentence}, got {given[:60]!r}.")


def recording_in(folder: str, name: str) -> Path:
    """Return the path for an uploaded recording: its own name without anything that is not plain."""
    base = name.replace("\\", "/").rpartition("/")[2]
    plain = "".join(letter if letter.isalnum() or letter in "._- " else "_" for letter in base)[-80:].lstrip(".")
    return Path(folder) / (plain or "recording.csv")
