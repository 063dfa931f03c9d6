"""Files of others: regular ones alone, bounded, and no waiting."""

from __future__ import annotations

import os
import socket
import tracemalloc
from pathlib import Path

import pytest

from ctxval import Trajectory
from ctxval._util import files
from ctxval._util.columns import CsvTable
from ctxval._util.files import open_regular, read_bytes, read_json, require_regular_file, written_whole
from ctxval.cli.config.parts import recorded
from ctxval.core.exchange import read_task
from ctxval.errors import InputError

POSIX = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs and devices")


def test_a_file_is_read_also_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"one")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    for name in ("a", "b"):
        assert read_bytes(tmp_path / name) == b"one"
        assert read_bytes(str(tmp_path / name), most=3) == b"one"
        require_regular_file(tmp_path / name)


@POSIX
def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket must be short
    os.mkfifo("fifo")
    Path("zero").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        reasons = {
            "fifo": "it is a FIFO and not a regular file",
            "zero": "it is a device and not a regular file",
            "socket": "No such device",
            ".": "it is a folder",
            "nothing": "No such file or directory",
            "no\0name": "null",
        }
        for name, reason in reasons.items():
            for read in (read_bytes, read_json, require_regular_file, open_regular, CsvTable):
                with pytest.raises(InputError, match=reason):
                    read(name)


@POSIX
@pytest.mark.parametrize("suffix", ["csv", "npz", "json"])
def test_no_reader_waits_for_a_fifo_or_reads_a_device(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{suffix}"
    readers = {"csv": [Trajectory.from_csv], "npz": [Trajectory.from_npz], "json": [read_task]}[suffix]
    if suffix != "json":
        readers.append(lambda path: recorded(str(path)))  # type: ignore[list-item, return-value, arg-type]
    for make in (lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero")):
        make()
        for read in readers:
            with pytest.raises(InputError, match=r"a\.\w+ cannot be read as .* (FIFO|device) and not a regular file"):
                read(path)
        path.unlink()


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a").open("wb") as file:
        file.truncate(2**33)  # sparse: it takes no space
    tracemalloc.start()
    for read in (read_bytes, read_json, CsvTable):
        with pytest.raises(InputError, match="it has 8589934592 bytes, and at most"):
            read(tmp_path / "a")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"[" * 100_000, "nested too deeply"), (b"{", "not JSON"), (b"\xff", "not JSON"), (b"9" * 5000, "not JSON")],
)
def test_hostile_json_gives_one_error(content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=reason):
        read_json(tmp_path / "a.json")
    with pytest.raises(InputError, match=rf"a\.json cannot be read as a ctxval task: .*{reason}"):
        read_task(tmp_path / "a.json")


def test_rows_have_the_numbers_of_their_lines(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b'\xef\xbb\xbfa,b\r\n\r\n1,"x\ny"\n2,z')
    table = CsvTable(tmp_path / "a.csv")
    assert table.names == ("a", "b")
    assert list(table.rows()) == [(4, ["1", "x\ny"]), (5, ["2", "z"])]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"t,x0\n0,1\0\n", "NUL bytes"),
        ("t,x0\n0,1\n".encode("utf-16"), "codec can't decode"),
        ("t,x0\n0,1\n".encode("utf-16-le"), "NUL bytes"),
        (b"," * (2**20 + 1), "a row of more than 1048576 characters"),
        (b'"\n",' * 400_000, "a row of more than 1048576 characters"),
        (b"t,x0\n0," + b"1" * 200_000, "field limit"),
    ],
)
def test_hostile_csv_gives_one_error(content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.csv cannot be read as CSV: .*{reason}"):
        Trajectory.from_csv(tmp_path / "a.csv")


def test_messages_about_csv_stay_short(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x," * 50_000 + "\n" + "1," * 50_000)
    (tmp_path / "b.csv").write_text("t,x0\n0," + "x" * 100_000)
    for name in ("a.csv", "b.csv"):
        with pytest.raises(InputError) as caught:
            Trajectory.from_csv(tmp_path / name)
        assert len(str(caught.value)) < 500 + len(str(tmp_path))


def test_more_rows_than_a_plan_has_are_not_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x0\n" + "0,1\n" * 22)
    assert len(Trajectory.from_csv(tmp_path / "a.csv", most_rows=22).times) == 22
    with pytest.raises(InputError, match=r"a\.csv must have 21 rows below its header, and has more"):
        Trajectory.from_csv(tmp_path / "a.csv", most_rows=21)


def test_numbers_of_csv_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.csv").write_text("t,x0\n" + "0,1\n" * 100)
    monkeypatch.setattr("ctxval._util.columns.MOST_BYTES", 1000)
    with pytest.raises(InputError, match="too many numbers: 1000 bytes may be read"):
        Trajectory.from_csv(tmp_path / "a.csv")


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    original = os.fstat

    class Shorter:
        def __init__(self, status: os.stat_result) -> None:
            self.st_mode, self.st_size = status.st_mode, status.st_size - 1

    monkeypatch.setattr(files.os, "fstat", lambda descriptor: Shorter(original(descriptor)))
    with pytest.raises(InputError, match="it grew while it was read"):
        read_bytes(tmp_path / "a")


def test_a_file_is_complete_or_as_before(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    with written_whole(path) as file:
        file.write(b"first")
        assert not path.exists()
    with pytest.raises(TypeError), written_whole(path) as file:
        file.writelines([b"half of the sec", None])  # type: ignore[list-item]
    assert path.read_bytes() == b"first"
    assert list(tmp_path.iterdir()) == [path]


@POSIX
def test_a_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with written_whole(tmp_path / "link") as file:
        file.write(b"one")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_bytes() == b"one"


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    for path, reason in ((tmp_path / "no" / "a.npz", "No such file"), (tmp_path, "irectory")):
        with pytest.raises(InputError, match=f"cannot be written: .*{reason}"), written_whole(path) as file:
            file.write(b"one")
