"""Recordings in several tables: logs of PX4, and one file for each topic."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from ctxval.data import LogMapping, read_logs, read_recordings
from ctxval.errors import InputError
from facts import is_named, refuses

FAST = 0.004 * np.arange(500)
SLOW = 0.1 * np.arange(20)
RATES = np.column_stack([np.sin(FAST), np.cos(FAST), 0 * FAST])
MAPPING = LogMapping.from_table({"states": {"roll": {"path": "xyz[0]"}}, "inputs": {"u": {"path": "control[0]"}}})


def ulog(path: Path, topics: dict[str, tuple[str, np.ndarray, np.ndarray]], boot: float = 328.8) -> Path:
    """Write a log by the specification of the format, https://docs.px4.io/main/en/dev_log/ulog_file_format.html."""

    def message(kind: bytes, content: bytes) -> bytes:
        return struct.pack("<Hc", len(content), kind) + content

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message(b"B", bytes(40))]
    for name, (field, _, values) in topics.items():
        definition = f"{name}:uint64_t timestamp;float[{values.shape[1]}] {field};"
        parts.append(message(b"F", definition.encode()))
    parts += [message(b"A", struct.pack("<BH", 0, k) + name.encode()) for k, name in enumerate(topics)]
    for k, (_, times, values) in enumerate(topics.values()):
        for time, row in zip(times, values, strict=True):
            stamp = round(1e6 * (boot + time))
            parts.append(message(b"D", struct.pack(f"<HQ{len(row)}f", k, stamp, *row)))
    path.write_bytes(b"".join(parts))
    return path


