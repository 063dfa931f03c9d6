"""Recordings in other units than those of the model: converted, or refused with the factor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Experiment, Transitions, distances, models
from ctxval.cli.recordings import named_model
from ctxval.core.labels import units_of
from ctxval.data import LogMapping, MemoryTable, Recordings, recordings_of
from ctxval.errors import InputError
from ctxval.models import read_model
from ctxval.studies.fitting import fit, fit_parameters
from ctxval.studies.fitting.model_file import write_model_file
from ctxval.studies.replay import replay
from facts import assert_names, refuses
from rig_logs import run

RUNS = [run(120, seed) for seed in range(4)]
TURN = 180 / np.pi


def read(scale: float = 1.0, heads: tuple[str, str, str] = ("angle", "rate", "torque"), **options: Any) -> Recordings:
    logs = []
    for k, one in enumerate(RUNS):
        columns = {heads[0]: scale * one.states[:, 0], heads[1]: scale * one.states[:, 1], heads[2]: one.inputs}
        logs.append(MemoryTable(f"run {k}", {"t": one.times, **columns}))
    return recordings_of(
        logs,
        LogMapping.from_table(
            {"states": {"angle": "angle", "rate": "rate"}, "inputs": {"torque": "torque"}, **options}
        ),
    )


PLAIN, RAD, DEG = (
    read(),
    read(heads=("angle [rad]", "rate [rad/s]", "torque [N m]")),
    read(TURN, ("angle [deg]", "rate [deg/s]", "torque [N m]")),
)


def learned(recordings: Recordings) -> models.Linear:
    model = fit(recordings, ["linear"]).fitted[0].model
    assert isinstance(model, models.Linear)
    return model


def write(path: Path, recordings: Recordings) -> Any:
    model = learned(recordings)
    if path.suffix == ".toml":
        data, _ = recordings.transitions()
        bounds = {"friction": (0.1, 0.5)}
        model, _ = fit_parameters(step, bounds, data)  # type: ignore[assignment]
        write_model_file(path, model, f"{__name__}:step")
    else:
        write_model_file(path, model)
    return named_model(str(path), {})


def step(x: Any, u: Any, theta: Any) -> Any:
    return np.array([x[0] + 0.05 * x[1], x[1] + 0.05 * (u[0] - theta[0] * x[1])])


@pytest.mark.parametrize("suffix", [".npz", ".onnx", ".toml"])
def test_a_model_file_states_units_and_logs_are_converted_to_them(suffix: str, tmp_path: Path) -> None:
    model = write(tmp_path / f"model{suffix}", RAD)
    assert units_of(model) == ({"angle": "rad", "rate": "rad/s"}, {"torque": "N m"})
    report = replay(model, DEG, steps=[1, 10])
    assert max(error.relative for error in report.errors) < 1e-3
    assert report.data.states == {"angle": "rad", "rate": "rad/s"}
    assert_names(report.data.notes, "angle", "model")
    given = fit(DEG, ["linear"], given=model)
    assert max(model.relative for model in given.fitted) < 1e-3


def test_states_in_another_order_are_taken_by_their_names() -> None:
    turned = read(heads=("angle [rad]", "rate [rad/s]", "torque [N m]"), states={"rate": "rate", "angle": "angle"})
    assert list(turned.states) == ["rate", "angle"]
    assert max(error.relative for error in replay(learned(RAD), turned, steps=[1]).errors) < 1e-3


@pytest.mark.parametrize("of_model", [PLAIN, RAD])
@pytest.mark.parametrize("scale", [TURN, 1000.0, 1 / TURN])
def test_units_that_are_not_stated_are_measured_by_the_errors_of_the_model(of_model: Recordings, scale: float) -> None:
    with refuses(InputError, f"{scale:.4g}"):
        replay(learned(of_model), read(scale), steps=[1])
    assert max(error.relative for error in replay(learned(of_model), PLAIN, steps=[1]).errors) < 1e-3


def test_units_of_other_quantities_are_refused() -> None:
    with refuses(InputError, "N"):
        replay(learned(RAD), read(heads=("angle [rad]", "rate [rad/s]", "torque [A]")))
    one, other = RAD.transitions()[0], DEG.transitions()[0]
    with refuses(InputError, "angle", "rad", "deg"):
        Transitions.joined([one, other])
    assert Transitions.joined([one, PLAIN.transitions()[0]][:1]).states == RAD.states


def test_a_model_without_units_is_taken_as_it_is(tmp_path: Path) -> None:
    model = write(tmp_path / "model.npz", PLAIN)
    assert units_of(model) == ({"angle": "", "rate": ""}, {"torque": ""})
    assert replay(model, RAD, steps=[1]).data.states == RAD.states
    bare = models.Linear(model.A, model.B)
    assert units_of(bare) == ({}, {})
    assert replay(bare, RAD, steps=[1]).data.states == RAD.states


def test_an_experiment_with_other_units_than_its_model_is_refused(tmp_path: Path) -> None:
    model = write(tmp_path / "model.npz", RAD)
    validation = make_validation().with_parts(model=model)
    with refuses(InputError, "model"):
        Experiment("rig", validation, states=("angle [deg]", "rate [deg/s]"), inputs=("torque [N m]",))
    scaled = validation.with_parts(distance=distances.MaximumDeviation(scales=[1.0, 1.0]))
    assert Experiment("rig", scaled, states=("angle [rad]", "rate [rad/s]")).states


def test_a_file_whose_names_are_no_names_is_refused(tmp_path: Path) -> None:
    for number, names in enumerate(("[", "[1]", '{"states": {"x": 1}, "inputs": {}}', '{"states": []}')):
        path = tmp_path / f"{number}.npz"
        write_model_file(path, learned(PLAIN))
        with np.load(path) as file:
            arrays = dict(file)
        np.savez(path, **{**arrays, "names": np.array(names)})
        with refuses(InputError, path.name):
            read_model(path)
