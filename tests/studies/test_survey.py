"""A first statement on logs that nobody has described."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ctxval import Trajectory
from ctxval.errors import InputError
from ctxval.studies.survey import Survey, survey
from facts import assert_names, refuses
from rig_logs import run, write_bag, write_lerobot, write_mat, write_mcap_ros2, write_parquet

RUNS = [run(60, seed) for seed in range(4)]


def csv_file(path: Path, one: Trajectory, names: str = "time;position;speed;force", decimal: str = ",") -> None:
    rows = np.column_stack([1000 * one.times[:-1], one.states[:-1], one.inputs])
    text = "\n".join(";".join(f"{value:.7f}".replace(".", decimal) for value in row) for row in rows)
    path.write_text(f"{names}\n{text}\n")


def json_file(path: Path, one: Trajectory) -> None:
    rows = [
        {"timestamp": t, "position": x[0], "goal_force": u[0], "temp": 20.0 + t}
        for t, x, u in zip(one.times, one.states, one.inputs, strict=False)
    ]
    path.write_bytes(gzip.compress(json.dumps({"kp": 10 * one.inputs[0, 0], "entries": rows}).encode()))


def each(folder: Path, write: Callable[[Path, Trajectory], object], ending: str) -> Path:
    folder.mkdir()
    for number, one in enumerate(RUNS):
        write(folder / f"run{number}{ending}", one)
    return folder


def roles(found: Survey) -> dict[str, str]:
    return {field.path: field.role for field in found.fields}


WRITERS: dict[str, Callable[[Path], Path]] = {
    "semicolons, decimal commas, milliseconds": lambda to: each(
        to / "csv", lambda path, one: csv_file(path, one, "time [ms];position [m];speed [m/s];force [N]"), ".csv"
    ),
    "mcap with header stamps and 4 ms of latency": lambda to: each(
        to / "mcap", lambda path, one: write_mcap_ros2(path, one, late=0.004), ".mcap"
    ),
    "bags": lambda to: each(to / "bags", lambda path, one: write_bag(path, one), ""),
    "matlab 7.3": lambda to: each(to / "mat", lambda path, one: write_mat(path, one, version="7.3"), ".mat"),
    "parquet": lambda to: each(to / "parquet", write_parquet, ".parquet"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_logs_of_every_kind_are_read_with_the_right_fields_and_steps(kind: str, tmp_path: Path) -> None:
    folder = WRITERS[kind](tmp_path)
    found = survey(sorted(folder.iterdir()) if kind == "bags" else [folder])
    assert len(found.recordings.states) == 2
    assert len(found.recordings.inputs) == 1
    assert found.recordings.dt == pytest.approx(0.05, rel=1e-6)
    assert found.best.kind == "linear"
    assert found.best.relative < 1e-3
    assert not found.replay.faults
    assert not any("delay" in sentence or "not recorded" in sentence for sentence in found.replay.insights)


def test_a_lerobot_data_set_has_the_names_of_its_components(tmp_path: Path) -> None:
    write_lerobot(tmp_path / "set", RUNS)
    found = survey([tmp_path / "set"])
    assert list(found.recordings.states) == ["position", "speed"]
    assert len(found.recordings.runs) == len(RUNS)
    assert found.best.relative < 1e-3


def test_a_rate_that_is_not_recorded_is_derived_and_every_guess_is_said(tmp_path: Path) -> None:
    found = survey([each(tmp_path / "json", json_file, ".json.gz")])
    assert roles(found) == {"kp": "", "position": "state", "goal_force": "input", "temp": ""}
    assert list(found.recordings.states) == ["position", "position rate"]
    said = " ".join(found.guesses)
    assert_names(said, "kp", "temp")
    assert any("looks 0.15 s ahead" in note for note in found.recordings.notes)


def test_a_rate_is_found_by_its_records_if_no_name_tells(tmp_path: Path) -> None:
    rng, rows, x, v, u = np.random.default_rng(2), list[str](), 0.0, 0.0, 0.0
    for k in range(400):
        u = rng.uniform(-3, 3) if k % 12 == 0 else u
        rows.append(f"{0.02 * k:.2f},{x:.9f},{v:.9f},{u}")
        x, v = x + 0.02 * v + 0.0016 * u, v + 0.02 * (8 * u - 2 * v)
    (tmp_path / "run.csv").write_text("\n".join(["time,ans1,ans2,ans3", *rows]))
    found = survey([tmp_path / "run.csv"])
    assert list(found.recordings.states) == ["ans1", "ans2"]
    assert_names(found.guesses, "ans2", "ans1")
    assert found.reach[1] == found.reach[2]


def test_an_angle_that_jumps_is_continued(tmp_path: Path) -> None:
    def wrapped(path: Path, one: Trajectory) -> None:
        angle = np.mod(6 * one.states[:, :1] + np.pi, 2 * np.pi) - np.pi
        csv_file(
            path,
            Trajectory(one.times, np.hstack([angle, 6 * one.states[:, 1:]]), one.inputs),
            "time_ms;angle;rate;torque",
            ".",
        )

    found = survey([each(tmp_path / "csv", wrapped, ".csv")])
    assert found.mapping.states["angle"].angle
    assert_names(found.guesses, 2, "pi")
    assert found.best.relative < 1e-3


@pytest.mark.parametrize("state", [("foo", "bar"), ("shoulder [deg]", "shoulder_rate"), ("Slide2", "slide2 speed")])
def test_unknown_names_are_states_and_what_stands_still_is_not(state: tuple[str, str], tmp_path: Path) -> None:
    def odd(path: Path, one: Trajectory) -> None:
        rows = np.column_stack([one.times[:-1], one.states[:-1], one.inputs, np.full(one.horizon, 7.4)])
        np.savetxt(path, rows, delimiter=",", header=f"time,{','.join(state)},u,supply", comments="")

    found = survey([each(tmp_path / "csv", odd, ".csv")])
    assert roles(found) == {**dict.fromkeys(state, "state"), "u": "input", "supply": ""}


def test_a_model_that_errs_is_said_to_suit_no_task(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def noise(path: Path, one: Trajectory) -> None:
        csv_file(path, Trajectory(one.times, rng.normal(size=one.states.shape), one.inputs), decimal=".")

    folder = each(tmp_path / "csv", noise, ".csv")
    found = survey([folder], dt=50.0)
    assert found.reach[0] == 0


def test_logs_without_a_state_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("time,force,temp\n0,1,2\n1,2,3\n2,1,4\n")
    with refuses(InputError, "run.csv", "--state"):
        survey([tmp_path / "run.csv"])
    rows = [f"{0.1 * k:.1f},{'12:03:04' if k == 3 else k},{k % 3}" for k in range(9)]
    (tmp_path / "cell.csv").write_text("\n".join(["time,angle,voltage", *rows]))
    with refuses(InputError, "angle", "12:03:04"):
        survey([tmp_path / "cell.csv"])
    (tmp_path / "untimed.csv").write_text("yEst,uEst\n1,2\n2,3\n")
    with refuses(InputError, "untimed.csv"):
        survey([tmp_path / "untimed.csv"])
    (tmp_path / "units.csv").write_text("time_ms,x,u\n1,2,3\n2,3,4\n")
    with refuses(InputError, "time_ms", "units.csv"):
        survey([tmp_path / "units.csv"], time="time_ms [s]")
    (tmp_path / "still.csv").write_text("time,x0,u0\n0,1,0\n1,1,1\n2,1,0\n3,1,1\n")
    with refuses(InputError, "x0"):
        survey([tmp_path / "still.csv"])
    with refuses(InputError, "none.csv"):
        survey([tmp_path / "none.csv"])


def noisy_oven(path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, rows = 20.0, list[str]()
    for k, h in enumerate(np.repeat(rng.uniform(0, 100, 8), 50)):
        rows.append(f"{k},{x + 0.05 * rng.normal():.4f},{h:.3f}")
        x += -0.01 * (x - 20) + 0.005 * h
    path.write_text("time,temperature,heater_cmd\n" + "\n".join(rows) + "\n")


def test_a_slow_plant_is_judged_over_more_steps_than_those_in_which_noise_hides_the_motion(tmp_path: Path) -> None:
    for seed in range(3):
        noisy_oven(tmp_path / f"{seed}.csv", seed)
    found = survey([tmp_path])
    first, close, compared = found.reach
    assert (list(found.recordings.states), list(found.recordings.inputs)) == (["temperature"], ["heater_cmd"])
    assert 1 < first < 30
    assert close == compared == 399
    assert_names(found.statement, first)
    assert found.best.useless is None


def test_times_that_the_rate_contradicts_are_refused_and_a_motion_that_returns_is_judged_by_its_size(
    tmp_path: Path,
) -> None:
    t = 0.02 * np.arange(600)
    x, v = np.sin(2 * np.pi * t), 2 * np.pi * np.cos(2 * np.pi * t)  # every 50 steps, it is where it was
    u = np.repeat(np.random.default_rng(0).uniform(-1, 1, 60), 10)
    for name, times in (("ms", 1e3 * t), ("s", t)):
        rows = np.column_stack([times, x, v, u])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header="t,angle,speed,voltage", comments="")
    with refuses(InputError, 0.02, 20):
        survey([tmp_path / "ms.csv"])
    for found in (survey([tmp_path / "s.csv"]), survey([tmp_path / "ms.csv"], time="t [ms]")):
        assert found.reach == (1, 119, 119)
        assert found.recordings.dt == pytest.approx(0.02)