def dataflash(path: Path, topics: dict[str, tuple[str, str, np.ndarray, np.ndarray]], boot: float = 12.5) -> Path:
    """Write a log of ArduPilot, https://ardupilot.org/dev/docs/logmessages.html: names, ids of units, times, values."""

    def message(kind: int, form: str, *values: object) -> bytes:
        return struct.pack(f"<3B{form}", 0xA3, 0x95, kind, *values)

    def format_of(kind: int, name: str, form: str, columns: str) -> bytes:
        sizes = {"Q": "Q", "f": "f", "B": "B", "b": "b", "N": "16s", "Z": "64s", "d": "d"}
        length = 3 + struct.calcsize("<" + "".join(sizes[each] for each in form))
        return message(0x80, "BB4s16s64s", kind, length, name.encode(), form.encode(), columns.encode())

    parts = [format_of(100, "UNIT", "QbZ", "TimeUS,Id,Label")]
    parts += [format_of(101, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")]
    parts += [message(100, "Qb64s", 0, ord(key), unit.encode()) for key, unit in (("s", "s"), ("d", "deg"), ("#", "i"))]
    for kind, (name, (columns, ids, _, values)) in enumerate(topics.items(), 1):
        form = "B" * ids.count("#") + "f" * (values.shape[1] - ids.count("#"))
        parts.append(format_of(kind, name, f"Q{form}", f"TimeUS,{columns}"))
        parts.append(message(101, "QB16s16s", 0, kind, f"s{ids}".encode(), b"-" * (1 + len(ids))))
    for kind, (_, ids, times, values) in enumerate(topics.values(), 1):
        form = "B" * ids.count("#") + "f" * (values.shape[1] - ids.count("#"))
        for time, row in zip(times, values, strict=True):
            first = [int(value) for value in row[: ids.count("#")]]
            parts.append(message(kind, f"Q{form}", round(1e6 * (boot + time)), *first, *row[len(first) :]))
    path.write_bytes(b"".join(parts))
    return path


def table(path: Path, names: str, times: np.ndarray, values: np.ndarray) -> Path:
    stamps = [f"{round(1e6 * (328.8 + time))}" for time in times]
    rows = [",".join([stamp, *map(repr, row)]) for stamp, row in zip(stamps, values.tolist(), strict=True)]
    path.write_text("\n".join([names, *rows, ""]))
    return path


def flight(folder: Path, name: str) -> list[Path]:
    return [
        table(folder / f"{name}_actuator_controls_0.csv", "timestamp,control[0]", SLOW, SLOW[:, None]),
        table(folder / f"{name}_vehicle_rates_0.csv", "timestamp,xyz[0],xyz[1],xyz[2]", FAST, RATES),
    ]


def test_a_log_of_px4_is_read_at_the_rates_of_its_topics(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    topics = {"rates": ("xyz", FAST, RATES), "controls": ("control", SLOW, SLOW[:, None])}
    path = ulog(tmp_path / "flight.ulg", topics)
    (log,) = read_logs([path])
    assert set(log.fields()) == {"xyz[0]", "xyz[1]", "xyz[2]", "control[0]"}
    recordings = read_recordings([path], MAPPING)
    (run,) = recordings.runs
    assert recordings.dt == pytest.approx(0.004)
    np.testing.assert_allclose(run.trajectory.states[:, 0], np.sin(run.trajectory.times), atol=1e-4)
    held = np.floor(run.trajectory.times[:-1] / 0.1 + 1e-6) * 0.1
    np.testing.assert_allclose(run.trajectory.inputs[:, 0], held, atol=1e-3)


def test_damaged_parts_of_a_log_of_px4_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyulog")
    path = ulog(tmp_path / "a.ulg", {"rates": ("xyz", FAST, RATES), "controls": ("control", SLOW, SLOW[:, None])})
    content = path.read_bytes()
    path.write_bytes(content[:-17] + struct.pack("<HcH", 14, b"D", 999) + content[-12:])  # a topic that is not there
    assert [note for note in read_recordings([path], MAPPING).notes if is_named(note, "a.ulg")]
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("content", [b"", b"ULog", b"ULog\x01\x12\x35\x01" + bytes(8)])
def test_a_damaged_log_of_px4_is_refused(content: bytes, tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    (tmp_path / "a.ulg").write_bytes(content)
    with refuses(InputError, "a.ulg"):
        read_logs([tmp_path / "a.ulg"])


def test_a_log_of_ardupilot_is_read_with_its_units_and_instances(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    roll, numbers = np.degrees(np.sin(FAST))[:, None], np.arange(len(FAST))[:, None] % 2
    topics = {
        "ATT": ("Roll", "d", FAST, roll),
        "RCO": ("C1", "-", SLOW, SLOW[:, None]),
        "IMU": ("I,Gyr", "#-", FAST, np.hstack([numbers, RATES[:, 1:2]])),
    }
    path = dataflash(tmp_path / "flight.bin", topics)
    (log,) = read_logs([path])
    assert {"Roll [deg]", "C1", "IMU_0.Gyr", "IMU_1.Gyr"} <= set(log.fields())
    mapping = {"states": {"roll": {"path": "Roll", "unit": "rad"}, "rate": "IMU_0.Gyr"}, "inputs": {"u": "C1"}}
    recordings = read_recordings([path], LogMapping.from_table(mapping))
    (run,) = recordings.runs
    assert recordings.dt == pytest.approx(0.004)
    times = run.start - 12.5 + run.trajectory.times
    np.testing.assert_allclose(run.trajectory.states, np.column_stack([np.sin(times), np.cos(times)]), atol=1e-4)


@pytest.mark.parametrize("content", [b"", bytes(600), b"\xa3\x95\x80\x80\x59FMT"])
def test_a_file_that_is_no_log_of_ardupilot_is_refused(content: bytes, tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    (tmp_path / "a.bin").write_bytes(content)
    with refuses(InputError, "a.bin"):
        read_logs([tmp_path / "a.bin"])


def test_files_of_topics_are_one_recording_for_each_flight(tmp_path: Path) -> None:
    paths = [path for name in ("log_1", "log_2") for path in flight(tmp_path, name)]
    recordings = read_recordings(paths, MAPPING)
    assert recordings.dt == pytest.approx(0.004)
    assert len(recordings.runs) == 2
    assert [len(log.fields()) for log in read_logs([tmp_path])] == [4, 4]
    for run in recordings.runs:
        np.testing.assert_allclose(run.trajectory.states[:, 0], np.sin(run.trajectory.times), atol=1e-6)
    assert sum("read as one recording" in note for note in recordings.notes) == 2


def test_a_field_of_several_topics_is_named_with_its_topic(tmp_path: Path) -> None:
    for axis in ("left", "right"):
        values = FAST[:, None] * (1 if axis == "left" else -1)
        table(tmp_path / f"run_{axis}_0.csv", f"timestamp,speed,{axis}", FAST, np.hstack([values, values]))
    (log,) = read_logs([tmp_path])
    assert set(log.fields()) == {"left.speed", "left", "right.speed", "right"}
    (run,) = read_recordings([tmp_path], LogMapping.from_table({"states": {"v": {"path": "right.speed"}}})).runs
    np.testing.assert_allclose(run.trajectory.states[:, 0], -run.trajectory.times, atol=1e-6)
    with refuses(InputError, "speed"):
        read_recordings([tmp_path], LogMapping.from_table({"states": {"speed": "speed"}}))


def test_recordings_with_a_field_in_common_are_not_joined(tmp_path: Path) -> None:
    (tmp_path / "run_1.csv").write_text("t,x,u\n0,1,2\n1,2,2\n")
    (tmp_path / "run_2.csv").write_text("t,x,u,temperature\n0,1,2,20\n1,2,2,20\n")
    assert len(read_logs([tmp_path])) == 2
    (tmp_path / "run_2.csv").write_text("t,y\n0,1\n1,2\n")
    assert len(read_logs([tmp_path])) == 1


@pytest.mark.parametrize("times", [FAST, np.sort(np.random.default_rng(0).random(500))], ids=["equal", "variable"])
def test_matrices_of_a_to_file_block_and_structures_with_time_are_read(times: np.ndarray, tmp_path: Path) -> None:
    from scipy.io import savemat

    matrix = np.vstack([times, RATES[:, :2].T])
    savemat(tmp_path / "a.mat", {"ans": matrix})
    kinds = [("values", "O"), ("label", "O"), ("dimensions", "O")]
    signals = np.array([(RATES[:, k : k + 1], f"rate{k}", np.array([[1.0]])) for k in range(2)], dtype=kinds)
    structure = {"time": times[:, None], "signals": signals, "blockName": "model/Scope"}
    savemat(tmp_path / "b.mat", {"ScopeData": structure})
    savemat(tmp_path / "c.mat", {"ScopeData": structure, "gain": 2.0})
    for name, fields in (
        ("a", ("time", "ans1", "ans2")),
        ("b", ("time", "rate0", "rate1")),
        ("c", ("ScopeData.time", "ScopeData.rate0", "ScopeData.rate1", "gain")),
    ):
        (log,) = read_logs([tmp_path / f"{name}.mat"])
        assert log.fields() == fields
        mapping = LogMapping.from_table(
            {"states": {"rate": fields[2]}, "time": fields[0], "dt": 0.004, "longest_gap": 1.0}
        )
        run = read_recordings([tmp_path / f"{name}.mat"], mapping).runs[0]
        column = int(fields[2][-1]) - (name == "a")
        expected = np.interp(run.start + run.trajectory.times, times, RATES[:, column])
        np.testing.assert_allclose(run.trajectory.states[:, 0], expected, atol=1e-3)


def test_times_of_several_files_are_measured_as_those_of_one(tmp_path: Path) -> None:
    for name, times, values in (("run_pos", FAST, np.sin(FAST)), ("run_vel", FAST, np.cos(FAST))):
        rows = [f"{1000 * time:.0f},{value}" for time, value in zip(times, values, strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join([f"t,{'angle' if 'pos' in name else 'speed'}", *rows]))
    mapping = LogMapping.from_table({"states": {"angle": "angle", "speed": "speed"}, "inputs": {}})
    with refuses(InputError, 0.004, 4):
        read_recordings([tmp_path], mapping)
    assert read_recordings([tmp_path], mapping, time_unit="ms").dt == 0.004


@pytest.mark.parametrize("first", ["12:00:00", "23:59:59"])
def test_dates_in_several_files_are_on_one_clock(first: str, tmp_path: Path) -> None:
    start = np.datetime64(f"2024-03-09T{first}.000")
    for name, times in (("run_fast", FAST), ("run_slow", 1.2 + SLOW[:8])):  # the second begins later
        rows = [f"{start + np.timedelta64(round(1000 * time), 'ms')},{time}" for time in times]
        (tmp_path / f"{name}.csv").write_text("\n".join([f"time,{name[4:]}", *rows]))
    mapping = LogMapping.from_table({"states": {"x": "fast"}, "inputs": {"u": "slow"}})
    run = read_recordings([tmp_path], mapping).runs[0].trajectory
    ahead = run.states[:-1, 0] - run.inputs[:, 0]  # the input is held
    assert run.horizon > 100
    assert (ahead > -1e-6).all()
    assert (ahead[:150] < 0.1).all()
