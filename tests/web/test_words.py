"""Sentences on why a task was chosen."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.core.trial import Origin, Trial
from ctxval.core.trial_note import TrialNote
from ctxval.learning import ExecutionPrediction
from ctxval.web.page import in_words, why
from facts import assert_names

PREDICTED = ExecutionPrediction(4, tuple(np.linspace(0.1, 0.3, 21)), 0.05, (1,), ((0.0,),), ((0.1,),), 0.0)

JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=5,
)


def trial(origin: Origin = "acquisition", note: dict[str, Any] | None = None, because: str | None = None) -> Trial:
    return Trial(
        3,
        origin,
        "open",
        np.zeros(1),
        {"goal": 0.25, "load": [1.0, 2.0]},
        note=TrialNote.from_json(note or {}),
        because=because,
    )


@pytest.mark.parametrize(
    ("asked", "sentences"),
    [
        (trial("iid"), ["The task is an independent random draw."]),
        (trial("manual"), ["A person chose this task."]),
        (trial(note={"how": "bound"}), ["The upper confidence bound of the distance is largest at this task."]),
        (
            trial(note={"expected": 0.5, "doubt": 0.1}),
            ["The search expects a distance of 0.5 m here, the largest in the region that it examines."],
        ),
        (
            trial(note={"how": "filling", "why": "its errors are large"}),
            [
                "The task is in the largest gap between the tasks so far.",
                "The search does not use the prediction of the learned dynamics: its errors are large.",
            ],
        ),
        (
            trial("manual", because="fuse replaced."),
            ["A person chose this task.", "Since the last execution of this task: fuse replaced."],
        ),
        (
            trial("manual", {"prediction": PREDICTED.to_json()}),
            ["A person chose this task.", "Predicted distance: 0.2 m; below 0.29 m with probability 0.95."],
        ),
    ],
)
def test_the_reason_of_a_choice(asked: Trial, sentences: list[str]) -> None:
    assert why(asked, "m") == sentences


KEYS = st.sampled_from(["how", "why", "expected", "doubt", "prediction"])


@pytest.mark.parametrize("note", [{"expected": 10**400}, {"prediction": {**PREDICTED.to_json(), "deviation": 10**400}}])
def test_numbers_of_a_note_may_be_too_large(note: dict[str, Any]) -> None:
    assert why(trial("acquisition", note), "m")


@given(
    st.dictionaries(KEYS, JSON),
    st.text(),
    st.sampled_from(get_args(Origin)),
)
def test_no_note_is_too_odd(note: dict[str, Any], units: str, origin: Origin) -> None:
    for sentence in why(trial(origin, note), units):
        assert sentence.endswith(".")
        assert "\x1b" not in sentence


def test_a_task_in_one_line() -> None:
    assert_names(in_words(trial(), {"goal": "rad"}), "goal", 0.25, "rad", [1, 2])
