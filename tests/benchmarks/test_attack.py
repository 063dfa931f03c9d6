"""Hostile input through the command line: a seeded sample of what `make attack` inflicts, and what its cage notices."""

from __future__ import annotations

import base64
import ctypes
import json
import os
import shutil
import sqlite3
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig_thorough import some

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import attack  # noqa: E402
import reliability  # noqa: E402
from hostile import cage, clothes, doors, experiments, oracles  # noqa: E402
from hostile.cage import Case, carry_out  # noqa: E402

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="inputs are tried in forks")

EACH = dict.fromkeys(attack.FAMILIES, 1) | {"told": 2}


NAMES = {module.__name__: module for module in (base64, ctypes, os, sqlite3, sys)}


@pytest.fixture
def tmp_path() -> Iterator[Path]:
    """A folder that is not in /dev, where the cage permits everything."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def base() -> Iterator[Path]:
    attack._warm()
    with tempfile.TemporaryDirectory() as folder:
        yield attack.prepare(Path(folder) / "base")


@pytest.mark.slow
@pytest.mark.parametrize("family", some(attack.FAMILIES, 3))
def test_hostile_input_ends_in_a_sentence(family: str, base: Path) -> None:
    for number in range(EACH[family]):
        # Other inputs than those of the large run.
        outcome = attack.inflict(family, number, 1, base)
        assert not outcome.wrong, f"{family} {number}: {outcome}"


def test_an_input_follows_from_its_number(base: Path, tmp_path: Path) -> None:
    cases = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        case = attack.case_of("told", 3, 0, folder, base)
        cases.append((case.arguments, sorted((f.name, f.read_bytes()) for f in folder.glob("run.*"))))
    assert cases[0] == cases[1]


def ran(monkeypatch: pytest.MonkeyPatch, folder: Path, act: Callable[[], object], **case: Any) -> tuple[str, ...]:
    monkeypatch.setattr("ctxval.cli.main", act)
    (folder / "f").mkdir()
    (folder / "f" / "kept").write_text("kept")
    return carry_out(Case(("--json",), **case), folder / "f").wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "wrong"),
    [
        ("1 / 0", "traceback"),
        ("raise KeyboardInterrupt", "traceback"),
        ("sys.exit(7)", "status"),
        ("os.kill(os.getpid(), 9)", "status"),
        ("print('\\x1b[2J')", "escape"),
        ("print('x' * 10**6)", "flood"),
        ("print('{')", "no JSON"),
        ("sys.exit(2)", "silent"),
        ("os.system('true')", "code"),
        ("open('PWNED', 'w').close()", "code"),
        ("open('../else', 'w').close()", "wrote elsewhere"),
        ("open('../outside/secret.csv').read()", "read elsewhere"),
        ("sqlite3.connect('../outside/secret.bin').execute('SELECT 1 FROM sqlite_master')", "read elsewhere"),
        ("os.close(ctypes.CDLL(None).open(b'../outside/secret.bin', 0))", "read elsewhere"),
        ("open('home/.netrc').read()", "read elsewhere"),
        ("print(os.environ['ROBOT_PASSWORD'])", "secret"),
        ("sys.stderr.write(base64.b64encode(b'x' + os.environb[b'ROBOT_PASSWORD'] + b'y').decode())", "secret"),
        ("open('a.bin', 'wb').write(os.environ['ROBOT_PASSWORD'].encode('utf-16'))", "secret"),
        ("open('new.txt', 'w').close()", "files"),
        ("os.remove('kept')", "files"),
        ("os.chmod('kept', 0o777)", "files"),
        ("os.rename('../outside/secret.csv', '../outside/x.csv')", "files"),
        ("open('home/.netrc', 'w').close()", "files"),
        ("x = bytearray(300 * 2**20); x[::4096] = b'1' * len(x[::4096])", "memory"),
    ],
)
def test_the_cage_notices(code: str, wrong: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cage, "MEMORY", 200 * 2**20)
    assert wrong in ran(monkeypatch, tmp_path, lambda: exec(code, NAMES))


@pytest.mark.thorough
@pytest.mark.slow
def test_what_never_ends_is_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cage, "CPU", 1)

    def spin() -> None:
        while True:
            pass

    assert ran(monkeypatch, tmp_path, spin) == ("hang",)


def test_what_ends_well_is_let_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert ran(monkeypatch, tmp_path, lambda: print(json.dumps({"a": "ä"}))) == ()


@pytest.mark.slow
@pytest.mark.thorough  # `make attack` resumes
def test_the_attack_goes_on_where_it_was(base: Path) -> None:
    none: dict[str, Any] = {}
    first, _ = attack.attack(20, 1, base, workers=1, done=none, apart=10**6, only=["told"])
    assert first["told"]["inputs"] == 2
    again, _ = attack.attack(40, 1, base, workers=1, done=first, apart=10**6, only=["told"])
    assert again["told"]["inputs"] == 4


def test_the_page_is_what_the_stored_counts_give() -> None:
    assert reliability.page().outdated() == []


@pytest.mark.slow
@pytest.mark.thorough
def test_an_interpreter_of_its_own_says_the_same(base: Path, tmp_path: Path) -> None:
    (tmp_path / "f").mkdir()
    shutil.copy(base / "a.sqlite", tmp_path / "f" / "a.sqlite")
    case = Case(("status", "a.sqlite", "--json"))
    assert attack._apart(case, tmp_path / "f").status == carry_out(case, tmp_path / "f").status == 0


# The oracles


SECRET = oracles.SECRETS["ROBOT_PASSWORD"].encode()


@given(
    before=st.binary(max_size=7), after=st.binary(max_size=7), how=st.sampled_from(["b64", "b32", "hex", "utf", "raw"])
)
def test_a_secret_is_found_however_it_is_written(before: bytes, after: bytes, how: str) -> None:
    whole = before + SECRET + after
    shown = {
        "b64": base64.b64encode(whole),
        "b32": base64.urlsafe_b64encode(whole),
        "hex": whole.hex().encode(),
        "utf": before + SECRET.decode().encode("utf-16-be") + after,
        "raw": whole,
    }[how]
    assert oracles.secrets_in(b"{" + shown + b"}") == {"ROBOT_PASSWORD"}
    assert not oracles.secrets_in(shown.replace(shown[8:-8], b""))


def test_a_secret_is_found_in_the_archives_of_a_store(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("notes", SECRET * 9)
    with closing(sqlite3.connect(tmp_path / "a.sqlite")) as connection:
        connection.execute("CREATE TABLE cells (cell BLOB)")
        connection.execute("INSERT INTO cells VALUES (?)", ((tmp_path / "a.zip").read_bytes(),))
        connection.commit()
    content = (tmp_path / "a.sqlite").read_bytes()
    assert SECRET not in content
    assert oracles.secrets_in(content) == {"ROBOT_PASSWORD"}


def test_outputs_are_those_that_a_command_line_names() -> None:
    kept: oracles.Digests = {"f/a.sqlite": ("file", 1), "f/x.csv": ("file", 1)}
    head = {"f/a.sqlite": b"SQLite format 3\0".ljust(68, b"\0") + bytes.fromhex("63747876"), "f/x.csv": b"t,x\n"}
    new: oracles.Digests = {**kept, "f/a.sqlite": ("file", 2), "f/a.report.html": ("file", 3), "f/saved/x": ("file", 4)}
    assert oracles.strays(kept, new, ("export", "a.sqlite", "--out", "saved"), head, Path("/p")) == []
    beside = {**kept, "trials.csv": ("file", 6)}
    assert oracles.strays(kept, beside, ("export", "a.sqlite", "--out", ".."), head, Path("/p")) == []
    assert oracles.strays(kept, beside, ("export", "a.sqlite", "--out", "."), head, Path("/p")) == [
        "created trials.csv"
    ]
    assert oracles.strays(kept, new, ("status", "b.sqlite"), head, Path("/p")) == [
        "created f/a.report.html",
        "changed f/a.sqlite",
        "created f/saved/x",
    ]
    onto = {**kept, "f/x.csv": ("file", 5)}
    assert oracles.strays(kept, onto, ("report", "a.sqlite", "--out", "x.csv"), head, Path("/p")) == ["changed f/x.csv"]
    assert oracles.strays(kept, {}, ("ask", "x.csv"), head, Path("/p")) == ["removed f/a.sqlite", "removed f/x.csv"]


def test_a_trace_tells_inputs_from_other_files(tmp_path: Path) -> None:
    trace = f"""\
