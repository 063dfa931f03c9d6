"""Times, units and signs that the records themselves contradict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval._util.arrays import Array
from ctxval.core.trajectory import Trajectory
from ctxval.data import LogMapping, MemoryTable, Recordings, read_recordings, recordings_of
from ctxval.data.rates import Column, rate_pairs
from ctxval.errors import InputError
from facts import is_named, refuses

DT, N = 0.02, 500


def motor(seed: int = 0) -> dict[str, Array]:
    """Return times, an angle, its rate and a voltage that is piecewise constant."""
    u = np.repeat(np.random.default_rng(seed).uniform(-3, 3, N // 10), 10)
    x = np.zeros((N, 2))
    for k in range(N - 1):
        x[k + 1] = x[k] + DT * np.array([x[k, 1], 8 * u[k] - 2 * x[k, 1] - 4 * x[k, 0]])
    return {"t": DT * np.arange(N), "angle": x[:, 0], "rate": x[:, 1], "voltage": u}


MOTOR = motor()
RNG = np.random.default_rng(1)


def read(columns: dict[str, Array], states: Any = ("angle", "rate"), **options: Any) -> Recordings:
    mapping = {
        "states": {name: name for name in states} if isinstance(states, tuple) else states,
        "inputs": {"voltage": "voltage"},
        **options,
    }
    return recordings_of([MemoryTable("log", columns)], LogMapping.from_table(mapping))


def worn(columns: dict[str, Array], kind: str) -> dict[str, Array]:
    """Return the log as sensors and loggers leave it."""
    angle, rate = columns["angle"].copy(), columns["rate"].copy()
    match kind:
        case "noise":
            angle, rate = angle + 0.03 * RNG.normal(size=N), rate + 0.5 * RNG.normal(size=N)
        case "quantised":
            angle, rate = 0.1 * np.round(angle / 0.1), 0.8 * np.round(rate / 0.8)
        case "held":
            for k in np.flatnonzero(RNG.random(N) < 0.2)[1:]:
                angle[k], rate[k] = angle[k - 1], rate[k - 1]
        case "zeros":
            angle[RNG.random(N) < 0.02] = 0.0
        case "lost":
            kept = np.sort(RNG.permutation(N)[: N - N // 10])
            return {name: column[kept] for name, column in columns.items()}
        case "biased":
            rate = rate + 2.0
        case "wrapped":
            angle, rate = np.mod(6 * angle + np.pi, 2 * np.pi) - np.pi, 6 * rate
    return {**columns, "angle": angle, "rate": rate}


@pytest.mark.parametrize("kind", ["clean", "noise", "quantised", "held", "zeros", "lost", "biased", "wrapped"])
@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns"), (1 / 60, "min"), (1 / 3600, "h")])
def test_times_in_another_unit_are_refused_with_the_unit_and_the_step(kind: str, factor: float, unit: str) -> None:
    log = worn(MOTOR, kind)
    with refuses(InputError, "t", 0.02, unit):
        read({**log, "t": factor * log["t"]})
    assert read(log).dt == pytest.approx(DT, rel=0.01)
    if factor > 1:
        assert read({**log, "t": factor * log["t"]}, time_unit=unit).dt == pytest.approx(DT, rel=0.01)


def test_a_header_that_states_another_unit_than_the_rate_shows_is_refused() -> None:
    columns = {name: column for name, column in MOTOR.items() if name != "t"}
    with refuses(InputError, "time_ms", "time"):
        read({"time_ms": MOTOR["t"], **columns})
    assert read({"time_ms": 1e3 * MOTOR["t"], **columns}).dt == pytest.approx(DT)
    with refuses(InputError, "time", "04"):
        read({"time": MOTOR["t"] / 86400, **columns})


@pytest.mark.parametrize(
    "names", [("theta", "omega"), ("x", "xdot"), ("q", "qd"), ("z", "vz"), ("foo", "bar"), ("x0", "x1")]
)
def test_a_rate_is_found_by_the_records_whatever_its_name_is(names: tuple[str, str]) -> None:
    log = dict(zip(("t", *names, "voltage"), MOTOR.values(), strict=True))
    with refuses(InputError, "t", names[1], names[0]):
        read({**log, "t": 1e3 * log["t"]}, names)
    assert read(log, names).dt == DT


@pytest.mark.parametrize(
    ("angle", "rate", "facts"),
    [
        (57.29578, 1.0, ("angle", "rate")),
        (1.0, 57.29578, ("angle", "rate")),
        (4096 / 6.283185, 1.0, (4096, "angle", "rate")),
        (1.0, 1024.0, (1024, "rate", "angle")),
        (1000.0, 1.0, ("angle", "rate")),
        (1.0, -1.0, (-1, "factor")),
        (-57.29578, 1.0, ("angle", "rate")),
    ],
)
def test_units_and_signs_that_differ_are_refused_with_the_number_unless_they_are_stated(
    angle: float, rate: float, facts: tuple[object, ...]
) -> None:
    log = {**MOTOR, "angle": angle * MOTOR["angle"], "rate": rate * MOTOR["rate"]}
    with refuses(InputError, *facts):
        read(log)
    stated = read(log, {"angle": {"path": "angle", "factor": 1.0}, "rate": "rate"})
    assert any(is_named(note, "rate") for note in stated.notes)


def test_stated_units_are_measured_too() -> None:
    turned = {"t": MOTOR["t"], "angle [deg]": 57.29578 * MOTOR["angle"], "voltage": MOTOR["voltage"]}
    assert read({**turned, "rate [rad/s]": MOTOR["rate"]}).states == {"angle": "deg", "rate": "rad/s"}
    with refuses(InputError, "rate", "angle", "deg"):
        read({**turned, "rate [deg/s]": MOTOR["rate"]})


def test_a_small_factor_is_said_and_a_common_one_is_not() -> None:
    geared = read({**MOTOR, "rate": 5 * MOTOR["rate"]})
    assert any("rate is 4.9" in note or "rate is 5" in note for note in geared.notes)
    assert not any("times" in note for note in read(MOTOR).notes)
    both = read({**MOTOR, "angle": 57.3 * MOTOR["angle"], "rate": 57.3 * MOTOR["rate"]})
    assert not any("times" in note for note in both.notes)


@pytest.mark.parametrize(
    ("states", "step", "refused"),
    [
        (("angle", "current"), 20.0, True),
        (("angle", "current"), 20000.0, True),
        (("angle", "current"), 2e-5, True),
        (("angle", "current"), 0.02, False),
        (("temperature", "level"), 20.0, False),
        (("temperature", "level"), 0.001, True),
        (("foo", "bar"), 20.0, False),
        (("foo", "bar"), 20000.0, True),
    ],
)
def test_without_a_rate_the_step_must_be_usual_for_such_fields_or_stated(
    states: tuple[str, str], step: float, refused: bool
) -> None:
    x = np.cumsum(np.random.default_rng(3).normal(size=(100, 2)), axis=0)
    log = {"t": step * np.arange(100), **dict(zip(states, x.T, strict=True)), "voltage": np.zeros(100)}
    if refused:
        with refuses(InputError, "dt", "--time"):
            read(log, states)
    assert read(log, states, dt=step).dt == step
    assert read({f"t{' [s]' * (not refused)}": log.pop("t"), **log}, states, dt=step).dt == step


def test_joints_that_move_alike_and_coordinates_are_no_pairs() -> None:
    t = DT * np.arange(N)
    circle = {"t": t, "x": np.cos(t), "y": np.sin(t), "voltage": t}
    assert read(circle, ("x", "y")).dt == DT
    joints = {"t": t, "q0": np.sin(t), "q1": -np.sin(t), "dq0": np.cos(t), "dq1": -np.cos(t), "voltage": t}
    assert not any("times" in note for note in read(joints, ("q0", "q1", "dq0", "dq1")).notes)
    flow = np.repeat(np.random.default_rng(0).uniform(0, 3, N // 10), 10) + 0.1 * MOTOR["rate"]
    tank = {"t": 10 * np.arange(N), "level": 1e-3 * np.cumsum(10 * flow), "flow_rate": flow, "voltage": t}
    assert read(tank, ("level", "flow_rate")).dt == 10
    rng = np.random.default_rng(0)
    apart = {"t": t, "angle": np.cumsum(rng.normal(size=N)), "rate": rng.normal(size=N), "voltage": t}
    assert not any("times" in note for note in read(apart).notes)


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_the_ratio_follows_every_change_of_a_scale(angle: float, rate: float, time: float) -> None:
    x = np.stack([angle * MOTOR["angle"], rate * MOTOR["rate"]], axis=-1)
    run = Trajectory(time * MOTOR["t"], x, MOTOR["voltage"][:-1, None])
    (pair,) = rate_pairs([run], [Column("angle"), Column("rate"), Column("voltage", of_input=True)], time * DT)
    assert pair.ratio == pytest.approx(angle / rate / time, rel=0.01)
    assert pair.correlation > 0.99


def test_dates_state_their_times_and_numbers_of_the_same_times_do_not(tmp_path: Path) -> None:
    moments = np.datetime64("2024-03-09T23:50:00") + 10 * np.arange(100)
    x = np.cumsum(np.random.default_rng(3).normal(size=100))
    for name, times in (("dates", moments), ("numbers", 10 * np.arange(100))):
        rows = [f"{time},{angle},{k // 10}" for k, (time, angle) in enumerate(zip(times, x, strict=True))]
        (tmp_path / f"{name}.csv").write_text("\n".join(["time,angle,voltage", *rows]))
    mapping = LogMapping.from_table({"states": {"angle": "angle"}, "inputs": {"u": "voltage"}})
    assert read_recordings([tmp_path / "dates.csv"], mapping).dt == 10
    with refuses(InputError, 10, "numbers.csv"):
        read_recordings([tmp_path / "numbers.csv"], mapping)
