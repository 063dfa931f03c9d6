"""The same recordings in other clothes: formats, columns, units. The answer is the same, or a refusal.

A garment changes how a recording is written, and leaves what it means. Some make a file that nobody can read for
certain, such as a column that stands in it twice; such a file may only be refused.
"""

from __future__ import annotations

import functools
import json
import math
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hostile.cage import Case, carry_out
from hostile.values import Rng, pick

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import rig_dialects
import rig_logs
from ctxval import Trajectory

RUNS = 4
"""Recordings of which each is told, and all of which are replayed and fitted together."""
TABLE, PLAIN = "table.sqlite", "rig.sqlite"
"""Stores with a mapping of columns, and without one."""
COLUMNS = {"position": "m", "speed": "m/s", "force": "N"}
MAPPING = """
[recordings]
dt = 0.05
[recordings.states]
position = { path = "position", unit = "m" }
speed = { path = "speed", unit = "m/s" }
[recordings.inputs]
force = { path = "force", unit = "N" }
"""


@dataclass
class Table:
    """A recording as a table: the columns may have any names, and the cells of a text file may be texts.

    Attributes:
        columns: names with their values; a name may stand twice.
        separator, decimal, end, head: of a text file.
        quoted, spaced: whether cells are quoted, or padded with blanks.
        kind: the suffix of the file.
        tolerance: relative difference of answers that rounding explains.
        dialect: the name of a dialect in which a text file is written, if any.
        worn: the garments.
        extra: a hook for the writer of one format.
    """

    columns: list[tuple[str, Any]]
    separator: str = ","
    decimal: str = "."
    end: str = "\n"
    head: bytes = b""
    quoted: bool = False
    spaced: bool = False
    kind: str = ".csv"
    dialect: str = ""
    tolerance: float = 1e-6
    worn: list[str] = field(default_factory=list)

    def place(self, name: str) -> int:
        """Return where a column is, whatever garments have made of its name; the first one is that of the times."""
        found = [k for k, (label, _) in enumerate(self.columns) if label.partition(" ")[0].lower() == name]
        return found[0] if found else 0


@functools.cache
def run(number: int) -> Trajectory:
    """Return a recording of a cart."""
    return rig_logs.run(60, seed=100 + number)


def table_of(number: int) -> Table:
    """Return a recording as a plain table."""
    one = run(number)
    force = np.append(one.inputs[:, 0], np.nan)
    return Table([("t", one.times), ("position", one.states[:, 0]), ("speed", one.states[:, 1]), ("force", force)])


# Garments: (random numbers, table)


def _permuted(rng: Rng, table: Table) -> None:
    table.columns = [table.columns[k] for k in rng.permutation(len(table.columns))]


def _more(rng: Rng, table: Table) -> None:
    name = str(pick(rng, ("temperature", "x", "u", "comment", "states", "battery [V]", "position_raw", "dt")))
    table.columns.insert(int(rng.integers(5)), (name, 20 + rng.random(len(table.columns[0][1]))))


def _labelled(rng: Rng, table: Table) -> None:
    names = {**COLUMNS, "t": "s"}
    table.columns = [(f"{name} [{names[name]}]" if name in names else name, v) for name, v in table.columns]


def _in_units(rng: Rng, table: Table) -> None:
    """Write a column in another unit, which its header names."""
    units = (
        *(("position", "mm", 1e3), ("position", "cm", 1e2), ("position", "km", 1e-3), ("speed", "km/h", 3.6)),
        *(("speed", "mm/s", 1e3), ("force", "kN", 1e-3), ("force", "mN", 1e3), ("position", "inch", 1 / 0.0254)),
    )
    name, unit, factor = pick(rng, units)
    place = table.place(name)
    table.columns[place] = (f"{name} [{unit}]", factor * table.columns[place][1])


def _other_times(rng: Rng, table: Table) -> None:
    """Write the times in another unit, which the header names, or not; all known steps are 0.05 s."""
    kinds: tuple[tuple[str, float], ...] = (
        *(("t [ms]", 1e3), ("t [us]", 1e6), ("t [ns]", 1e9), ("time_ms", 1e3), ("t_ms", 1e3), ("time [ms]", 1e3)),
        *(("timestamp", 1e9), ("timestamp", 1e3), ("t", 1e3), ("time", 1e6), ("t [min]", 1 / 60), ("time (ms)", 1e3)),
    )
    name, factor = pick(rng, kinds)
    origin = 1_700_000_000 if name == "timestamp" or rng.random() < 0.2 else 0
    place = table.place("t")
    times = np.round(factor * (origin + np.asarray(table.columns[place][1])), 9)
    table.columns[place] = (name, times)
    # Seconds since 1970 as 64-bit numbers are exact to 0.2 us, those of nanoseconds to 256 ns.
    table.tolerance = max(table.tolerance, 1e-3 if origin else 0)


