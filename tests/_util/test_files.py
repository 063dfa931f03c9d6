"""Files of others: regular ones alone, bounded, and no waiting."""

from __future__ import annotations

import contextlib
import io
import os
import random
import socket
import sqlite3
import subprocess
import sys
import tracemalloc
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from ctxval import Trajectory
from ctxval._util import files
from ctxval._util.files import (
    LOCKS_FILE_ITSELF,
    Archive,
    FileLock,
    LockedError,
    open_regular,
    read_bytes,
    read_json,
    require_regular_file,
    written_whole,
)
from ctxval._util.tables import CsvTable, TableLimits
from ctxval.cli.config.parts import recorded
from ctxval.core.exchange import read_task
from ctxval.errors import InputError, ShapeError
from facts import refuses
from rig_thorough import more

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
        for name in ("fifo", "zero", "socket", ".", "nothing", "no\0name"):
            for read in (read_bytes, read_json, require_regular_file, open_regular, CsvTable):
                with refuses(InputError):
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
            with refuses(InputError, path.name):
                read(path)
        path.unlink()


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a").open("wb") as file:
        file.truncate(2**33)  # sparse: it takes no space
    tracemalloc.start()
    for read in (read_bytes, read_json, CsvTable):
        with refuses(InputError, 8589934592):
            read(tmp_path / "a")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize("content", [b"[" * 100_000, b"{", b"\xff", b"9" * 5000])