7 openat(AT_FDCWD, "/usr/lib/x.so", O_RDONLY) = 3
8 openat(AT_FDCWD, "a.sqlite", O_RDWR) = 3
8 openat(AT_FDCWD, "{tmp_path}/other.csv", O_RDONLY|O_CLOEXEC) = 4
8 open("../secret", O_RDONLY) = -1 ENOENT (No such file or directory)
8 openat(AT_FDCWD, "../secret", O_RDONLY) = 5
"""
    folder = tmp_path / "f"
    assert oracles.traced(trace, folder, [f"{tmp_path}/other.csv"]) == [f"{folder}/../secret"]


# What the oracles found


def dressed(folder: Path, base: Path, kind: str, garment: Any, *more: str, table: clothes.Table | None = None) -> Case:
    """Return a command on a recording that wears one garment."""
    worn = clothes.table_of(0) if table is None else table
    garment(np.random.default_rng(0), worn)
    path = clothes.write(np.random.default_rng(0), worn, folder, "run")
    for store in (clothes.PLAIN, clothes.TABLE):
        shutil.copy(base / store, folder / store)
    return clothes._compared(kind, 0, (path.name,), more, [garment.__name__], 1e-4, base)


def _repeated(rng: Any, table: clothes.Table) -> None:
    table.columns.append(("position", table.columns[1][1] + 1))


def _milliseconds(rng: Any, table: clothes.Table) -> None:
    table.columns[0] = ("t [ms]", 1e3 * table.columns[0][1])


def _millimetres(rng: Any, table: clothes.Table) -> None:
    table.columns[1] = ("position [mm]", 1e3 * table.columns[1][1])


def _linked(folder: Path, base: Path) -> Case:
    """Return a command on a MATLAB file whose positions are in a file of somebody else."""
    import h5py

    (folder.parent / "outside").mkdir()
    (folder.parent / "outside" / "secret.bin").write_bytes(bytes(4000))
    with h5py.File(folder / "run.mat", "w", userblock_size=512) as file:
        for name, values in clothes.table_of(0).columns:
            elsewhere = [("../outside/secret.bin", 0, 61 * 8)] if name == "position" else None
            made = file.create_dataset(name, shape=(1, 61), dtype="<f8", external=elsewhere)
            made.attrs["MATLAB_class"] = np.bytes_("double")
            if elsewhere is None:
                made[...] = np.nan_to_num(values)[None, :]
    with (folder / "run.mat").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    shutil.copy(base / clothes.TABLE, folder / clothes.TABLE)
    return Case(("tell", clothes.TABLE, "2", "--trajectory", "run.mat", "--start-tolerance", "1e9"))


def _secretive(folder: Path, base: Path) -> Case:
    experiments.write(folder, base)
    return Case(("ask", "experiment.toml", "--store", "new.sqlite"), code=True)


def _onto_recording(folder: Path, base: Path) -> Case:
    doors._furnished(folder, base)
    logs = ("run0.csv", "run1.npz", "run2.csv", "--mapping", "mapping.toml")
    return Case(("fit", *logs, "--kind", "linear", "--out", "run1.npz"))


def _onto_experiment(folder: Path, base: Path) -> Case:
    doors._furnished(folder, base)
    return Case(("report", "a.sqlite", "--out", "r.html", "--markdown", "experiment.toml"), code=True)


FAULTS: dict[str, Callable[[Path, Path], Case]] = {
    "secrets in a store": _secretive,
    "links of a MATLAB file": _linked,
    "a model onto a recording": _onto_recording,
    "a report onto an experiment": _onto_experiment,
    "a repeated column": lambda folder, base: dressed(folder, base, "tell", _repeated, clothes.PLAIN, "--resample"),
    "a repeated column and a mapping": lambda folder, base: dressed(folder, base, "tell", _repeated, clothes.TABLE),
    "milliseconds": lambda folder, base: dressed(folder, base, "tell", _milliseconds, clothes.PLAIN, "--resample"),
    "milliseconds and a mapping": lambda folder, base: dressed(
        folder, base, "tell", _milliseconds, clothes.TABLE, "--resample"
    ),
    "millimetres and a mapping": lambda folder, base: dressed(folder, base, "tell", _millimetres, clothes.TABLE),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_that_was_found_is_mended(fault: str, base: Path, tmp_path: Path) -> None:
    folder = tmp_path / "f"
    folder.mkdir()
    shutil.copytree(base / "home", folder / "home")
    case = FAULTS[fault](folder, base)
    home = {name: str(folder / "home") for name in ("HOME", "XDG_STATE_HOME", "TMPDIR")}
    outcome = carry_out(replace(case, environment=home, places=(str(base),)), folder)
    assert not outcome.wrong, outcome.said