def _epoch(rng: Rng, table: Table) -> None:
    place = table.place("t")
    table.columns[place] = ("timestamp", 1_700_000_000 + np.asarray(table.columns[place][1]))
    table.tolerance = max(table.tolerance, 1e-3)


def _repeated(rng: Rng, table: Table) -> None:
    """Repeat a column: with the same values, or with others."""
    if table.kind not in (".csv", ".parquet"):
        return  # other files name each array once
    name = str(pick(rng, ("position", "speed", "force", "t")))
    label, values = table.columns[table.place(name)]
    other = values if rng.random() < 0.2 else np.asarray(values) + rng.normal(size=len(values))
    if rng.random() < 0.3:
        label = f"{name} [{ {**COLUMNS, 't': 's'}[name] }]"
    table.columns.insert(int(rng.integers(len(table.columns) + 1)), (label, other))


def _marked(rng: Rng, table: Table) -> None:
    """Mark a missing value as loggers do; the place is in the middle, as the end is not compared by all."""
    place = table.place(str(pick(rng, ("position", "speed", "force"))))
    name, values = table.columns[place]
    values = np.array(values)
    values[30] = pick(rng, (-999.0, -9999.0))
    table.columns[place] = name, values
    table.tolerance = 1.0  # the steps around it are missing


def _episodes(rng: Rng, table: Table) -> None:
    """Append the recording again, at later times; a column of numbers tells the two apart."""
    count = len(table.columns[0][1])
    joined = []
    for name, values in table.columns:
        old = np.asarray(values)
        later = old[-1] + old[1] - 2 * old[0] if name.lower().startswith("t") else 0
        joined.append((name, np.concatenate([old, old + later])))
    table.columns = [*joined, (str(pick(rng, ("episode", "episode_index", "run"))), np.repeat([0, 1], count))]
    table.tolerance = 1.0


def _semicolons(rng: Rng, table: Table) -> None:
    table.separator = str(pick(rng, (";", "\t")))
    table.decimal = str(pick(rng, (",", ".")))


def _decimal_commas(rng: Rng, table: Table) -> None:
    table.decimal = ","


def _text(rng: Rng, table: Table) -> None:
    table.end = str(pick(rng, ("\r\n", "\n\n", "\n")))
    table.head = pick(rng, (b"", b"\xef\xbb\xbf"))
    table.quoted, table.spaced = bool(rng.random() < 0.4), bool(rng.random() < 0.4)


def _capitals(rng: Rng, table: Table) -> None:
    table.columns = [(name.capitalize() if rng.random() < 0.7 else name, values) for name, values in table.columns]


def _renamed(rng: Rng, table: Table) -> None:
    other = {"position": "x0", "speed": "x1", "force": "u0"}
    table.columns = [(other.get(name, name), values) for name, values in table.columns]


def _single(rng: Rng, table: Table) -> None:
    if all(abs(np.nanmax(np.abs(values))) < 1e6 for _, values in table.columns):
        table.columns = [(name, np.asarray(values, dtype=np.float32)) for name, values in table.columns]
        table.tolerance = max(table.tolerance, 1e-3)


def _again(rng: Rng, table: Table) -> None:
    """Write a row twice, as a logger does that is flushed at its end."""
    row = int(rng.integers(1, 60))
    table.columns = [
        (name, np.insert(np.asarray(values), row, np.asarray(values)[row])) for name, values in table.columns
    ]
    table.tolerance = 1.0


def _dialect(rng: Rng, table: Table) -> None:
    table.dialect = str(pick(rng, tuple(rig_dialects.DIALECTS)))
    table.tolerance = 1.0 if table.dialect == "rows twice" else max(table.tolerance, 1e-3)  # clock times are rounded


GARMENTS: tuple[Callable[[Rng, Table], None], ...] = (
    *(_permuted, _permuted, _more, _labelled, _in_units, _in_units, _other_times, _other_times, _epoch, _repeated),
    *(_repeated, _marked, _episodes, _semicolons, _decimal_commas, _text, _capitals, _renamed, _single, _again),
    *[_dialect] * 4,
)
SUFFIXES = (".csv", ".csv", ".csv", ".npz", ".mat", ".mat73", ".parquet")
QUICK = (*[".csv"] * 24, ".npz", ".npz", *SUFFIXES[4:])
"""Mostly files that `tell` and `import` read in their own process: another one takes seconds."""


