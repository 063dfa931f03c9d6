"""Tests of the notes of trials."""

from __future__ import annotations

import json
from typing import Any

import pytest

from ctxval.core.trial_note import NO_NOTE, RESERVED, LoopTimes, TrialNote

WHOLE = TrialNote(
    {"engine": "climb", "why": None},
    draws=0,
    hypercube=(3, 0.25),
    predicted_above=(1.0, 0.02, 0.8),
    prediction={"quantiles": [0.5]},
    thinking={"speed": None},
    sensitivity={"share": 0.1},
    comparison={"step": 2},
    converged=False,
    unsteady=4,
    at_least=0.5,
    ends=LoopTimes(None, 1.5),
    falls=LoopTimes(1.0, None),
)


def test_a_note_comes_back_from_its_json() -> None:
    assert TrialNote.from_json(json.loads(json.dumps(WHOLE.to_json()))) == WHOLE
    assert set(RESERVED) < set(WHOLE.to_json())
    assert NO_NOTE.to_json() == {}
    assert TrialNote.from_json({}) == NO_NOTE


@pytest.mark.parametrize("value", [None, "many", [], {}, [1.0, 2.0], 10**400, {"system": "soon"}])
@pytest.mark.parametrize("name", ["draws", "hypercube", "predicted_above", "converged", "at_least", "ends", "falls"])
def test_what_cannot_be_a_field_is_left_out(name: str, value: Any) -> None:
    kept = getattr(TrialNote.from_json({name: value}), name)
    assert kept is None or kept == LoopTimes(None, None) or (name, kept) == ("draws", value)
