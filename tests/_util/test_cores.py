from __future__ import annotations

import os

import pytest

from ctxval._util.cores import on_all_cores


def test_results_come_in_the_order_of_the_parts_and_nothing_need_be_picklable() -> None:
    offset = 10
    assert on_all_cores(lambda part: part + offset, range(20)) == list(range(10, 30))
    assert on_all_cores(lambda part: part + offset, []) == []


def test_it_is_other_processes_that_compute(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(2)))
    assert os.getpid() not in on_all_cores(lambda _: os.getpid(), range(4))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(1)))
    assert set(on_all_cores(lambda _: os.getpid(), range(4))) == {os.getpid()}


def test_what_a_function_raises_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(2)))
    with pytest.raises(ZeroDivisionError):
        on_all_cores(lambda part: 1 / part, [1, 0])


def test_what_ends_a_process_is_computed_here_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(2)))
    here = os.getpid()

    def elsewhere_it_dies(part: int) -> int:
        if os.getpid() != here:
            os._exit(9)
        return part

    assert on_all_cores(elsewhere_it_dies, [1, 2, 3]) == [1, 2, 3]
