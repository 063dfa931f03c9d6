"""Logs that are JSON lists of records."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval.data import LogMapping, read_recordings
from ctxval.data.log import Clock
from ctxval.data.readers import read_json_records
from ctxval.errors import InputError
from facts import refuses

RECORDS: list[dict[str, Any]] = [
    {"timestamp": 0.1 * k, "joint": {"angle": 0.5 * k, "on": k > 1}, "force": [1.0 * k, 2.0 * k], "text": "a"}
    for k in range(5)
]


def written(path: Path, content: Any) -> Path:
    text = json.dumps(content).encode()
    path.write_bytes(gzip.compress(text, mtime=0) if path.suffix == ".gz" else text)
    return path


@pytest.mark.parametrize("name", ["run.json", "run.json.gz"])
@pytest.mark.parametrize("content", [RECORDS, {"mass": 0.5, "names": [], "entries": RECORDS}])
def test_records_are_columns(tmp_path: Path, name: str, content: Any) -> None:
    path = written(tmp_path / name, content)
    (log,) = read_json_records(path)
    around = ("mass",) if isinstance(content, dict) else ()
    assert log.fields() == (*around, "timestamp", "joint.angle", "joint.on", "force")
    assert all((log.signals(["mass"], Clock())["mass"].values == 0.5).all() for _ in around)
    mapping = LogMapping({"angle": "joint.angle"}, {"force": "force[1]", "on": "joint.on"})  # type: ignore[dict-item]
    (run,) = read_recordings([path], mapping).runs
    assert np.allclose(run.trajectory.states[:, 0], 0.5 * np.arange(5))
    assert np.allclose(run.trajectory.inputs, [[2.0 * k, k > 1] for k in range(4)])


def test_what_is_missing_is_no_number(tmp_path: Path) -> None:
    records = [dict(record) for record in RECORDS]
    records[1]["joint"] = None
    del records[2]["force"]
    (log,) = read_json_records(written(tmp_path / "run.json", records))
    signals = log.signals(["joint.angle", "force"], Clock())
    assert np.isnan(signals["joint.angle"].values[:, 0]).tolist() == [False, True, False, False, False]
    assert np.isnan(signals["force"].values[:, 1]).tolist() == [False, False, True, False, False]


@pytest.mark.parametrize(
    ("content", "facts"),
    [
        ({"a": RECORDS, "b": RECORDS}, (2, "run.json")),
        ({"a": 1.0}, (0, "run.json")),
        ([1, 2, 3], (0, "run.json")),
        ("text", (0, "run.json")),
        ([{"name": "a"}, {"name": "b"}], ("run.json",)),
        ([{"x": [1, 2]}, {"x": [1]}], ("run.json",)),
    ],
)
def test_other_json_is_refused(tmp_path: Path, content: Any, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        read_json_records(written(tmp_path / "run.json", content))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("run.json", b"{"),
        ("run.json", b"\xff\xfe"),
        ("run.json", b"[" * 100_000),
        ("run.json.gz", b"not compressed"),
        ("run.json.gz", gzip.compress(b"[{}]", mtime=0)[:-6]),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with refuses(InputError, path):
        read_json_records(path)
