from __future__ import annotations

import io
import re
import threading
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from ctxval._util import progress as progress_display
from ctxval._util.cores import can_fork, on_all_cores
from ctxval._util.progress import (
    OnScreen,
    Progress,
    advance,
    also_listening,
    amount,
    duration,
    expect,
    is_heard,
    listening,
    progress_shown,
    stage,
)
from facts import assert_names


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


def test_closed_loops_are_no_executions() -> None:
    heard: list[Progress] = []
    with listening(heard.append), stage("executions", 20):
        advance(10_825, units=("closed loops",))
        advance()
        with stage("searching", unit="closed loops"):
            advance(7, units=("closed loops",))
    assert [(p.stage, p.done) for p in heard if p.done] == [
        ("executions", 1), ("searching", 7), ("searching", 7), ("executions", 1)
    ]  # fmt: skip


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


# Progress as people see it. The screens are those of a pseudo-terminal


def console(*, terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=100, force_jupyter=False)


def text(of: Console) -> str:
    """Return what was printed, without codes for colours and the cursor."""
    assert isinstance(of.file, io.StringIO)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", of.file.getvalue())


def executions(notes: list[str], of: Console) -> None:
    with progress_shown(True, of), stage("executions", 3):
        for note in notes:
            advance(1, note)


def test_a_log_has_a_line_for_each_note() -> None:
    log = console(terminal=False)
    executions(["trial 0 has distance 1", "trial 1 failed: \x1b[2Jbad\nexecutions: 3/3"], log)
    assert_names(text(log).splitlines(), 0, 1, "executions", 3)


def test_a_log_says_that_long_work_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 1000, 20))
    monkeypatch.setattr(progress_display.time, "monotonic", lambda: float(next(clock)))
    log = console(terminal=False)
    with progress_shown(True, log), stage("choosing a task", 100, "designs"):
        for _ in range(4):
            advance(10)
    lines = text(log).splitlines()
    assert_names(lines[0], 10, 100, "designs")
    assert len(lines) == 2


def test_a_screen_keeps_all_notes_and_forgets_the_stages() -> None:
    screen = console(terminal=True)
    with progress_shown(True, screen, 0.0), stage("executions", 3):
        with stage("choosing a task", 10, "designs"):
            advance(4)
        advance(1, "trial 0 has distance 1")
        advance(1, "trial 1 has distance 2")
    shown = text(screen)
    assert_names([line.strip() for line in shown.splitlines() if "distance" in line], 0, "distance", 1, 2)
    assert isinstance(screen.file, io.StringIO)
    erased = screen.file.getvalue().rpartition("executions")[2]
    assert "\x1b[2K" in erased


def test_the_clock_of_a_stage_runs_whatever_is_known_of_its_length(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter(range(10_000))
    monkeypatch.setattr("time.monotonic", lambda: float(next(now)))
    for expected in (None, 100, 300):
        shown = OnScreen(console(terminal=True), 0.0)
        for done in (0, 250, 260, 350):
            shown(Progress("searching", done, expected if expected is None or done <= expected else None, "loops"))
        (task,) = shown._bars.tasks
        assert (task.finished, task.total, task.completed) == (False, None, 350)


def test_a_short_stage_is_not_shown() -> None:
    screen = console(terminal=True)
    with progress_shown(True, screen):
        for _ in range(3):
            with stage("blinking"):
                advance()
    assert "blinking" not in text(screen)


def test_text_of_users_cannot_control_the_screen() -> None:
    screen = console(terminal=True)
    executions(["[red]x[/red] \x1b]0;owned\x07"], screen)
    assert "[red]x[/red]" in text(screen)
    assert isinstance(screen.file, io.StringIO)
    assert "\x1b]0" not in screen.file.getvalue()


@pytest.mark.parametrize("wanted", [None, False])
def test_nothing_is_shown_in_a_program_unless_it_is_asked_for(wanted: bool | None, capfd: Any) -> None:
    with progress_shown(wanted), stage("executions", 1):
        advance(1, "done")
    assert capfd.readouterr() == ("", "")


def test_whoever_listens_already_goes_on_listening() -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        with progress_shown(None), stage("a"):
            pass
        with progress_shown(True), stage("b"):
            pass
        with progress_shown(False), stage("c"):
            assert is_heard()
    assert {p.stage for p in heard} == {"a", "b"}


@given(st.floats(0, 1e6), st.one_of(st.none(), st.floats(0, 1e6)), st.floats(0, 1e6))
def test_every_amount_has_a_text(done: float, expected: float | None, elapsed: float) -> None:
    if expected is not None and done > expected:
        expected = None
    found = amount(Progress("s", done, expected, "designs"), elapsed)
    told = expected is not None and done > 0 and (done >= 0.1 * expected or elapsed >= 60.0)
    assert ("left" in found) == told


def test_the_time_that_is_left_is_told_once_some_work_is_done() -> None:
    def shown(done: float, elapsed: float) -> str:
        return amount(Progress("s", done, 200.0, "designs"), elapsed)

    assert shown(12, 2.0) == "12/200 designs"
    assert shown(50, 2.0) == "50/200 designs, 6 s left"
    assert_names(shown(12, 60.0), 12, 200, "designs", 16)


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0.2, "0 s"), (99, "99 s"), (150, "2 min"), (5999, "100 min"), (7200, "2.0 h")]
)
def test_a_duration_has_one_unit(seconds: float, shown: str) -> None:
    assert duration(seconds) == shown
