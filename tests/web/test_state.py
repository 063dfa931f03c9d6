"""Work in progress in words; the rest of the service is tested through its requests."""

from __future__ import annotations

import time
from dataclasses import replace

from ctxval._util.progress import Progress
from ctxval.web.state import Work
from facts import assert_names


def test_work_that_cannot_be_counted_says_what_it_is() -> None:
    shown = Work.begun("choosing a task").to_json()
    assert shown == {"text": "choosing a task", "done": 0, "expected": None, "seconds": 0}


def test_work_that_is_counted_says_how_long_it_takes() -> None:
    ago = time.monotonic() - 5
    begun = replace(Work.begun("choosing a task"), started=ago, reached=ago)
    counted = begun.at(Progress("choosing a task", 10, 40, "designs"))
    assert counted.to_json() == {
        "text": "choosing a task, 10/40 designs, 15 s left",
        "done": 10,
        "expected": 40,
        "seconds": 5,
    }
    later = counted.at(Progress("another stage", 20, 40, "tasks")).to_json()
    assert later["seconds"] == 5
    assert_names(later["text"], 20, 40, "tasks", 0)
