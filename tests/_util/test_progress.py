from __future__ import annotations

import threading

import pytest

from ctxval._util.cores import can_fork, on_all_cores
from ctxval._util.progress import Progress, advance, also_listening, expect, is_heard, listening, stage


def work(parts: int = 3) -> None:
    with stage("baking", 4, "loaves"):
        for _ in range(parts):
            advance()


def test_nobody_listens_and_nothing_happens() -> None:
    work()
    advance()
    expect(3)
    assert not is_heard()


def test_one_more_listener_hears_the_same() -> None:
    first: list[Progress] = []
    second: list[Progress] = []
    with listening(first.append), also_listening(second.append):
        work(1)
    with also_listening(second.append):
        work(1)
    assert first
    assert second == [*first, *first]


def test_a_listener_hears_the_stages_and_their_ends() -> None:
    heard: list[Progress] = []
    with listening(heard.append), stage("the day", unit="meals", done=1):
        work(2)
        expect(3)
        advance(1, "lunch")
    assert [(p.stage, p.depth, p.done, p.expected, p.ended) for p in heard] == [
        ("the day", 0, 1, None, False),
        ("baking", 1, 0, 4, False),
        ("baking", 1, 1, 4, False),
        ("baking", 1, 2, 4, False),
        ("baking", 1, 2, 4, True),
        ("the day", 0, 1, 3, False),
        ("the day", 0, 2, 3, False),
        ("the day", 0, 2, 3, True),
    ]
    assert [p.note for p in heard if p.note] == ["lunch"]


def test_an_estimate_that_was_too_small_is_none_any_more() -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        work(5)
    assert [p.expected for p in heard] == [4, 4, 4, 4, 4, None, None]


def test_an_error_ends_a_stage() -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        with pytest.raises(ZeroDivisionError), stage("dividing"):
            1 / 0  # noqa: B018
        advance()  # there is no stage any more
    assert [p.ended for p in heard] == [False, True]


def test_a_listener_in_a_listener_hears_alone() -> None:
    outer: list[Progress] = []
    inner: list[Progress] = []
    with listening(outer.append), stage("outer"):
        with listening(inner.append):
            work()
        with listening(None):
            work()
    assert {p.stage for p in outer} == {"outer"}
    assert {(p.stage, p.depth) for p in inner} == {("baking", 0)}


def test_another_thread_is_not_heard() -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert not heard


def reported(part: int) -> bool:
    advance()
    return is_heard()


@pytest.mark.skipif(not can_fork(), reason="processes cannot be forked here")
def test_child_processes_are_mute_and_their_results_are_reported_as_they_come() -> None:
    heard: list[Progress] = []
    with listening(heard.append), stage("together", 4):
        found = on_all_cores(reported, range(4))
    done = [p.done for p in heard if not p.ended]
    assert done[-1] == 4
    assert found in ([False] * 4, [True] * 4)  # with one core, this process does the work
