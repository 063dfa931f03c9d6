"""Texts that come from elsewhere."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from conftest import make_validation
from ctxval import Campaign, Trajectory, searches
from ctxval._util.texts import (
    LONGEST,
    aligned,
    enumerated,
    guarded,
    markdown_text,
    parted,
    plain,
    reason_of,
    shortened,
    text_of,
    unguarded,
    visible,
)
from ctxval.campaign.by_hand import read_runs
from ctxval.campaign.storage.recovery import export, recover
from ctxval.core.space import TaskSpace
from faulty_rig import FaultyRig

HOSTILE = "\x1b]0;owned\x07\x1b[2J\x9b31m\x7f\u202egnp.exe\u2066\u2028\udc80\r"


def test_what_a_terminal_acts_upon_is_written_out() -> None:
    assert visible(HOSTILE) == (r"\x1b]0;owned\x07\x1b[2J\x9b31m\x7f\u202egnp.exe\u2066\u2028\udc80\x0d")
    assert visible("Größe [m/s²]\t\\[x]\n") == "Größe [m/s²]\t\\[x]\n"


@given(st.text(st.characters()))
def test_nothing_that_acts_is_left_in_any_text(text: str) -> None:
    shown = visible(text)
    assert visible(shown) == shown
    assert not any((ord(c) < 32 and c not in "\t\n") or 127 <= ord(c) < 160 for c in shown)
    shown.encode()


@given(st.text(), st.integers(100, 200))
@pytest.mark.thorough
def test_a_long_text_keeps_its_beginning_and_its_end(text: str, longest: int) -> None:
    long = f"begin{text * 100}end"
    short = shortened(long, longest)
    assert len(short) <= longest
    assert short.startswith("begin")
    assert short.endswith("end")
    if len(long) > longest:
        assert len(short) >= longest - 2
        head, _, rest = short.partition(" ... (")
        count, _, tail = rest.rpartition(" characters left out) ... ")
        assert (long.startswith(head), long.endswith(tail)) == (True, True)
        assert len(head) + int(count.rpartition("(")[2]) + len(tail) == len(long)
    else:
        assert short == long


class Raises(Exception):  # noqa: N818
    def __str__(self) -> str:
        raise RuntimeError("no words")


class NoText(Exception):  # noqa: N818
    def __str__(self) -> str:
        return 3  # type: ignore[return-value]


class Leaves(Exception):  # noqa: N818
    def __str__(self) -> str:
        raise SystemExit(0)


class Tricky(str):
    __slots__ = ()

    def __len__(self) -> int:
        return 0

    def __str__(self) -> str:
        return self

    def encode(self, *_: object) -> bytes:
        raise RuntimeError("not this one")


@pytest.mark.parametrize("error", [Raises("x"), NoText("x"), Leaves("x")])
def test_an_exception_that_says_nothing_has_its_name(error: Exception) -> None:
    assert plain(error) == reason_of(error) == text_of(error) == type(error).__name__


def test_a_text_of_another_class_is_plain() -> None:
    text = text_of(Tricky("x" * 10**6))
    assert type(text) is str
    assert LONGEST - 2 <= len(text) <= LONGEST
    assert type(plain(ValueError(Tricky("motor")))) is str


def test_an_enormous_exception_is_stored_short_with_its_number_of_characters(tmp_path: Path) -> None:
    validation = make_validation(horizon=2)
    rig = FaultyRig(validation.system, {})
    rig.execute = _roaring  # type: ignore[method-assign]
    campaign = Campaign(make_validation(rig, horizon=2), search=searches.Random(), store=tmp_path / "a.sqlite").run(1)
    (trial,) = campaign.failed
    assert trial.failure is not None
    assert len(trial.failure) <= LONGEST
    assert trial.failure.startswith("ValueError: overcurrent")
    assert trial.failure.endswith("in axis 3")
    assert trial.failure.count("left out") == 1


def _roaring(*_: object) -> Trajectory:
    raise ValueError("overcurrent " + "A" * 10**7 + " in axis 3")


CELLS = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "'=1", "''=1", "\uff1d1"]


@pytest.mark.parametrize("cell", CELLS)
def test_a_cell_that_a_spreadsheet_would_compute_is_guarded(cell: str) -> None:
    assert guarded(cell) == f"'{cell}"
    assert unguarded(guarded(cell)) == cell


@given(st.text(alphabet="'=+-@\t\rab1 "))
@example("'tis")
def test_a_guard_is_undone_exactly(text: str) -> None:
    assert unguarded(guarded(text)) == text
    assert guarded(text)[:1] not in {"=", "+", "-", "@", "\t", "\r"}


def test_texts_of_an_exported_store_are_guarded_and_numbers_are_numbers(tmp_path: Path) -> None:
    campaign = Campaign(make_validation(horizon=2), search=searches.Random(), store=tmp_path / "a.sqlite")
    campaign.add({"goal": -1.5}, distance=0.25)
    campaign.add({"goal": -2.5}, failed="=cmd|' /C calc'!A0\x1b[2J")
    campaign.store.close()
    export(recover(tmp_path / "a.sqlite"), tmp_path / "out")
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out" / "trials.csv").read_text())))
    assert rows[1]["failure"] == r"'=cmd|' /C calc'!A0\x1b[2J"
    assert [float(row["goal"]) for row in rows] == [-1.5, -2.5]
    assert rows[0]["goal"] == "-1.5"
    trials = json.loads((tmp_path / "out" / "trials.json").read_text())["trials"]
    assert trials[1]["failure"] == "=cmd|' /C calc'!A0\x1b[2J"


def test_names_in_a_trajectory_are_guarded_and_read_back(tmp_path: Path) -> None:
    states = ["=x [m]", "@speed"]
    trajectory = Trajectory(np.arange(3.0), -np.ones((3, 2)), np.zeros((2, 1)))
    trajectory.to_csv(tmp_path / "a.csv", states=states, inputs=["-force"])
    assert (tmp_path / "a.csv").read_text().splitlines()[:2] == ["t,'=x [m],'@speed,'-force", "0.0,-1.0,-1.0,0.0"]
    back = Trajectory.from_csv(tmp_path / "a.csv", states=states, inputs=["-force"])
    np.testing.assert_array_equal(back.states, trajectory.states)


def test_a_guarded_reason_in_a_table_of_runs_is_what_was_meant(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_text("goal,failed,trajectory\n1.5,'=E12: overcurrent,\n2.5,'twas loose,\n")
    runs = read_runs([tmp_path / "runs.csv"], None, TaskSpace(goal=(-3.0, 3.0)))
    assert [run.result.failed for run in runs] == ["=E12: overcurrent", "'twas loose"]


@pytest.mark.parametrize(
    ("label", "parts"),
    [
        ("torque [N m]", ("torque", "N m")),
        ("torque at rest at most [N m]", ("torque at rest at most", "N m")),
        ("u[0]", ("u[0]", "")),
        ("u[0] at rest at most", ("u[0] at rest at most", "")),
        ("x[1] [rad]", ("x[1]", "rad")),
        ("angle", ("angle", "")),
    ],
)
def test_a_label_has_a_name_and_a_unit(label: str, parts: tuple[str, str]) -> None:
    assert parted(label) == parts


def test_columns_are_as_wide_as_their_longest_cell() -> None:
    rows = [("name", "value"), ("a", "10"), ("", "-2.5")]
    assert aligned(rows) == "name  value\na     10\n      -2.5"
    assert aligned(rows, right=True) == "name  value\na        10\n       -2.5"


def test_texts_cannot_become_markup_in_markdown() -> None:
    assert markdown_text("a|b <i>\n*c*") == r"a\|b \<i\> \*c\*"


@pytest.mark.parametrize(("count", "text"), [(0, ""), (1, "0"), (3, "0, 1, 2"), (4, "0, 1, 2, ...")])
def test_many_items_are_enumerated_up_to_a_number(count: int, text: str) -> None:
    assert enumerated(range(count), 3) == text