def test_hostile_json_gives_one_error(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with refuses(InputError):
        read_json(tmp_path / "a.json")
    with refuses(InputError, "a.json"):
        read_task(tmp_path / "a.json")


def test_rows_have_the_numbers_of_their_lines(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b'\xef\xbb\xbfa,b\r\n\r\n1,"x\ny"\n2,z')
    table = CsvTable(tmp_path / "a.csv")
    assert table.names == ("a", "b")
    assert list(table.rows()) == [(4, ["1", "x\ny"]), (5, ["2", "z"])]


@pytest.mark.parametrize(
    ("content", "fact"),
    [
        (b"t,x0\n0,1\0\n", "NUL"),
        (b"," * (2**20 + 1), 1048576),
        (b'"\n",' * 400_000, 1048576),
        (b"t,x0\n0," + b"1" * 200_000, 131072),
    ],
)
def test_hostile_csv_gives_one_error(content: bytes, fact: object, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with refuses(InputError, "a.csv", fact):
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
    with refuses(InputError, "a.csv", 21):
        Trajectory.from_csv(tmp_path / "a.csv", most_rows=21)


def test_numbers_of_csv_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.csv").write_text("t,x0\n" + "0,1\n" * 100)
    monkeypatch.setattr(CsvTable, "limits", TableLimits(numbers=1000))
    with refuses(InputError, 1000, "a.csv"):
        Trajectory.from_csv(tmp_path / "a.csv")


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    original = os.fstat

    class Shorter:
        def __init__(self, status: os.stat_result) -> None:
            self.st_mode, self.st_size = status.st_mode, status.st_size - 1

    monkeypatch.setattr(files.os, "fstat", lambda descriptor: Shorter(original(descriptor)))
    with refuses(InputError):
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
    for path in (tmp_path / "no" / "a.npz", tmp_path):
        with refuses(InputError, path), written_whole(path) as file:
            file.write(b"one")


# Locks


TRY = "import sys; from ctxval._util.files import FileLock; FileLock(sys.argv[1]).acquire()"


def taken_elsewhere(path: Path) -> bool:
    """Return whether another process can take the lock."""
    return subprocess.run([sys.executable, "-c", TRY, str(path)], capture_output=True).returncode == 0


@pytest.mark.slow
def test_a_lock_is_held_until_it_is_released(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = FileLock(path)
    held.acquire()
    assert not taken_elsewhere(path)
    with pytest.raises(LockedError):
        FileLock(path).acquire()
    held.release()
    assert taken_elsewhere(path)
    held.acquire()
    assert not taken_elsewhere(path)
    held.close()
    assert taken_elsewhere(path)


def test_a_failed_attempt_takes_nothing_from_the_holder(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = FileLock(path)
    held.acquire()
    for _ in range(3):
        with pytest.raises(LockedError):
            FileLock(path).acquire()
    assert not taken_elsewhere(path)
    held.close()


def test_where_no_file_can_be_there_is_no_lock(tmp_path: Path) -> None:
    with refuses(FileNotFoundError, "lock"):
        FileLock(tmp_path / "missing" / "lock").acquire()


@pytest.mark.skipif(not LOCKS_FILE_ITSELF, reason="here a database in use cannot be locked itself")
def test_a_database_is_locked_by_any_of_its_names_and_stays_usable(tmp_path: Path) -> None:
    path, link = tmp_path / "a.sqlite", tmp_path / "b.sqlite"
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("CREATE TABLE t (x)")
    link.symlink_to(path)
    held = FileLock(path)
    held.acquire()
    assert not taken_elsewhere(link)
    connection.execute("INSERT INTO t VALUES (1)")
    connection.execute("BEGIN IMMEDIATE")
    held.release()
    writing = "import sqlite3, sys; sqlite3.connect(sys.argv[1], timeout=0).execute('INSERT INTO t VALUES (2)')"
    refused = subprocess.run([sys.executable, "-c", writing, str(path)], capture_output=True, text=True)
    assert "locked" in refused.stderr  # releasing our lock has not released SQLite's
    connection.execute("COMMIT")
    held.close()
    connection.close()


@pytest.mark.slow
@pytest.mark.skipif(not LOCKS_FILE_ITSELF, reason="locks of SQLite are not inherited anyway")
def test_a_forked_process_neither_holds_nor_releases_the_lock(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = FileLock(path)
    held.acquire()
    ready, go = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(ready, 1)
        os._exit(0)
    try:
        assert not taken_elsewhere(path)
        held.close()
        assert taken_elsewhere(path)  # while the child lives
    finally:
        os.write(go, b"x")
        os.waitpid(child, 0)
        os.close(ready)
        os.close(go)


# Archives of others: what is whole comes back, all else gives one error, and memory is bounded


DTYPES = st.sampled_from(["<f8", ">f8", "<f4", "<f2", "|b1", "|i1", "<u2", ">i4", "<i8"])


def saved(compressed: bool = False, **named: Any) -> bytes:
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **named)
    return buffer.getvalue()


def zipped(method: int = zipfile.ZIP_STORED, **entries: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(f"{name}.npy", content)
    return buffer.getvalue()


def npy(header: str, data: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    return b"\x93NUMPY" + version + len(header).to_bytes(2 if version[0] == 1 else 4, "little") + header.encode() + data


def described(shape: str, dtype: str = "'<f8'", order: str = "False") -> str:
    return f"{{'descr': {dtype}, 'fortran_order': {order}, 'shape': {shape}, }}\n"


@given(DTYPES.flatmap(lambda dtype: arrays(dtype, array_shapes(min_dims=0, max_dims=4, min_side=0))), st.booleans())
def test_numbers_of_every_kind_come_back_as_numpy_reads_them(array: Any, compressed: bool) -> None:
    content = saved(compressed, one=array, two=np.asfortranarray(array.T))
    found = Archive(content)
    assert found.names == ("one", "two")
    assert found.header("one")[0] == array.shape
    np.testing.assert_array_equal(found.numbers("one"), array.astype(np.float64))
    np.testing.assert_array_equal(found.numbers("two"), array.T.astype(np.float64))
    assert found.numbers("one").dtype == np.float64


@given(st.text(st.characters(exclude_categories=["Cs"])).map(lambda text: text.rstrip("\0")))
def test_texts_come_back(text: str) -> None:
    assert Archive(saved(a=np.array(text))).text("a") == text
    assert Archive(saved(a=np.array(text, dtype=">U"))).text("a") == text
    assert Archive(saved(a=np.array([text.encode()], dtype="S"))).text("a") == text.encode().rstrip(b"\0").decode()


def test_a_text_that_could_not_be_written_is_made_one_that_can() -> None:
    for words in ("0xd800", "0x110000", "0xffffffff"):
        data = int(words, 16).to_bytes(4, "little")
        text = Archive(zipped(a=npy(described("()", "'<U1'"), data))).text("a")
        assert text == "�"


@pytest.mark.parametrize(
    "header",
    [
        '{"descr": "<f8", "fortran_order": False, "shape": (2,)}',
        "{'shape':(2L,),'fortran_order':False,'descr':'<f8'}",
        "{ 'fortran_order' : False , 'shape' : ( 2 , ) , 'descr' : '<f8' }          \n",
    ],
)
def test_headers_as_other_programs_write_them_are_read(header: str) -> None:
    data = np.array([1.5, -2.5]).tobytes()
    newer = [] if "L" in header else [b"\x03\x00"]  # Python 2 wrote no headers of the third version
    for version in (b"\x01\x00", b"\x02\x00", *newer):
        assert Archive(zipped(a=npy(header, data, version))).numbers("a").tolist() == [1.5, -2.5]


HOSTILE = {
    "MemoryError": zipped(ended=npy(described(f"({2**40},)"))),
    "OverflowError": zipped(ended=npy(described(f"({10**30},)"))),
    "an empty one of too large a shape": zipped(ended=npy(described(f"(0, {10**30})"))),
    "too many digits": zipped(ended=npy(described("(" + "9" * 5000 + ",)"))),
    "TokenError": zipped(ended=npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2,\n")),
    "RecursionError": zipped(ended=npy("(" * 9000)),
    "no literal": zipped(ended=npy("{'descr': __import__('os').abort()}")),
    "a pickle": zipped(ended=npy(described("(1,)", "'|O'"), b"\x80\x04.")),
    "records": zipped(ended=npy(described("(1,)", "[('x', '<f8')]"), bytes(8))),
    "complex": zipped(ended=npy(described("(1,)", "'<c16'"), bytes(16))),
    "a long header": zipped(ended=npy(described("(1,)") + " " * 20000, bytes(8))),
    "a header that is said to be long": zipped(ended=b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + b" " * 100),
    "another version": zipped(ended=npy(described("(1,)"), bytes(8), b"\x09\x00")),
    "too few numbers": zipped(ended=npy(described("(2,)"), bytes(8))),
    "too many numbers": zipped(ended=npy(described("(2,)"), bytes(24))),
    "negative": zipped(ended=npy(described("(-2,)"), bytes(16))),
    "no array": zipped(ended=b"t,x0\n"),
    "nothing": zipped(ended=b""),
    "lzma": zipped(zipfile.ZIP_LZMA, ended=npy(described("(1,)"), bytes(8))),
    "damaged lzma": zipped(zipfile.ZIP_LZMA, ended=npy(described("(1,)"), bytes(8))).replace(b"\x5d", b"\xff"),
    "bzip2": zipped(zipfile.ZIP_BZIP2, ended=npy(described("(1,)"), bytes(8))),
    "numbers that are text": saved(ended=np.array(["one", "two"])),
    "not there": saved(b=np.zeros(2)),
    "too many dimensions": zipped(ended=npy(described("(" + "1, " * 80 + ")"), bytes(8))),
    "another checksum": saved(ended=np.full(50, 1.5)).replace(
        np.full(1, 1.5).tobytes() * 50, np.full(50, 2.5).tobytes()
    ),
    "many entries": zipped(**{f"ended{i}": b"" for i in range(1100)}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_archives_give_one_error_in_little_memory(name: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            Archive(HOSTILE[name]).numbers("ended")
        with refuses(InputError):
            Trajectory.from_npz(HOSTILE[name])
        assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("dtype", [np.int8, *more(np.float64)])
def test_a_bomb_is_refused_before_it_is_unpacked(dtype: Any) -> None:
    zeros = np.zeros((2**22, 1), dtype=dtype)
    bomb = saved(True, times=np.zeros(2**22, dtype=dtype), states=zeros, inputs=zeros[1:])
    assert len(bomb) < 2**18
    tracemalloc.start()
    try:
        with refuses(InputError, 4194304):
            Trajectory.from_npz(bomb, most=2**22)
        assert tracemalloc.get_traced_memory()[1] < 2**20
        # A plan knows how long a trajectory must be.
        with refuses(ShapeError, "shape", (21, 2), (4194304, 1)):
            Trajectory.from_npz(bomb, shape=(21, 2))
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_what_is_read_together_is_bounded() -> None:
    archive = Archive(saved(a=np.zeros(100), b=np.zeros(100)), most=1000)
    archive.numbers("a")
    with refuses(InputError, "b", (100,), 200):
        archive.numbers("b")


WHOLE = [
    saved(compressed, times=np.arange(5) / 10, states=np.ones((5, 2)), inputs=np.ones((4, 1)), ended=np.array("fell"))
    for compressed in (False, True)
]


@given(st.sampled_from(WHOLE), st.integers(0, 2**32), st.integers(1, 6), st.booleans())
def test_any_damage_gives_a_trajectory_or_one_error(whole: bytes, seed: int, times: int, cut: bool) -> None:
    rng = random.Random(seed)
    damaged = bytearray(whole)
    for _ in range(times):
        place = rng.randrange(len(damaged))
        damaged[place] = rng.choice([0, 255, rng.randrange(256)])
        if rng.random() < 0.3:
            damaged[place : place + rng.randrange(9)] = rng.randbytes(rng.randrange(9))
    with warnings.catch_warnings(), contextlib.suppress(InputError):
        warnings.simplefilter("error")
        Trajectory.from_npz(bytes(damaged[: rng.randrange(len(damaged)) if cut else None]))


ENTRIES = [
    "'descr': '<f8'",
    "'descr': '<U9'",
    "'descr': '|O'",
    "'fortran_order': True",
    "'shape': (2,)",
    "'shape': (9,)",
]
FRAGMENTS = st.sampled_from([*ENTRIES, *"{}(),['\"\\\n0L", ", ", "-1", "1_0", "\0", "é"])


@given(st.lists(FRAGMENTS, max_size=12).map("".join), st.binary(max_size=40))
def test_no_header_makes_the_reader_stumble(header: str, data: bytes) -> None:
    archive = Archive(zipped(a=npy(header, data)))
    for read in (archive.numbers, archive.text):
        with warnings.catch_warnings(), contextlib.suppress(InputError):
            warnings.simplefilter("error")
            read("a")
