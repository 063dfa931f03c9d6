"""The same recording in other clothes: other formats, columns, units and marks give the same distance, or a refusal."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Experiment, Plan, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, systems
from ctxval.campaign.telling import SuppliedResult
from ctxval.data import LogMapping
from ctxval.errors import InputError
from facts import refuses
from rig_logs import write_bag, write_bag1

FORMATS = ("comma", "semicolon", "tab", "npz", "mat5", "mat7.3", "parquet", "mcap", "bag", "bag1")

UNITS = {
    "angle": {"rad": 1.0, "deg": 180 / np.pi, "mrad": 1e3},
    "rate": {"rad/s": 1.0, "deg/s": 180 / np.pi, "rpm": 30 / np.pi},
    "torque": {"N m": 1.0, "mN m": 1e3, "kNm": 1e-3},
    "t": {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9},
}
SUFFIXES = {"deg/s": "deg_s", "rad/s": "rad_per_s", "N m": "Nm", "mN m": "mNm"}


@dataclass(frozen=True)
class Clothes:
    """How a recording is written."""

    form: str
    order: tuple[str, ...]
    units: dict[str, str]
    style: str
    renamed: bool
    time: str
    since_1970: bool
    decimal_comma: bool
    repeated: str
    extra: bool


@st.composite
def clothes(draw: st.DrawFn) -> Clothes:
    return Clothes(
        form=draw(st.sampled_from(FORMATS)),
        order=tuple(draw(st.permutations(("t", "angle", "rate", "torque")))),
        units={name: draw(st.sampled_from(tuple(units))) for name, units in UNITS.items()},
        style=draw(st.sampled_from(("brackets", "parentheses", "suffix", "mapping"))),
        renamed=draw(st.booleans()),
        time=draw(st.sampled_from(("t", "time", "timestamp"))),
        since_1970=draw(st.booleans()),
        decimal_comma=draw(st.booleans()),
        repeated=draw(st.sampled_from(("", "", "", "angle", "torque"))),
        extra=draw(st.booleans()),
    )


@functools.cache
def experiment() -> tuple[Experiment, Plan]:
    states, inputs = {"angle": "rad", "rate": "rad/s"}, {"torque": "N m"}
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0, "rad")),
        task=lambda p: Task([0, 0], goal=[p.goal, 0], horizon=20, dt=0.1),
        system=systems.Manual(states=states, inputs=inputs, dt=0.1),
        model=models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]),
        synthesizer=controllers.LQR([10, 1], [0.1], limits=3.0),
        distance=distances.MaximumDeviation(weights=(1, 1)),
    )
    made = Experiment("rig", validation, units="rad")
    return made, validation.plan([1.25])


@functools.cache
def recorded() -> tuple[Trajectory, float]:
    """Return a recording, and its distance."""
    made, plan = experiment()
    model = plan.model_trajectory
    noise = 0.05 * np.random.default_rng(0).normal(size=model.states.shape)
    noise[0] = 0
    one = Trajectory(model.times, model.states + noise, model.inputs * 0.9)
    distance = made.validation.accept(plan, one)
    assert distance is not None
    assert distance > 0.05
    return one, distance


def columns_of(worn: Clothes) -> tuple[list[tuple[str, np.ndarray]], dict[str, str]]:
    """Return the columns with their names, and the column of each quantity."""
    one, _ = recorded()
    padded = np.append(one.inputs[:, 0], np.nan)
    values = {"t": one.times, "angle": one.states[:, 0], "rate": one.states[:, 1], "torque": padded}
    if worn.since_1970 and worn.time != "t":
        values["t"] = values["t"] + 1.7e9
    columns, names = [], {}
    for name in worn.order:
        unit = worn.units[name]
        plain = worn.time if name == "t" else f"my_{name}_x" if worn.renamed else name
        suffix = SUFFIXES.get(unit, unit)
        forms = {"brackets": f"{plain} [{unit}]", "parentheses": f"{plain} ({unit})", "suffix": f"{plain}_{suffix}"}
        names[name] = forms.get(worn.style, plain)
        columns.append((names[name], values[name] * UNITS[name][unit]))
    if worn.repeated:
        wrong = np.full(len(padded), 0.123)
        columns.insert(0, (names[worn.repeated], wrong))
        columns.append((names[worn.repeated], wrong))
    if worn.extra:
        columns.append(("episode", np.full(len(padded), 3.0)))
    return columns, names


def mapping_of(worn: Clothes, names: dict[str, str]) -> LogMapping | None:
    """Return the mapping that names the columns, and states the units that they do not state."""
    if not worn.renamed and worn.style != "mapping":
        return None
    stated = worn.style != "mapping"
    fields = {
        name: {"path": names[name], **({} if stated else {"recorded": worn.units[name], "unit": unit})}
        for name, unit in (("angle", "rad"), ("rate", "rad/s"), ("torque", "N m"))
    }
    table: dict[str, Any] = {
        "states": {"angle": fields["angle"], "rate": fields["rate"]},
        "inputs": {"torque": fields["torque"]},
        "time_unit": "" if stated else worn.units["t"],
    }
    return LogMapping.from_table(table)


def write_table(path: Path, columns: list[tuple[str, np.ndarray]], separator: str, comma: bool) -> None:
    rows = [[name for name, _ in columns] + ["note"]]
    for row in zip(*(values.tolist() for _, values in columns), strict=True):
        cells = ["" if np.isnan(value) else repr(value) for value in row]
        rows.append([cell.replace(".", ",") if comma else cell for cell in cells] + ["fine"])
    path.write_text("".join(separator.join(row) + "\n" for row in rows))


def write_json(path: Path, columns: list[tuple[str, np.ndarray]], times: np.ndarray) -> None:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("rig", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/rig", "json", schema)
        for k, time in enumerate(times):
            pairs = [(name, 0.0 if np.isnan(values[k]) else float(values[k])) for name, values in columns]
            data = "{" + ", ".join(f"{json.dumps(name)}: {value!r}" for name, value in pairs) + "}"
            stamp = 10**18 + round(1e9 * time)
            writer.add_message(channel, log_time=stamp, publish_time=stamp, data=data.encode())
        writer.finish()


def written(folder: Path, worn: Clothes) -> tuple[Path, LogMapping | None, bool]:
    """Write the recording; return the file, its mapping, and whether it must be refused."""
    if worn.style in ("brackets", "parentheses") and worn.form in ("mat5", "mat7.3", "mcap"):
        worn = replace(worn, style="suffix")  # names there are letters, digits and underscores
    columns, names = columns_of(worn)
    mapping, twice = mapping_of(worn, names), bool(worn.repeated)
    one, _ = recorded()
    if worn.form in ("comma", "semicolon", "tab"):
        path = folder / "run.csv"
        write_table(path, columns, {"comma": ",", "semicolon": ";", "tab": "\t"}[worn.form], worn.decimal_comma)
        return path, mapping, twice or (worn.form == "comma" and worn.decimal_comma)
    if worn.form == "mcap":
        write_json(folder / "run.mcap", columns, one.times)
        fields = {
            name: {"path": f"/rig.{names[name]}", "recorded": worn.units[name], "unit": unit}
            for name, unit in (("angle", "rad"), ("rate", "rad/s"), ("torque", "N m"))
        }
        states = {name: fields[name] for name in ("angle", "rate")}
        content = {"states": states, "inputs": {"torque": fields["torque"]}}
        return folder / "run.mcap", LogMapping.from_table(content), twice
    if worn.form in ("bag", "bag1"):
        factors = {name: UNITS[name][worn.units[name]] for name in ("angle", "rate", "torque")}
        states = one.states * [factors["angle"], factors["rate"]]
        path = folder / ("run.bag" if worn.form == "bag1" else "bag")
        write = write_bag1 if worn.form == "bag1" else write_bag
        write(path, Trajectory(one.times, states, one.inputs * factors["torque"]))
        paths = {"angle": "position", "rate": "velocity", "torque": "effort"}
        fields = {
            name: {"path": f"/joints.{paths[name]}[0]", "recorded": worn.units[name], "unit": unit}
            for name, unit in (("angle", "rad"), ("rate", "rad/s"), ("torque", "N m"))
        }
        content = {
            "states": {name: fields[name] for name in ("angle", "rate")},
            "inputs": {"torque": fields["torque"]},
        }
        return path, LogMapping.from_table(content), False
    if worn.form == "parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(
            pa.Table.from_arrays([v for _, v in columns], names=[n for n, _ in columns]), folder / "a.parquet"
        )
        return folder / "a.parquet", mapping, twice
    if twice:  # a name can be there once only
        return written(folder, replace(worn, repeated=""))
    arrays = dict(columns)
    if worn.form == "npz":
        np.savez(folder / "run.npz", **arrays)
        mapping = mapping or LogMapping.from_table(
            {"states": {"angle": "angle", "rate": "rate"}, "inputs": {"torque": "torque"}}
        )
        return folder / "run.npz", mapping, False
    if worn.form == "mat5":
        from scipy.io import savemat

        savemat(folder / "run.mat", arrays)
    else:
        import hdf5storage

        hdf5storage.savemat(str(folder / "run.mat"), arrays, format="7.3", oned_as="column")
    return folder / "run.mat", mapping, False


def read(path: Path, mapping: LogMapping | None) -> Trajectory:
    """Read a recording in this process; tests of ``SuppliedResult`` show that a confined process reads the same."""
    made, plan = experiment()
    return SuppliedResult(mapping=mapping).read_file(path, *made.names(2, 1), plan.task.times)


@pytest.mark.slow
@given(worn=clothes())
def test_the_same_recording_in_other_clothes_has_the_same_distance(
    worn: Clothes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path, mapping, refused = written(tmp_path_factory.mktemp("same"), worn)
    made, plan = experiment()
    if refused:
        with refuses(InputError):
            read(path, mapping)
        return
    found = made.validation.accept(plan, read(path, mapping))
    assert found == pytest.approx(recorded()[1], rel=1e-9)
