"""The forms of the page as values."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import TaskSpace, TaskSuite
from ctxval.campaign.telling import SuppliedResult
from ctxval.errors import InputError, UnknownNameError
from ctxval.web.app import recording_in, result, task_request
from ctxval.web.jobs import TaskRequest
from facts import refuses

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
    with refuses(UnknownNameError, "task", "fall"):
        task_request({"how": "own", "seen": "1", "task": "fall"}, suite)


@pytest.mark.parametrize(
    ("fields", "facts"),
    [
        ({}, ("page",)),
        ({"seen": "1"}, ("how", "next")),
        ({"seen": "1", "how": "odd"}, ("how", "next")),
        ({"seen": "1", "how": "own"}, ("goal",)),
        ({"seen": "1", "how": "own", "parameter-0": "0", "parameter-1": "0"}, ("offset[1]",)),
        ({"seen": "1", "how": "own", **{f"parameter-{k}": "9" for k in range(3)}}, ("goal", 9)),
        ({"seen": "1", "how": "own", **{f"parameter-{k}": "nan" for k in range(3)}}, ("goal", "nan")),
        ({"seen": "1", "how": "again"}, ("trial",)),
        ({"seen": "1" * 5000, "how": "next"}, ("page", "111111111111111111111111111111111111111111111111111111111111")),
        ({"seen": "1" * 400, "how": "next"}, ("page", "111111111111111111111111111111111111111111111111111111111111")),
    ],
)
def test_a_request_that_cannot_be_used_is_refused(fields: dict[str, str], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
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