def dressed(rng: Rng, number: int, suffixes: Sequence[str] = SUFFIXES) -> Table:
    """Return a recording with up to three garments."""
    table = table_of(number)
    table.kind = str(pick(rng, suffixes))
    for _ in range(int(rng.integers(1, 4))):
        garment = pick(rng, GARMENTS)
        if garment.__name__ not in table.worn:
            garment(rng, table)
            table.worn.append(garment.__name__)
    return table


# Writers


def write(rng: Rng, table: Table, folder: Path, stem: str) -> Path:
    """Write a table as a file of its kind."""
    path = folder / f"{stem}{'.mat' if table.kind == '.mat73' else table.kind}"
    names = [name for name, _ in table.columns]
    arrays = {name: np.asarray(values) for name, values in table.columns}
    if table.kind == ".csv":
        if table.dialect and names[0] == "t" and not (table.quoted or table.spaced):
            path, content = _in_dialect(table, path)
            path.write_bytes(content)
        else:
            path.write_bytes(table.head + _csv(table).encode())
    elif table.kind == ".npz":
        np.savez(path, **arrays)
    elif table.kind == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = [pa.array(values) for _, values in table.columns]
        place = table.place("t")
        if "timestamp" in names[place] and rng.random() < 0.5:
            unit = str(pick(rng, ("ms", "us", "ns")))
            seconds = 1_700_000_000 + np.asarray(run(0).times)[np.arange(len(table.columns[place][1])) % 61]
            factor = {"ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
            columns[place] = pa.array(np.round(seconds * factor).astype(np.int64)).cast(pa.timestamp(unit))
            table.worn.append(f"timestamp[{unit}]")
        pq.write_table(pa.Table.from_arrays(columns, names=names), path)
    else:
        shape = (-1, 1) if rng.random() < 0.5 else (1, -1)
        content = {_matlab(name): values.reshape(shape) for name, values in arrays.items()}
        if table.kind == ".mat":
            from scipy.io import savemat

            savemat(path, content)
        else:
            import hdf5storage

            hdf5storage.savemat(str(path), content, format="7.3", oned_as="column")
    return path


def _matlab(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name).strip("_")


def _in_dialect(table: Table, path: Path) -> tuple[Path, bytes]:
    """Return where a table is written, and in which bytes; blanks that separate columns leave no empty cell."""
    ending, written = rig_dialects.DIALECTS[table.dialect]
    empty = "nan" if " " in table.dialect else ""
    content = written([[cell or empty for cell in row] for row in _cells(table)])
    return path.with_suffix(ending), content if isinstance(content, bytes) else content.encode()


def _cells(table: Table) -> list[list[str]]:
    rows = zip(*(values for _, values in table.columns), strict=True)
    cells = [["" if math.isnan(value) else repr(float(value)) for value in row] for row in rows]
    return [[name for name, _ in table.columns], *cells]


def _csv(table: Table) -> str:
    names, *rows = _cells(table)
    cells = [names, *([text.replace(".", table.decimal) for text in row] for row in rows)]
    if table.quoted:
        cells = [[f'"{cell}"' for cell in row] for row in cells]
    blank = " " if table.spaced else ""
    return table.end.join(f"{table.separator}{blank}".join(row) for row in cells) + table.end


def _bag(rng: Rng, folder: Path, number: int) -> tuple[Path, tuple[str, ...], str]:
    """Write a recording as messages; return the file, its fields, and what is special about it."""
    one, kind = run(number), int(rng.integers(5))
    cart = ("/joints.position[0]", "/joints.velocity[0]", "/joints.effort[0]")
    if kind == 0:
        rig_logs.write_mcap_json(folder / "run.mcap", one, start=int(pick(rng, (10**9, 10**18))))
        return folder / "run.mcap", ("/state.cart.position", "/state.cart.speed[0]", "/command.force"), "mcap json"
    if kind == 1:
        rig_logs.write_bag1(folder / "run.bag", one)
        return folder / "run.bag", cart, "bag of ROS 1"
    if kind == 2:
        rig_logs.write_bag1(folder / "run.mcap", one, to_mcap=True)
        return folder / "run.mcap", cart, "ROS 1 in mcap"
    if kind == 3:
        rig_logs.write_bag(folder / "bag", one, late=rng.uniform(0, 0.03, len(one.times)))
        return folder / "bag", cart, "bag with late log times"
    rig_logs.write_mcap_ros2(folder / "run.mcap", one, late=float(pick(rng, (0.0, 0.3))))
    return folder / "run.mcap", cart, "ROS 2 in mcap"


# Commands, and their answers


def case(rng: Rng, folder: Path, base: Path) -> Case:
    """Make an input: one command with recordings in other clothes."""
    kind = str(pick(rng, ("tell", "tell", "tell", "import", "replay", "replay", "messages", "fit")))
    number = int(rng.integers(RUNS - 1))
    if kind in ("tell", "import"):
        table = dressed(rng, number, QUICK)
        path = write(rng, table, folder, "run")
        store = str(pick(rng, (TABLE, PLAIN) if table.kind in (".csv",) else (TABLE,)))
        shutil.copy(base / store, folder / store)
        more = ("--resample",) if rng.random() < 0.4 else ()
        return _compared(kind, number, (path.name,), (store, *more), [*table.worn, table.kind], table.tolerance, base)
    if kind == "messages":
        path, fields, what = _bag(rng, folder, number)
        _write_model(folder)
        return _compared("replay", number, (path.name,), fields, [what], 1e-3, base)
    (folder / "mapping.toml").write_text(MAPPING)
    tables = [dressed(rng, k) if k == number or rng.random() < 0.2 else table_of(k) for k in range(RUNS)]
    files = tuple(write(rng, table, folder, f"run{k}").name for k, table in enumerate(tables))
    worn = [one for table in tables for one in [*table.worn, table.kind]]
    _write_model(folder)
    return _compared(kind, -1, files, (), worn, max(table.tolerance for table in tables), base)


def _write_model(folder: Path) -> None:
    np.savez(folder / "model.npz", A=[[1.0, 0.05], [0.0, 1.0]], B=[[0.0], [0.05]])


def _line(kind: str, files: Sequence[str], more: Sequence[str]) -> tuple[str, ...]:
    tolerant = ("--start-tolerance", "1e9", "--json")
    if kind == "tell":
        return ("tell", more[0], "2", "--trajectory", *files, *more[1:], *tolerant)
    if kind == "import":
        return ("import", more[0], *files, "--set", "goal=1.0", "--set", "load=0.1", *more[1:], *tolerant)
    names = ("--state", "--state", "--input")
    fields = [f"{name}={path}" for name, path in zip(COLUMNS, more, strict=False)]
    mapped = [word for pair in zip(names, fields, strict=False) for word in pair] or ["--mapping", "mapping.toml"]
    if kind == "fit":
        return ("fit", *files, *mapped, "--kind", "linear", "--json")
    return ("replay", *files, "--model", "model.npz", *mapped, "--dt", "0.05", "--steps", "1,10", "--json")


def _compared(
    kind: str, number: int, files: Sequence[str], more: Sequence[str], worn: list[str], tolerance: float, base: Path
) -> Case:
    expected = _expected(kind, number, more[0] if kind in ("tell", "import") else "", base)

    # An error may be zero for plain recordings, and that of rounded numbers or times for others.
    margin = (1e-6 if "_single" in worn else 1e-9) + 0.02 * tolerance * max(map(abs, expected))

    def check(status: int, out: bytes) -> list[str]:
        if status != 0:
            return []
        found = _answer(kind, out)
        known = expected
        if kind == "fit" and tolerance >= 1 and found:
            known = expected[: len(found)]  # held-out parts of recordings may be too short for long predictions
        same = len(found) == len(known) and np.allclose(found, known, rtol=tolerance, atol=margin)
        shown = f"{np.round(found, 5)} in place of {np.round(expected, 5)} for {worn}"
        return [] if same else [f"other answer: {kind}: {shown}"]

    return Case(_line(kind, files, more), check=check)


@functools.cache
def _expected(kind: str, number: int, store: str, base: Path) -> tuple[float, ...]:
    """Return the answer for plain recordings."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "f"
        folder.mkdir()
        (folder / "mapping.toml").write_text(MAPPING)
        _write_model(folder)
        if store:
            shutil.copytree(base / "home", folder / "home")
            shutil.copy(base / store, folder / store)
        rng = np.random.default_rng(0)
        numbers = range(RUNS) if number < 0 else (number,)
        files = [write(rng, table_of(k), folder, f"run{k}").name for k in numbers]
        outs: list[bytes] = []
        home = {name: str(folder / "home") for name in ("HOME", "XDG_STATE_HOME", "TMPDIR")}
        (folder / "home").mkdir(exist_ok=True)

        def kept(status: int, out: bytes) -> list[str]:
            outs.append(out)
            return []

        outcome = carry_out(Case(_line(kind, files, (store,) if store else ()), environment=home, check=kept), folder)
        if outcome.status:
            raise RuntimeError(f"{kind} {store}: {outcome.said}")
        return tuple(_answer(kind, outs[0]))


def _answer(kind: str, out: bytes) -> list[float]:
    report = json.loads(out)
    if kind == "tell":
        return [_number(report["distance"])]
    if kind == "import":
        return [_number(one["distance"]) for one in report["imported"]]
    if kind == "fit":
        return [_number(one["rms"]) for one in report["fitted"][0]["errors"]]
    return [_number(one["rms"]) for one in report["errors"]]


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
