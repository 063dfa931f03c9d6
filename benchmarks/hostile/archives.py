"""Hostile recordings: archives of NumPy, tables, networks, and what stands in the place of a file."""

from __future__ import annotations

import functools
import io
import os
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from hostile.values import ESCAPES, Rng, mutated, number, pick, text

HORIZON, STATES, INPUTS = 60, 2, 1


def sound() -> dict[str, Any]:
    """Return arrays of a recording that the campaigns of the attack would take."""
    k = np.arange(HORIZON + 1)
    return {
        "times": k * 0.05,
        "states": np.stack([np.sin(k / 7), 0.1 + np.sin(k * k / 50)], axis=-1),  # excited enough to learn a model of
        "inputs": np.cos(k[:-1] * k[:-1] / 90)[:, None],
    }


def npz(rng: Rng) -> bytes:
    """Return an archive of a recording that is broken, or that asks for what there is not."""
    arrays = sound()
    kind = int(rng.integers(8))
    if kind == 0:
        return mutated(rng, _saved(arrays, compressed=rng.random() < 0.5))
    if kind == 1:
        return _saved(_odd(rng, arrays), compressed=rng.random() < 0.5)
    name = str(pick(rng, ("times", "states", "inputs", "ended")))
    members = {f"{key}.npy": _npy(array) for key, array in arrays.items()}
    if kind == 2:
        members[f"{name}.npy"] = _header(rng)
    elif kind == 3:
        members[f"{name}.npy"] = mutated(rng, members.get(f"{name}.npy", _npy(np.array("complete"))))
    elif kind == 4 and rng.random() < 0.5:
        members = {str(pick(rng, (key, f"../{key}", f"/{key}", key[:-4]))): data for key, data in members.items()}
        members[text(rng, 99)] = rng.bytes(20)
    elif kind == 5:
        return _bomb(name, int(pick(rng, (50_000_000, 200_000_000))))
    return _archived(rng, members, broken=kind == 6)


def _saved(arrays: dict[str, Any], *, compressed: bool) -> bytes:
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)
    return buffer.getvalue()


def _npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def _odd(rng: Rng, arrays: dict[str, Any]) -> dict[str, Any]:
    """Return arrays of which one has other values, another shape or another type."""
    name = str(pick(rng, ("times", "states", "inputs")))
    array = arrays[name]
    with np.errstate(all="ignore"):
        scaled = array * number(rng)
    others: tuple[Any, ...] = (
        *(scaled, array[..., None], array[:0], array[:-1], array.T, array.astype(complex)),
        *(array.astype("U9"), array.astype("S9"), array.astype("f2"), array.astype("i1"), array > 0),
        *(np.array(3.0), np.zeros((0, 0)), np.zeros((0, 10**9)), np.array(["\x1b[2J"]), np.array(b"\xff")),
        *(np.zeros(3, dtype=[("a", "f8"), ("b", "U3")]), np.array("2020-01-01", dtype="M8[D]")),
        *(array.astype("f16"), np.full_like(array, np.nan), np.broadcast_to(array, (3, *array.shape))),
        np.array([b"\0" * 10], dtype="V10"),
    )
    changed = {**arrays, name: pick(rng, others)}
    if rng.random() < 0.2:
        changed["ended"] = pick(
            rng, (np.array(text(rng, 300)), np.array(7), np.array([["complete"]]), np.array(b"\xff"))
        )
    return changed


def _header(rng: Rng) -> bytes:
    """Return an array whose header lies."""
    shape = pick(
        rng,
        (
            "(1000000000000,)",
            "(61, 1000000000)",
            "(-1,)",
            "(61, 2, 0)",
            "(9223372036854775807, 2)",
            "(True,)",
            "(1e3,)",
            "(" * 90 + ")" * 90,
            "()",
            "61",
            "(61,2,[0])",
            "(4611686018427387904, 4)",
            "(0, 99999999999)",
        ),
    )
    kind = pick(
        rng,
        (
            "'<f8'",
            "'|O'",
            "'<f8,<f8'",
            "[('a', '|O')]",
            "'<U1000000000'",
            "'V999999999'",
            "__import__('os')",
            "'<M8[s]'",
            "('<f8', (1000000,))",
            "'|S0'",
            "{'a': 1}",
            "'<f8" + "x" * 70_000 + "'",
        ),
    )
    order = pick(rng, ("False", "True", "1", "__import__('os').system('touch PWNED')"))
    header = f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}, }}"
    header = str(pick(rng, (header, header, header, header[:-3], "(" * 5_000, "[" * 100_000, "'" + "a" * 60_000, "")))
    raw = header.encode() + b"\n"
    version = int(pick(rng, (1, 1, 1, 2, 3, 4, 255)))
    length = struct.pack("<H" if version == 1 else "<I", min(len(raw), 65_535) if version == 1 else len(raw))
    if rng.random() < 0.1:
        length = b"\xff" * len(length)
    return b"\x93NUMPY" + bytes([version, 0]) + length + raw + rng.bytes(int(rng.integers(3_000)))


