"""Archives of others: what is whole comes back, all else gives one error, and memory is bounded."""

from __future__ import annotations

import contextlib
import io
import random
import tracemalloc
import warnings
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from ctxval import Trajectory
from ctxval._util.files import Archive
from ctxval.errors import InputError, ShapeError

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
    assert found.shape("one") == array.shape
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
        with pytest.raises(InputError, match=r"^these bytes cannot be read as a trajectory: .*\.$"):
            Trajectory.from_npz(HOSTILE[name])
        assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("dtype", [np.float64, np.int8])
def test_a_bomb_is_refused_before_it_is_unpacked(dtype: Any) -> None:
    zeros = np.zeros((2**22, 1), dtype=dtype)
    bomb = saved(True, times=np.zeros(2**22, dtype=dtype), states=zeros, inputs=zeros[1:])
    assert len(bomb) < 2**18
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="is too large"):
            Trajectory.from_npz(bomb, most=2**22)
        assert tracemalloc.get_traced_memory()[1] < 2**20
        # A plan knows how long a trajectory must be.
        with pytest.raises(ShapeError, match=r"states of shape \(21, 2\), got \(4194304, 1\)"):
            Trajectory.from_npz(bomb, shape=(21, 2))
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_what_is_read_together_is_bounded() -> None:
    archive = Archive(saved(a=np.zeros(100), b=np.zeros(100)), most=1000)
    archive.numbers("a")
    with pytest.raises(InputError, match=r"its array b of shape \(100,\) is too large: 200 bytes may be read"):
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
