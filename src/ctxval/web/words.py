"""Sentences of the page on trials: why a task was chosen, and what was predicted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ctxval._util.representation import line, number
from ctxval._util.texts import shortened, visible
from ctxval.campaign.dynamics import PREDICTION
from ctxval.core.trial import Trial
from ctxval.learning import ExecutionPrediction

_ORIGINS = {
    "iid": "The task is an independent random draw.",
    "initial": "The task is one of the first tasks of the search, which are spread over the task space.",
    "acquisition": "The search expects to learn most about the largest distance from this task.",
    "covering": "The certificate that is to decide needs this task.",
    "manual": "A person chose this task.",
}

_SEARCHES = {
    "initial": "The task is one of the first tasks of the search, which are spread over the task space.",
    "filling": "The task is in the largest gap between the tasks so far.",
    "improvement": "The search expects here the largest improvement over the largest distance so far.",
    "bound": "The upper confidence bound of the distance is largest at this task.",
}


def why(trial: Trial, units: str) -> list[str]:
    """Return sentences on the reason why the task of a trial was chosen, and on the prediction of its execution."""
    note = trial.note or {}
    sentences, expected = [_ORIGINS[trial.origin]], note.get("expected")
    if trial.origin == "acquisition" and isinstance(expected, int | float) and abs(expected) < math.inf:
        distance = f"{number(expected)} {text(units)}".rstrip()
        sentences = [f"The search expects a distance of {distance} here, the largest in the region that it examines."]
    elif trial.origin in ("acquisition", "initial"):
        sentences = [_SEARCHES.get(str(note.get("how")), _ORIGINS[trial.origin])]
    if isinstance(note.get("why"), str) and note.get("how") != "initial":
        sentences.append(f"The search does not use the prediction of the learned dynamics: {text(note['why'])}.")
    if trial.because is not None:
        sentences.append(f"Since the last execution of this task: {text(trial.because)}.")
    stored = note.get(PREDICTION)
    prediction = ExecutionPrediction.from_json(stored) if isinstance(stored, dict) else None
    if prediction is not None and math.isfinite(prediction.median):
        median, upper = (f"{number(value)} {text(units)}".rstrip() for value in (prediction.median, prediction.upper))
        sentences.append(f"Predicted distance: {median}; below {upper} with probability 0.95.")
    return sentences


def text(value: object, longest: int = 400) -> str:
    """Return a text from elsewhere: shortened, with control characters written out."""
    return visible(shortened(str(value), longest)).removesuffix(".")


def values_of(parameters: Mapping[str, Any], units: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the names of task parameters, and their values with units."""
    return [
        (line(name, 80), f"{_value(value)} {line(units.get(name, ''), 40)}".rstrip())
        for name, value in parameters.items()
    ]


def _value(value: Any) -> str:
    return f"[{', '.join(map(_value, value))}]" if isinstance(value, list) else f"{value:.6g}"


def in_words(trial: Trial, units: Mapping[str, str]) -> str:
    """Return the task of a trial in one line."""
    return ", ".join(f"{name} = {value}" for name, value in values_of(trial.parameters, units))
