"""The one reader of CSV files."""

from __future__ import annotations

from pathlib import Path

import pytest

from ctxval import Trajectory
from ctxval._util.columns import CsvTable
from ctxval.data import LogMapping, read_recordings
from ctxval.errors import InputError


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_the_separator_is_found_in_the_header(separator: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f'\n"x,y;z"{separator}t\n1{separator}2\n\n   \n3{separator}4\n')
    table = CsvTable(tmp_path / "a.csv")
    assert table.names == ("x,y;z", "t")
    assert [(line, [float(cell) for cell in row]) for line, row in table.rows()] == [(3, [1, 2]), (6, [3, 4])]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("t,x0,u0,x0\n0,1,2,3\n1,1,,3\n", "a.csv has two columns 'x0': each name must be there once"),
        ("t,x0 [m],u0,x0 [mm]\n0,1,2,3\n1,1,,3\n", "a.csv has two columns 'x0'"),
        (
            "t,x0,u0\n0,1,0,2,0\n0,1,1,0,\n",
            "a.csv, line 2: the row must have 3 cells, as the header has, got 5. If com",
        ),
        ("t,x0,u0\n0,1,2\n1,1\n2,1,\n", "a.csv, line 3: the row must have 3 cells, as the header has, got 2"),
        ("t;x0;u0\n0,0;1,5;2\n0.5;1,5;\n", "has decimal commas (line 2) and points (line 3) in numbers"),
        ("t;x0;u0\n0;1.234,5;2\n1;1;\n", "a.csv, line 2: x0 must be a number, got '1.234,5'"),
        ("t,x0,u0\n0,1_0,2\n1,1,\n", "a.csv, line 2: x0 must be a number, got '1_0'"),
    ],
)
def test_a_table_that_could_be_misread_is_refused_by_all_readers(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    mapping = LogMapping.from_table({"states": ["x0"], "inputs": ["u0"]})
    for read in (
        Trajectory.from_csv,
        lambda path: read_recordings([path]),
        lambda path: read_recordings([path], mapping),
    ):
        with pytest.raises(InputError) as caught:
            read(tmp_path / "a.csv")
        assert sentence in str(caught.value)


def test_decimal_commas_are_read_between_semicolons(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t;x0 [mm];u0\n0,0;1,5;-2e-1\n0,1;2,5;\n")
    one = Trajectory.from_csv(tmp_path / "a.csv", states=["x0 [m]"], inputs=["u0"])
    assert one.times.tolist() == [0, 0.1]
    assert one.states[:, 0].tolist() == pytest.approx([0.0015, 0.0025])
    assert one.inputs.tolist() == [[-0.2]]


def test_a_file_with_several_recordings_is_no_trajectory(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x0,u0,episode\n0,1,2,0\n1,1,2,0\n2,5,2,1\n")
    with pytest.raises(InputError, match=r"a\.csv has several recordings, which a column numbers"):
        Trajectory.from_csv(tmp_path / "a.csv")
