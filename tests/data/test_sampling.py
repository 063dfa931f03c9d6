"""Recordings at equal steps: interpolated, held, delayed, and split at gaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.data import Field, LogMapping, MemoryTable, Recordings, read_recordings, recordings_of
from ctxval.errors import InputError
from facts import assert_names, refuses
from rig_logs import run, write_mcap_json


def recorded(columns: dict[str, object], **options: object) -> Recordings:
    log = MemoryTable("log", {name: np.asarray(column, dtype=np.float64) for name, column in columns.items()})
    return recordings_of([log], LogMapping.from_table({"states": {"x": "x"}, "inputs": {"u": "u"}, **options}))


def test_states_are_interpolated_and_inputs_are_averaged_over_each_step() -> None:
    times = np.arange(0, 1.01, 0.1)
    found = recorded({"t": times, "x": times**2, "u": times}, dt=0.04)
    one = found.runs[0].trajectory
    assert (one.horizon, found.dt) == (25, 0.04)
    np.testing.assert_allclose(one.states[:, 0], np.interp(one.times, times, times**2), atol=1e-12)
    fine = one.times[:-1, None] + 0.04 * (np.arange(1000) + 0.5) / 1000
    np.testing.assert_allclose(one.inputs[:, 0], (np.floor(fine / 0.1) / 10).mean(axis=1), atol=1e-4)
    assert_names(found.notes, 0.04)


@given(
    st.lists(st.floats(0.05, 0.15), min_size=4, max_size=40), st.floats(0.02, 0.2), st.floats(-3, 3), st.floats(-3, 3)
)
def test_a_linear_state_is_resampled_exactly(steps: list[float], dt: float, slope: float, start: float) -> None:
    times = np.cumsum([0.0, *steps])
    found = recorded({"t": times + 7, "x": start + slope * times, "u": times}, dt=dt, longest_gap=1.0)
    (one,) = found.runs
    assert one.start == 7
    assert one.trajectory.times[-1] <= times[-1] + 0.01 * dt
    assert one.trajectory.times[-1] > times[-1] - dt * 1.01
    within = one.trajectory.times <= times[-1]
    # A sample within a thousandth of a period of a step is taken as it is.
    np.testing.assert_allclose(
        one.trajectory.states[within, 0], start + slope * one.trajectory.times[within], atol=3e-4 + 1e-9
    )


def test_the_input_acts_after_its_delay() -> None:
    times = np.arange(0, 1.05, 0.1)
    for delay in (0.2, -0.1):
        found = recorded({"t": times, "x": 10 * times, "u": 10 * times}, delay=delay)
        one = found.runs[0].trajectory
        np.testing.assert_allclose(one.inputs[:, 0], one.states[:-1, 0] - 10 * delay, atol=1e-9)
        assert_names(found.notes, f"{delay:g}")


@pytest.mark.parametrize("missing", [[5], [5, 6], [5, 9], [0, 1], [10]])
def test_a_missing_value_splits_the_recording_and_is_stated(missing: list[int]) -> None:
    times = np.arange(11) / 10
    x = times.copy()
    x[missing] = np.nan
    found = recorded({"t": times, "x": x, "u": times})
    steps = sum(bool(np.isfinite(x[k]) and np.isfinite(x[k + 1])) for k in range(10))
    assert found.steps == steps
    assert all(np.isfinite(one.trajectory.states).all() for one in found.runs)
    inside = [k for k in missing if np.isfinite(x[:k]).any() and np.isfinite(x[k:]).any()]
    assert bool(inside) == any("row" in one.reason for one in found.breaks)


def test_a_gap_between_samples_splits_the_recording_and_is_stated() -> None:
    times = np.concatenate([np.arange(5), np.arange(8, 12)]) / 10
    found = recorded({"t": times, "x": times, "u": times})
    assert [one.trajectory.horizon for one in found.runs] == [4, 3]
    gap = found.breaks[0]
    assert (gap.field, gap.time) == ("x", 0.4)
    assert gap.seconds == pytest.approx(0.4)
    assert_names(str(gap), 0.4, "x")
    bridged = recorded({"t": times, "x": times, "u": times}, longest_gap=0.5)
    assert ([one.trajectory.horizon for one in bridged.runs], bridged.breaks) == ([11], ())


def test_lost_messages_split_a_recording(tmp_path: Path) -> None:
    write_mcap_json(tmp_path / "a.mcap", run(), lost=(20, 21, 40))
    mapping = LogMapping.from_table(
        {"states": {"/state.cart.position": "/state.cart.position"}, "inputs": {"/command.force": "/command.force"}}
    )
    found = read_recordings([tmp_path / "a.mcap"], mapping)
    assert [one.trajectory.horizon for one in found.runs] == [19, 17, 19]
    assert_names([one.reason for one in found.breaks], 0.15, 0.1)


def test_times_that_go_back_begin_another_recording() -> None:
    times = [0.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.3]
    found = recorded({"t": times, "x": np.arange(7), "u": np.arange(7)})
    assert [one.trajectory.states[:, 0].tolist() for one in found.runs] == [[0, 1, 2], [3, 4, 5, 6]]
    assert_names(found.breaks[0].reason, 0.2, 0, 3)


def test_times_that_do_not_tell_rows_apart_are_refused() -> None:
    single = (1.7e9 + np.arange(0, 3, 0.05)).astype(np.float32)
    for dt, times in ((0.05, single), (0.1, np.round(np.arange(0, 3, 0.05), 1))):
        values = np.arange(60.0)
        with refuses(InputError, 60, 1):
            recorded({"t": times, "x": values, "u": values}, dt=dt)
    twice = np.insert(np.arange(0, 3, 0.05), 3, 0.1)
    repeated = recorded({"t": twice, "x": np.arange(61.0), "u": np.arange(61.0)})
    assert len(repeated.runs) == 2
    assert_names(repeated.breaks[0].reason, 0.1, 3)


def test_a_held_command_is_no_gap() -> None:
    table = {"states": {"x": "x"}, "inputs": {"u": {"path": "u", "held": True}}}
    u = [5, np.nan, np.nan, np.nan, 6, np.nan]
    log = MemoryTable("log", {"t": np.arange(6.0), "x": np.arange(6.0), "u": np.array(u)})
    found = recordings_of([log], LogMapping.from_table(table))
    assert found.runs[0].trajectory.inputs[:, 0].tolist() == [5, 5, 5, 5, 6]
    assert found.breaks == ()


def test_an_angle_is_continued_over_turns() -> None:
    times = np.arange(0, 2, 0.1)
    angle = 3.0 * times
    wrapped = np.arctan2(np.sin(angle), np.cos(angle))
    table = {"states": {"angle": {"path": "a", "angle": True}}, "dt": 0.05}
    log = MemoryTable("log", {"t": times, "a": wrapped})
    one = recordings_of([log], LogMapping.from_table(table)).runs[0].trajectory
    np.testing.assert_allclose(one.states[:, 0], 3.0 * one.times, atol=1e-9)


def test_units_are_converted() -> None:
    log = MemoryTable("log", {"t": np.array([0.0, 500.0]), "a": np.array([180.0, 90.0]), "n": np.array([60.0, 0.0])})
    table = {
        "states": {"angle": {"path": "a", "unit": "rad", "recorded": "deg", "offset": 1.0}},
        "inputs": {"rate": {"path": "n", "unit": "rad/s", "recorded": "rpm"}},
        "time_unit": "ms",
    }
    found = recordings_of([log], LogMapping.from_table(table))
    one = found.runs[0].trajectory
    np.testing.assert_allclose(one.states[:, 0], [np.pi + 1, np.pi / 2 + 1])
    np.testing.assert_allclose(one.inputs[:, 0], [2 * np.pi])
    assert (found.dt, found.states, found.inputs) == (0.5, {"angle": "rad"}, {"rate": "rad/s"})


def test_topics_with_times_that_go_back_are_refused() -> None:
    from ctxval.data.sampling import Channel, sampled

    first = Channel("x", "", False, np.arange(3.0), np.arange(3.0))
    second = Channel("u", "", True, np.array([0.0, 2.0, 1.0]), np.arange(3.0), path="/u", place=("message", 0))
    with refuses(InputError, 2, "time", 1):
        sampled("log", [first, second], 1.0, 0.0, None)


def test_too_many_steps_are_refused() -> None:
    with refuses(InputError, 20000000, "dt"):
        recorded({"t": [0.0, 1.0], "x": [0.0, 1.0], "u": [0.0, 0.0]}, dt=1e-9, longest_gap=1.0)


# What ordinary files have


def test_inputs_that_change_between_samples_are_averaged() -> None:
    from ctxval import models
    from ctxval.studies.replay import replay

    rng, dt, logs = np.random.default_rng(0), 0.05, []
    for number in range(4):
        times = dt * (np.arange(200) + 0.2 * rng.uniform(-1, 1, 200))
        u, rate = rng.normal(size=200), np.zeros(200)
        for k, step in enumerate(np.diff(times)):
            decay = np.exp(-0.5 * step)
            rate[k + 1] = decay * rate[k] + (1 - decay) / 0.5 * u[k]
        logs.append(MemoryTable(f"run {number}", {"t": times, "x": rate, "u": u}))
    exact = models.Linear([[np.exp(-0.5 * dt)]], [[(1 - np.exp(-0.5 * dt)) / 0.5]])
    found = recordings_of(logs, LogMapping.from_table({"states": {"x": "x"}, "inputs": {"u": "u"}, "dt": dt}))
    report = replay(exact, found, steps=[1])
    assert report.errors[0].relative < 0.06  # 0.76 with the inputs at the start of each step


@pytest.mark.parametrize("kind", ["csv", "parquet", "npz"])
@pytest.mark.parametrize("column", ["episode", "Run", "trial_id"])
def test_episodes_in_a_column_are_recordings_of_their_own(column: str, kind: str, tmp_path: Path) -> None:
    columns = {
        "t": np.arange(6) / 10,
        "x0": np.array([0.0, 1, 2, 50, 51, 52]),
        "u0": np.zeros(6),
        column: np.array([3, 3, 3, 4, 4, 4]),
    }
    path = tmp_path / f"a.{kind}"
    if kind == "parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table(columns), path)
    elif kind == "npz":
        np.savez(path, **columns)
    else:
        rows = zip(*columns.values(), strict=True)
        path.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]))
    found = read_recordings([path])
    assert [one.trajectory.states[:, 0].tolist() for one in found.runs] == [[0, 1, 2], [50, 51, 52]]
    assert [one.source.partition(", ")[2] for one in found.runs] == [
        f"{column.partition('_')[0]} {number}" for number in (3, 4)
    ]


def test_one_file_in_another_unit_is_converted_or_refused(tmp_path: Path) -> None:
    def written(*headers: str) -> list[Path]:
        paths = []
        for number, header in enumerate(headers):
            factor = 180 / np.pi if "deg" in header else 1.0
            rows = [f"{0.1 * k},{factor * 0.01 * (k + number)},0" for k in range(5)]
            paths.append(tmp_path / f"{number}.csv")
            paths[-1].write_text("\n".join([f"t,{header},u", *rows]))
        return paths

    mapping = LogMapping.from_table({"states": {"angle": "angle"}, "inputs": {"u": "u"}})
    found = read_recordings(written("angle [rad]", "angle [rad]", "angle [deg]", "angle_rad"), mapping)
    assert found.states == {"angle": "rad"}
    for number, one in enumerate(found.runs):
        np.testing.assert_allclose(one.trajectory.states[:, 0], 0.01 * (np.arange(5) + number))
    with refuses(InputError, "1.csv", "angle"):
        read_recordings(written("angle", "angle [deg]"), mapping)
    for header, fact in (("angle [m]", "rad"), ("angle [gon]", "rad")):
        with refuses(InputError, fact):
            read_recordings(written("angle [rad]", header), mapping)
    in_degrees = read_recordings(written("angle [deg]"), mapping, states={"angle": "rad"})
    np.testing.assert_allclose(in_degrees.runs[0].trajectory.states[:, 0], 0.01 * np.arange(5))


def test_times_in_another_unit_than_seconds_are_never_interpolated() -> None:
    times = 20.0 * np.arange(1500)
    with refuses(InputError, 20, 0.02):
        recorded({"t": times, "x": times, "u": times}, dt=0.02)
    with refuses(InputError, 0.1, 0.02, "dt"):
        recorded({"t": times / 200, "x": times, "u": times}, dt=0.02)
    for name, unit, factor in (("t [ms]", "", 1), ("time_us", "", 1e3), ("timestamp", "", 1e6), ("t", "ms", 1)):
        start = 1.7e18 if name == "timestamp" else 0.0
        found = recorded({name: start + factor * times, "x": times, "u": times}, dt=0.02, time_unit=unit)
        assert [one.trajectory.horizon for one in found.runs] == [1499]
        np.testing.assert_allclose(found.runs[0].trajectory.states[:, 0], times)
    with refuses(InputError, "time_unit", "s"):
        recorded({"t [ms]": times, "x": times, "u": times}, time_unit="s")


def test_a_time_step_that_is_no_short_number_does_not_drift() -> None:
    times = np.arange(60_000) / 30
    found = recorded({"t": times, "x": np.sin(times), "u": times})
    assert found.dt == pytest.approx(1 / 30, rel=1e-12)
    np.testing.assert_array_equal(found.runs[0].trajectory.states[:, 0], np.sin(times))


def test_marks_of_missing_values_split_a_recording_and_are_stated() -> None:
    times = np.arange(20) / 10
    x = np.sin(times)
    x[[7, 8]] = -999
    found = recorded({"t": times, "x": x, "u": times})
    assert [one.trajectory.horizon for one in found.runs] == [6, 10]
    assert_names(found.notes, "x", -999, 2)


def test_a_mark_may_have_been_converted_with_its_column() -> None:
    times = np.arange(20) / 10
    x = 3.6 * np.where(np.arange(20) == 7, -999, np.sin(times))
    log = MemoryTable("log", {"t": times, "x [km/h]": x, "u": times})
    found = recordings_of([log], LogMapping({"x": Field("x", "m/s")}, {"u": Field("u")}))
    assert [one.trajectory.horizon for one in found.runs] == [6, 11]
    assert_names(found.notes, "log", "x", -3596.4, 1)


def test_values_whose_squares_are_not_finite_are_refused() -> None:
    times = np.arange(20) / 10
    with refuses(InputError, "x", 100, 300):
        recorded({"t": times, "x": np.full(20, -1e300), "u": times})
    mark = np.where(np.arange(20) == 7, 1e300, times)
    assert len(recorded({"t": times, "x": mark, "u": times}).runs) == 2


def test_only_valid_rows_count() -> None:
    times = np.arange(10) / 10
    status = np.array([0, 0, 0, 0, 1, 0, 0, 0, 0, 0])
    for valid in ("status == 0", "status != 1", "status==0.0"):
        found = recorded({"t": times, "x": times, "u": times, "status": status}, valid=valid)
        assert [one.trajectory.horizon for one in found.runs] == [3, 4]
    with refuses(InputError, "valid", "status", 0):
        recorded({"t": times, "x": times, "u": times}, valid="status")
    with refuses(InputError, "state", "x"):
        recorded({"t": times, "x": times, "u": times}, valid="state == 0")


@pytest.mark.parametrize(("state", "command"), [(0.004, 0.1), (0.02, 0.24), (0.01, 0.003)])
def test_rows_of_a_joined_table_without_a_state_do_not_count_in_its_period(state: float, command: float) -> None:
    t, late = state * np.arange(300), 0.0006 + command * np.arange(int(300 * state / command))
    times = np.sort(np.concatenate([t, late]))
    x = np.where(np.isin(times, t), np.sin(times), np.nan)
    u = np.where(np.isin(times, late), times, np.nan)
    found = recorded({"t": times, "x": x, "u": u})
    assert found.dt == state
    assert not found.breaks
    assert found.steps > 0.9 * 300 - command / state
    one = found.runs[0]
    np.testing.assert_allclose(one.trajectory.states[:, 0], np.sin(one.start + one.trajectory.times), atol=1e-4)


RHYTHMS = {
    "jitter": lambda t, rng: t + rng.uniform(-0.008, 0.008, len(t)),
    "skewed jitter": lambda t, rng: np.sort(t + rng.exponential(0.002, len(t))),
    "pairs": lambda t, rng: np.sort(np.where(np.arange(len(t)) % 2, t - 0.019, t)),
    "lost": lambda t, rng: t[np.sort(rng.permutation(len(t))[: int(0.9 * len(t))])],
    "jitter and lost": lambda t, rng: (t + rng.uniform(-0.004, 0.004, len(t)))[rng.random(len(t)) > 0.1],
}


@pytest.mark.parametrize("kind", RHYTHMS)
def test_the_period_is_that_of_the_sensor_whatever_the_logger_does(kind: str) -> None:
    t = RHYTHMS[kind](0.02 * np.arange(500), np.random.default_rng(0))
    assert recorded({"t": t, "x": t, "u": t}).dt == pytest.approx(0.02, rel=0.01)
