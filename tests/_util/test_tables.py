"""One motion in many dialects of CSV, and texts that are no table of numbers."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctxval import Trajectory
from ctxval._util.tables import CsvTable
from ctxval.data import LogMapping, read_recordings
from ctxval.errors import InputError
from facts import assert_names
from rig_dialects import DIALECTS

T = 0.02 * np.arange(60)
COLUMNS = {"angle": np.sin(3 * T), "speed": 3 * np.cos(3 * T), "voltage": np.sign(np.sin(9 * T)) + 0.25}
ROWS = [["t", *COLUMNS], *([f"{value:.6f}" for value in row] for row in zip(T, *COLUMNS.values(), strict=True))]
MAPPING = LogMapping.from_table({"states": {"angle": "angle", "speed": "speed"}, "inputs": {"voltage": "voltage"}})


def written(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", DIALECTS)
def test_one_motion_has_the_same_numbers_in_every_dialect(name: str, tmp_path: Path) -> None:
    ending, dialect = DIALECTS[name]
    recordings = read_recordings([written(tmp_path / f"run{ending}", dialect(ROWS))], MAPPING)
    (run,) = recordings.runs
    assert recordings.dt == pytest.approx(0.02, abs=1e-8)
    np.testing.assert_allclose(run.trajectory.states[:, 0], COLUMNS["angle"], atol=2e-6)
    np.testing.assert_allclose(run.trajectory.states[:, 1], COLUMNS["speed"], atol=2e-6)
    np.testing.assert_allclose(run.trajectory.inputs[:, 0], COLUMNS["voltage"][:-1], atol=2e-6)


def test_there_are_thirty_dialects() -> None:
    texts = {name: dialect(ROWS) for name, (_, dialect) in DIALECTS.items()}
    assert len(set(map(str, texts.values()))) == len(DIALECTS) >= 30


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rows twice", "2 lines left out (a copy of the one before)"),
        ("empty rows", "2 lines left out (no number in it)"),
        ("header again", "repeats its header"),
        ("footer", "line 63: text below the table is left out"),
    ],
)
def test_rows_that_are_left_out_are_said(name: str, words: str, tmp_path: Path) -> None:
    path = written(tmp_path / "run.csv", DIALECTS[name][1](ROWS))
    assert sum(words in note for note in read_recordings([path], MAPPING).notes) == 1


@pytest.mark.parametrize("token", ["#N/A", "-1.#IND", "1.#QNAN", "NaN", "", "n/a", "NULL", "-nan(ind)", "--"])
def test_marks_of_missing_values_are_a_break(token: str, tmp_path: Path) -> None:
    rows = [list(row) for row in ROWS]
    rows[30][1] = token
    recordings = read_recordings([written(tmp_path / "run.csv", "\n".join(map(",".join, rows)))], MAPPING)
    assert sum(run.trajectory.horizon for run in recordings.runs) in (57, 59)  # two parts, or interpolated over one
    assert recordings.dt == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("place", "cell", "facts"),
    [
        ((1, 1), "12:03:04", (2, "angle", "12:03:04", 12)),
        ((1, 1), "2024-05-01T12:00:00", (2, "angle", "2024-05-01T12:00:00", 2024)),
        ((9, 2), "1_0", (10, "speed", "1_0")),
        ((9, 2), "\u0661\u0662", (10, "speed", "١٢")),
        ((9, 2), '"1,234"', (10, "speed", "1,234", 1)),
        ((9, 2), '"0,5"', ()),
        ((60, 0), "late", (61, "late")),
        ((9, 2), "fast # gust", (10, "speed", "fast", "gust")),
    ],
)
def test_a_cell_that_is_no_number_is_named_with_its_line(
    place: tuple[int, int], cell: str, facts: tuple[object, ...], tmp_path: Path
) -> None:
    rows = [list(row) for row in ROWS]
    rows[place[0]][place[1]] = cell
    path = written(tmp_path / "run.csv", "\n".join(map(",".join, rows)))
    for read in (
        lambda: read_recordings([path], MAPPING),
        lambda: Trajectory.from_csv(path, states=["angle", "speed"]),
    ):
        with pytest.raises(InputError) as caught:
            read()
        assert_names(str(caught.value), *facts)


@pytest.mark.parametrize(
    ("times", "facts"),
    [
        (["12:00:00", "12:00:01", "noon"], (4, "time", "noon")),
        (["12:00:00", "12:61:01", "12:02:00"], (3, "time", "12:61:01", 12)),
        (["2024-02-30 12:00:00", "2024-03-01 12:00:00"], (2, 2024)),
    ],
)
def test_a_time_that_does_not_exist_is_refused(times: list[str], facts: tuple[object, ...], tmp_path: Path) -> None:
    path = written(tmp_path / "run.csv", "time,x\n" + "".join(f"{time},{k}\n" for k, time in enumerate(times)))
    with pytest.raises(InputError) as caught:
        read_recordings([path], LogMapping.from_table({"states": {"x": "x"}}))
    assert_names(str(caught.value), *facts)


@pytest.mark.parametrize(
    ("texts", "seconds"),
    [
        (["12:03", "12:04"], 60.0),
        (["12:03.5", "12:04.5"], 1.0),
        (["11:59:59 AM", "12:00:01 PM"], 2.0),
        (["05/31/2024 23:59", "06/01/2024 00:00"], 60.0),
        (["31.12.2023 23:59:59,5", "01.01.2024 00:00:00,5"], 1.0),
        (["2024/05/01 12:00:00.000000100", "2024/05/01 12:00:00.000000200"], 1e-7),
    ],
)
def test_clock_times_are_seconds_since_midnight(texts: list[str], seconds: float, tmp_path: Path) -> None:
    table = CsvTable(written(tmp_path / "run.csv", "time;x\n" + "".join(f"{text};1\n" for text in texts)))
    times = table.clock_times("time")
    assert times is not None
    assert 0 <= times[0] < 86400  # since midnight
    np.testing.assert_allclose(np.diff(times), [seconds], rtol=1e-4)
    assert table.clock_times("x") is None


def test_a_table_of_tasks_keeps_every_row(tmp_path: Path) -> None:
    path = written(tmp_path / "runs.csv", "task,distance\nm,0.125\n#1,0.5\n%2,0.25\n3,0.5\ntask,distance\nend,\n")
    assert next(row for _, row in CsvTable(path, plain=True).rows()) == ["m", "0.125"]
    assert len([*CsvTable(path, plain=True).rows()]) == 6


@pytest.mark.parametrize(
    ("content", "facts"),
    [
        ("t,x\n" + "1" * 200_000 + ",2\n", ()),
        ("t,x\n" + "1" * 2**21, (1048576,)),
        ('sep="\nt,x\n0,"1"\n1,2\n', ()),
        (b"t,x\n\x810,1\n", ()),
        ("t,x\n0,\0\n", ("NUL",)),
    ],
)
def test_texts_that_are_no_table_are_refused_by_name(
    content: str | bytes, facts: tuple[object, ...], tmp_path: Path
) -> None:
    path = written(tmp_path / "run.csv", content)
    with pytest.raises(InputError) as caught:
        Trajectory.from_csv(path)
    assert "run.csv" in str(caught.value)
    assert_names(str(caught.value), *facts)


def test_a_wide_table_is_read(tmp_path: Path) -> None:
    names = ["t", *(f"field{k}" for k in range(9000))]
    rows = [",".join(names), *(",".join([str(k), *["0.5"] * 9000]) for k in range(40))]
    columns = CsvTable(written(tmp_path / "run.csv", "\n".join(rows))).columns(["t", "field8999"])
    np.testing.assert_array_equal(columns["t"], range(40))


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused_with_a_sentence(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = written(tmp_path_factory.mktemp("any") / "run.csv", content)
    with suppress(InputError):
        table = CsvTable(path)
        assert all(len(row) == len(table.names) for _, row in table.rows())
        for name in filter(None, table.names):
            table.clock_times(name)


@settings(deadline=None, max_examples=60)
@given(
    rows=st.lists(st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3), min_size=2, max_size=8),
    name=st.sampled_from(["plain", "semicolons and commas", "tabs", "blanks", "quoted commas", "UTF-16", "bars"]),
)
def test_numbers_are_read_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[float]], name: str
) -> None:
    texts = [["a", "b", "c"], *([f"{value:.17e}" for value in row] for row in rows)]
    table = CsvTable(written(tmp_path_factory.mktemp("bits") / "run.csv", DIALECTS[name][1](texts)))
    columns = table.columns(["a", "b", "c"])
    np.testing.assert_array_equal(np.stack([columns[key] for key in "abc"], axis=1), rows)
