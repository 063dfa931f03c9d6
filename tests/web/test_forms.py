"""The forms of the page as values."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import TaskSpace, TaskSuite
from ctxval.campaign.telling import SuppliedResult
from ctxval.errors import InputError
from ctxval.web.app import recording_in, result, task_request
from ctxval.web.jobs import TaskRequest

SPACE = TaskSpace(goal=(-1.0, 1.0, "rad"), offset=([0, 0], [1, 2], "m"))


def test_requests_of_every_kind() -> None:
    own = {"how": "own", "seen": "3", "parameter-0": "0.5", "parameter-1": "1", "parameter-2": " 1.5e0 "}
    assert task_request({"how": "next", "seen": "3"}, SPACE) == TaskRequest(trials=3)
    assert task_request({"how": "decides", "seen": "3"}, SPACE) == TaskRequest(trials=3, decides=True)
    assert task_request({"how": "draw", "seen": "0"}, SPACE) == TaskRequest(draw=True, trials=0)
    assert task_request(own, SPACE) == TaskRequest({"goal": 0.5, "offset": [1.0, 1.5]}, trials=3)
    again = {"how": "again", "trial": "2", "because": " fuse replaced ", "seen": "3"}
    assert task_request(again, SPACE) == TaskRequest(again=2, because="fuse replaced", trials=3)
    assert task_request({**again, "because": " "}, SPACE) == TaskRequest(again=2, trials=3)


def test_a_task_of_a_suite_is_chosen_by_its_name() -> None:
    suite = TaskSuite({"lift": {"speed": 1.0}, "drop": {"speed": 2.0}})
    chosen = task_request({"how": "own", "seen": "1", "task": "drop"}, suite)
    assert chosen == TaskRequest({"task": "drop"}, trials=1)
    with pytest.raises(InputError, match="no task is called 'fall'"):
        task_request({"how": "own", "seen": "1", "task": "fall"}, suite)


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({}, "the number of trials on the page must be a whole number, got ''"),
        ({"seen": "1"}, "choose how the next task is to be found"),
        ({"seen": "1", "how": "odd"}, "choose how the next task is to be found"),
        ({"seen": "1", "how": "own"}, "goal must be a number, got ''"),
        ({"seen": "1", "how": "own", "parameter-0": "0", "parameter-1": "0"}, r"offset\[1\] must be a number"),
        ({"seen": "1", "how": "own", **{f"parameter-{k}": "9" for k in range(3)}}, "goal"),
        ({"seen": "1", "how": "own", **{f"parameter-{k}": "nan" for k in range(3)}}, "goal must be a number"),
        ({"seen": "1", "how": "again"}, "the trial must be a whole number"),
        ({"seen": "1" * 5000, "how": "next"}, "must be a whole number"),
        ({"seen": "1" * 400, "how": "next"}, "must be a whole number"),
    ],
)
def test_a_request_that_cannot_be_used_is_refused(fields: dict[str, str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        task_request(fields, SPACE)


def test_results_of_every_kind() -> None:
    path = Path("run.csv")
    assert result("failure", {"reason": " cut out "}, None) == SuppliedResult(failed="cut out")
    assert result("distance", {"distance": "0.5"}, None) == SuppliedResult(distance=0.5)
    assert result("recording", {"tolerance": ""}, path) == SuppliedResult(path, uploaded=True)
    assert result("recording", {"resample": "on", "tolerance": "0.2"}, path) == SuppliedResult(
        path, resample=True, start_tolerance=0.2, uploaded=True
    )
    why = {"replace": "wrong file", "reason": "cut out", "distance": "0.5"}
    for kind in ("failure", "distance", "recording"):
        assert result(kind, why, path).replace == "wrong file"


@given(st.dictionaries(st.sampled_from(["how", "seen", "trial", "parameter-0", "because", "distance"]), st.text()))
def test_no_form_is_too_odd(fields: dict[str, str]) -> None:
    for read in (lambda: task_request(fields, SPACE), lambda: result("distance", fields, None)):
        with contextlib.suppress(InputError):
            assert isinstance(read(), TaskRequest | SuppliedResult)


@given(st.text())
def test_an_uploaded_file_stays_in_its_folder(name: str) -> None:
    path = recording_in("/folder", name)
    assert path.parent == Path("/folder")
    assert path.name not in ("", ".", "..")
    assert len(path.name) <= 80
    assert "\0" not in path.name
