from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.errors import InputError
from facts import refuses
from json_lines import JsonLines

KEY = ("case", "seed")


def record(seed: int, value: float) -> dict[str, object]:
    return {"case": "pendulum", "seed": seed, "value": value}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "results" / "study.jsonl"


def test_a_file_that_is_not_there_has_no_records(path: Path) -> None:
    assert not JsonLines(path, KEY)
    assert not path.parent.exists()


def test_what_is_appended_is_there_at_once_and_for_the_next_reader(path: Path) -> None:
    lines = JsonLines(path, KEY)
    for seed in range(3):
        lines.append(record(seed, 0.1 * seed))
    for found in (lines, JsonLines(path, KEY)):
        assert list(found) == [("pendulum", 0), ("pendulum", 1), ("pendulum", 2)]
        assert found["pendulum", 2] == record(2, 0.2)
        assert ("pendulum", 3) not in found
    assert len(path.read_text().splitlines()) == 3


def test_the_last_record_of_a_key_counts_in_the_place_of_the_first(path: Path) -> None:
    lines = JsonLines(path, KEY)
    for seed, value in ((0, 1.0), (1, 2.0), (0, 3.0)):
        lines.append(record(seed, value))
    for found in (lines, JsonLines(path, KEY)):
        assert list(found.values()) == [record(0, 3.0), record(1, 2.0)]


def test_selected_are_the_records_with_all_of_the_values(path: Path) -> None:
    lines = JsonLines(path, KEY)
    for seed, value in ((0, 1.0), (1, 2.0), (2, 2.0)):
        lines.append(record(seed, value))
    assert lines.select(value=2.0) == [record(1, 2.0), record(2, 2.0)]
    assert lines.select(value=2.0, seed=1) == [record(1, 2.0)]
    assert lines.select(variant="basin") == []


@given(st.integers(0, 2**16))
def test_wherever_a_kill_cuts_the_file_whole_lines_stay_and_the_next_record_is_stored(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    path = tmp_path_factory.mktemp("cut") / "study.jsonl"
    lines = JsonLines(path, KEY)
    ends = []
    for seed in range(3):
        lines.append(record(seed, 0.5))
        ends.append(path.stat().st_size)
    data = path.read_bytes()
    cut %= len(data) + 1
    path.write_bytes(data[:cut])
    # A record is complete without its newline.
    whole = sum(end - 1 <= cut for end in ends)
    resumed = JsonLines(path, KEY)
    assert [key[1] for key in resumed] == list(range(whole))
    resumed.append(record(7, 0.5))
    assert [key[1] for key in JsonLines(path, KEY)] == [*range(whole), 7]
    assert path.read_bytes().endswith(b"\n")
    assert len(path.read_bytes().splitlines()) == whole + 1


def test_what_is_known_is_what_is_read(path: Path) -> None:
    lines = JsonLines(path, ("name",))
    lines.append({"name": "a", "improvements": [(1, 0.5)], "none": None})
    assert lines["a",] == JsonLines(path, ("name",))["a",] == {"name": "a", "improvements": [[1, 0.5]], "none": None}


@pytest.mark.parametrize("line", ["<<<<<<< HEAD", "[1, 2]", ""])
def test_a_damaged_line_before_the_last_is_named(path: Path, line: str) -> None:
    lines = JsonLines(path, KEY)
    lines.append(record(0, 1.0))
    path.write_text(f"{path.read_text()}{line}\n{path.read_text()}")
    with refuses(InputError, "study.jsonl", 2):
        len(JsonLines(path, KEY))


def test_a_record_without_its_key_is_refused_and_not_stored(path: Path) -> None:
    lines = JsonLines(path, KEY)
    with refuses(InputError, "seed", "case"):
        lines.append({"case": "pendulum"})
    assert not path.exists()
    path.parent.mkdir()
    path.write_text('{"case": "pendulum"}\n')
    with refuses(InputError, 1, "seed"):
        list(JsonLines(path, KEY))