def _archived(rng: Rng, members: dict[str, bytes], *, broken: bool) -> bytes:
    # NumPy writes the first two alone.
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    if rng.random() < 0.1:
        methods += (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", pick(rng, methods)) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name.replace("\0", "") or "x"), data, pick(rng, methods))
    content = bytearray(buffer.getvalue())
    if broken:
        # The directory of the archive, and the heads of its members, where sizes, methods and flags are.
        heads = [i for i in range(len(content) - 4) if content[i : i + 4] in (b"PK\1\2", b"PK\3\4", b"PK\5\6")]
        for _ in range(int(rng.integers(1, 6))):
            place = int(pick(rng, heads)) + int(rng.integers(4, 30))
            if place < len(content):
                content[place] = int(pick(rng, (0, 1, 8, 12, 14, 99, 0xFF, int(rng.integers(256)))))
    return bytes(content)


@functools.cache
def _bomb(name: str, size: int) -> bytes:
    """Return a small archive of which one array unpacks to very much."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, array in sound().items():
            if key != name:
                archive.writestr(f"{key}.npy", _npy(array))
        with archive.open(f"{name}.npy", "w") as member:
            shape = {"descr": "<f8", "fortran_order": False, "shape": (size // 16, 2)}
            np.lib.format.write_array_header_1_0(member, shape)
            for _ in range(size // 1_000_000):
                member.write(b"\0" * 1_000_000)
    return buffer.getvalue()


def table(rng: Rng, header: list[str], rows: list[list[Any]]) -> bytes:
    """Return a CSV file that is broken, or has cells that are hard to take."""
    cells = [list(map(str, header)), *([str(cell) for cell in row] for row in rows)]
    for _ in range(int(rng.integers(1, 5))):
        row = int(rng.integers(min(len(cells), 4))) if rng.random() < 0.6 else int(rng.integers(len(cells)))
        column = int(rng.integers(max(1, len(cells[row]))))
        match int(rng.integers(7)):
            case 0 | 1:
                cells[row][column : column + 1] = [str(number(rng))]
            case 2 | 3:
                cells[row][column : column + 1] = [_cell(rng, text(rng))]
            case 4:
                cells[row].insert(column if rng.random() < 0.3 else len(cells[row]), str(pick(rng, ESCAPES)))
            case 5:
                del cells[row][column : column + 1]
            case 6:
                cells.insert(row, list(cells[row]))
    # Seldom, as what ends a reader at once hides what comes after.
    ends = str(pick(rng, ("\r\n", "\r", "\0\n"))) if rng.random() < 0.15 else "\n"
    separator = ";" if rng.random() < 0.03 else ","
    content = ends.join(separator.join(row) for row in cells)
    data = content.encode(str(pick(rng, ("utf-16", "latin-1"))) if rng.random() < 0.1 else "utf-8", "replace")
    if rng.random() < 0.12:
        data = mutated(rng, data)
    if rng.random() < 0.06:
        return pick(rng, (b"", b"\xef\xbb\xbf" + data, b'"' + data, b"," * 300_000 + data, data * 200))
    return data


def _cell(rng: Rng, content: str) -> str:
    """Return a text as a cell, mostly quoted as a writer would."""
    if rng.random() < 0.3:
        return content
    quoted = content.replace('"', '""')
    return f'"{quoted}"'


def recording_csv(rng: Rng, header: str = "t,position [m],speed [m/s],force [N]") -> bytes:
    """Return a recording as a hostile CSV file."""
    arrays = sound()
    rows = [
        [t, *x, *(arrays["inputs"][k].tolist() if k < HORIZON else [""])]
        for k, (t, x) in enumerate(zip(arrays["times"].tolist(), arrays["states"].tolist(), strict=True))
    ]
    return table(rng, header.split(","), rows)


def runs_csv(rng: Rng) -> bytes:
    """Return a table of known runs, hostile."""
    files = (
        "run.csv",
        "run.npz",
        "/dev/zero",
        "../../../../etc/passwd",
        "pipe",
        "table.csv",
        ".",
        "",
        "\x1b[2J",
        "a" * 300,
    )
    kinds = ("trajectory", "distance", "failed")
    rows: list[list[Any]] = []
    for _ in range(int(rng.integers(1, 6))):
        kind = int(rng.integers(3))
        result = ["", "", ""]
        result[kind] = str(pick(rng, files)) if kind == 0 else str(number(rng)) if kind == 1 else text(rng, 2_000)
        rows.append([1.0 + rng.random(), 0.2 * rng.random(), *result])
    content = table(rng, ["goal", "load", *kinds], rows)
    if rng.random() < 0.3:
        lines: list[list[Any]] = [["goal", "load", *kinds], *rows]
        content = "\n".join(",".join(f'"{cell}"' for cell in line) for line in lines).encode("utf-8", "replace")
    return content


def placed(rng: Rng, path: Path, content: bytes) -> None:
    """Write a file; seldom something that is none."""
    kind = int(rng.integers(40))
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.mkdir()
    elif kind == 2:
        path.symlink_to(str(pick(rng, ("/dev/zero", "/dev/urandom", path.name, "none", "/dev/null", "/proc/self/mem"))))
    elif kind == 3:
        path.write_bytes(b"")
        os.truncate(path, 2**33)
    else:
        path.write_bytes(content)


def onnx(rng: Rng, base: bytes) -> bytes:
    """Return a network that is broken, or a text that is none."""
    return pick(
        rng, (mutated(rng, base), mutated(rng, base), base[: int(rng.integers(len(base)))], rng.bytes(500), b"")
    )
