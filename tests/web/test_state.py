"""Work in progress in words; the rest of the service is tested through its requests."""

from __future__ import annotations

import time
from dataclasses import replace

from ctxval.web.background import Stage
from ctxval.web.state import Work


def test_work_that_cannot_be_counted_says_what_it_is() -> None:
    work = Work.begun("choosing a task")
    assert (work.text, work.left, work.seconds) == ("choosing a task", None, 0)


def test_work_that_is_counted_says_how_long_it_takes() -> None:
    begun = replace(Work.begun("choosing a task"), reached=time.monotonic() - 5)
    counted = begun.at(Stage("choosing a task", 10, 40, "designs"))
    assert counted.text == "choosing a task, 10 of 40 designs, about 15 s left"
    assert counted.at(Stage("choosing a task", 20, 40)).left == 5
    assert replace(counted, counted=time.monotonic() - 60).left == 0
    assert counted.at(Stage("another stage", 20, 40)).left == 0
    assert counted.at(Stage("choosing a task", 0, 40)).left is None
    assert counted.at(Stage("choosing a task", 41, 40)).left is None
    assert begun.started == counted.started
