"""Models that are learned from recordings of a system whose truth is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Trajectory, Transitions, models
from ctxval.data import LogMapping, MemoryTable, Recordings, recordings_of
from ctxval.errors import InputError, ModelError, UnknownNameError
from ctxval.studies.fitting import fit, fit_parameters
from ctxval.studies.fitting.fit import identifiability, split
from ctxval.studies.fitting.model_file import write_onnx
from facts import assert_names, refuses
from rig_logs import DT, run


def recorded(runs: list[Trajectory]) -> Recordings:
    logs = [MemoryTable(f"run {k}", {"t": one.times, "x": one.states, "u": one.inputs}) for k, one in enumerate(runs)]
    return recordings_of(logs, LogMapping.from_table({"states": {"x": "x"}, "inputs": {"u": "u"}}))


RUNS = [run(100, seed) for seed in range(8)]
RECORDED = recorded(RUNS)
BOUNDS = {"mass": (0.3, 3.0), "friction": (0.0, 2.0)}


def cart(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
    mass, friction = theta
    return np.stack([x[..., 0] + DT * x[..., 1], x[..., 1] + DT * (u[..., 0] - friction * x[..., 1]) / mass], axis=-1)


def noisy(mass: float, friction: float, noise: float, seed: int, steps: int = 200) -> Transitions:
    """Return independent steps of a cart with process noise."""
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(steps, 2)), rng.normal(size=(steps, 1))
    return Transitions(x, u, cart(x, u, np.array([mass, friction])) + noise * rng.normal(size=x.shape))


def test_the_linear_model_of_a_linear_system_is_the_best_and_exact() -> None:
    report = fit(RECORDED, ["linear", "gaussian-process"])
    assert [one.kind for one in report.fitted] == ["linear", "gaussian-process"]
    best = report.fitted[0].model
    assert isinstance(best, models.Linear)
    np.testing.assert_allclose(best.A, [[1, DT], [0, 1 - 0.3 * DT]], atol=1e-10)
    assert report.fitted[0].relative < 1e-10
    assert report.fitted[1].relative < 0.01
    assert (len(report.learned_from.runs), len(report.held_out.runs)) == (6, 2)
    json.dumps(report.to_json(), allow_nan=False)


@pytest.mark.slow
def test_a_nonlinear_system_is_learned_better_by_a_network_or_a_process() -> None:
    def bent(one: Trajectory) -> Trajectory:
        states = [one.states[0]]
        for u in one.inputs:
            x = states[-1]
            states.append(np.array([x[0] + DT * x[1], x[1] + DT * (u[0] - 2 * np.tanh(3 * x[1]))]))
        return Trajectory(one.times, np.array(states), one.inputs)

    report = fit(recorded([bent(one) for one in RUNS]))
    assert {one.kind for one in report.fitted[:2]} == {"network", "gaussian-process"}
    assert report.fitted[0].relative < 0.2 * report.fitted[2].relative


def test_recordings_that_are_held_out_are_not_learned_from() -> None:
    report = fit(RECORDED, ["linear"], hold_out=0.5, seed=3)
    data = report.fitted[0].model.data  # type: ignore[attr-defined]
    held = {row.tobytes() for run in report.held_out.runs for row in run.trajectory.states}
    assert len(data) == report.learned_from.steps == 400
    assert not {row.tobytes() for row in data.x} & held
    assert [one.source for one in fit(RECORDED, ["linear"], hold_out=0.5, seed=3).held_out.runs] == [
        one.source for one in report.held_out.runs
    ]


def test_the_last_part_of_a_single_recording_is_held_out() -> None:
    kept, held = split(recorded(RUNS[:1]), 0.25, 0)
    assert (kept.steps, held.steps) == (75, 25)
    assert held.runs[0].start == pytest.approx(75 * DT)
    np.testing.assert_array_equal(held.runs[0].trajectory.states, RUNS[0].states[75:])
    np.testing.assert_array_equal(held.runs[0].trajectory.inputs, RUNS[0].inputs[75:])
    with refuses(InputError, 1):
        split(recorded([run(1)]), 0.25, 0)


def test_what_recordings_do_not_determine_is_said() -> None:
    still = [Trajectory(one.times, one.states * [1.0, 0.0], one.inputs) for one in RUNS]
    report = fit(recorded(still), ["linear"])
    assert report.fitted == ()
    assert_names(report.failed[0].reason, "linear")
    rng = np.random.default_rng(0)
    x = rng.normal(size=(300, 2))
    feedback = -x[:, :1] + 1e-3 * rng.normal(size=(300, 1))
    sentence = identifiability(Transitions(x, feedback, x), ["angle", "rate", "torque"])
    assert_names(sentence, "angle", "torque")
    sentence = identifiability(Transitions(x, 0 * feedback, x), ["angle", "rate", "torque"])
    assert_names(sentence, "torque")
    sentence = identifiability(Transitions(x, rng.normal(size=(300, 1)), x), ["angle", "rate", "torque"])


@pytest.mark.parametrize("vectorized", [True, False])
def test_a_mass_that_is_a_fifth_off_is_found_within_its_confidence_interval(vectorized: bool) -> None:
    model, found = fit_parameters(cart, BOUNDS, noisy(1.2, 0.3, 0.01, 2), vectorized=vectorized)
    mass, friction = found
    assert mass.low < 1.2 < mass.high
    assert mass.high - mass.low < 0.2
    assert friction.low < 0.3 < friction.high
    assert model.theta == {"mass": mass.value, "friction": friction.value}
    assert (mass.note, friction.note) == ("", "")


@pytest.mark.slow
@pytest.mark.thorough
def test_confidence_intervals_contain_the_truth_as_often_as_they_say() -> None:
    inside = np.zeros(2)
    for seed in range(24):
        _, found = fit_parameters(cart, BOUNDS, noisy(1.2, 0.3, 0.02, seed, 120), vectorized=True, confidence=0.9)
        inside += [one.low <= truth <= one.high for one, truth in zip(found, (1.2, 0.3), strict=True)]
    # 0.9 within three standard errors of 24 trials.
    assert (np.abs(inside / 24 - 0.9) < 3 * np.sqrt(0.9 * 0.1 / 24)).all()


def test_intervals_are_those_of_linear_regression_if_the_model_is_linear_in_theta() -> None:
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(80, 1)), rng.normal(size=(80, 1))
    y = 0.7 * x + 0.2 * u + 0.1 * rng.normal(size=(80, 1))
    _, found = fit_parameters(
        lambda x, u, theta: theta[0] * x + theta[1] * u, {"a": (-2.0, 2.0), "b": (-2.0, 2.0)}, Transitions(x, u, y)
    )
    Z = np.concatenate([x, u], axis=1)
    expected = np.linalg.lstsq(Z, y[:, 0], rcond=None)[0]
    variance = ((y[:, 0] - Z @ expected) ** 2).sum() / (80 - 2)
    reach = 1.990847 * np.sqrt(variance * np.diag(np.linalg.inv(Z.T @ Z)))  # Student's t with 78 degrees of freedom
    np.testing.assert_allclose([one.value for one in found], expected, rtol=1e-6)
    np.testing.assert_allclose([one.high - one.value for one in found], reach, rtol=1e-4)


def test_parameters_that_only_matter_together_are_said_to_be_undetermined() -> None:
    def product(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return x + theta[0] * theta[1] * u

    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(60, 1)), rng.normal(size=(60, 1))
    _, found = fit_parameters(product, {"a": (0.5, 3.0), "b": (0.5, 3.0)}, Transitions(x, u, x + 2.0 * u))
    assert_names(found[0].note, "b")
    assert (found[0].low, found[0].high) == (-np.inf, np.inf)


def test_an_estimate_at_a_bound_is_noted() -> None:
    _, found = fit_parameters(cart, {"mass": (0.3, 1.0), "friction": (0, 2)}, noisy(1.2, 0.3, 0.01, 0), vectorized=True)
    assert "upper" in found[0].note
    assert not found[1].note


def test_the_estimate_does_not_stay_in_a_local_minimum() -> None:
    def wave(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return np.sin(theta[0] * x)

    x = np.linspace(-1, 1, 200)[:, None]
    _, (found,) = fit_parameters(
        wave, {"frequency": (0.1, 20)}, Transitions(x, 0 * x, np.sin(14.0 * x)), vectorized=True
    )
    assert found.value == pytest.approx(14.0, rel=1e-6)


@pytest.mark.parametrize(
    ("bounds", "facts"),
    [
        ({}, ("bounds",)),
        ({"mass": (2, 1)}, ("mass", "bounds")),
        ({"mass": (1,)}, ("mass", "bounds")),
        ({"mass": "ab"}, ("mass", "bounds")),
        ({"mass": (0, np.inf)}, ("mass", "bounds")),
        ({"mass": 3}, ("mass", "bounds")),
    ],
)
def test_bounds_that_cannot_be_used_are_refused(bounds: Any, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        fit_parameters(cart, bounds, noisy(1, 0, 0, 0))


def test_a_function_that_fails_is_said_to_fail() -> None:
    with refuses(ModelError, 1, "KeyError"):
        fit_parameters(lambda x, u, theta: {}["gain"], {"a": (0, 1)}, noisy(1, 0, 0, 0))
    with refuses(ModelError, (200, 1), 2):
        fit_parameters(lambda x, u, theta: x[..., :1], {"a": (0, 1)}, noisy(1, 0, 0, 0), vectorized=True)
    with refuses(InputError, 2):
        fit_parameters(cart, {"a": (0, 1), "b": (0, 1)}, noisy(1, 0, 0, 0, steps=1))


@pytest.mark.parametrize(
    ("options", "error", "facts"),
    [
        ({"kinds": ["linaer"]}, UnknownNameError, ("linaer", "linear")),
        ({"kinds": []}, InputError, ("linear", "network")),
        ({"kinds": ["parameters"]}, InputError, ("parameters", "x_next")),
        ({"kinds": ["linear"], "hold_out": 0}, InputError, (0, 1)),
    ],
)
def test_options_that_cannot_be_used_are_refused(
    options: Any, error: type[Exception], facts: tuple[object, ...]
) -> None:
    with refuses(error, *facts):
        fit(RECORDED, **options)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["linear", "network"])
def test_a_written_onnx_file_computes_the_same(kind: Any, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    learned = fit(RECORDED, [kind]).fitted[0].model
    write_onnx(tmp_path / "model.onnx", learned)
    read = models.Onnx(str(tmp_path / "model.onnx"))
    x, u = np.random.default_rng(0).normal(size=(2, 9, 2))
    np.testing.assert_allclose(read.step(x, u[:, :1]), learned.step(x, u[:, :1]), rtol=1e-12, atol=1e-12)
    with refuses(InputError, "linear", "Function"):
        write_onnx(tmp_path / "other.onnx", models.Function(lambda x, u: x))


def test_a_correction_of_a_corrected_model_can_be_written_as_onnx(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    rng = np.random.default_rng(0)
    correction = models.Correction(
        *(np.zeros(3), np.ones(3), rng.normal(size=(4, 3)), np.ones(3), rng.normal(size=(4, 2))),
        *(rng.normal(size=(4, 2)), -np.ones(3), np.ones(3), np.ones(3), np.ones(2)),
    )
    first = models.Linear([[1, DT], [0, 1]], [[0], [DT]])
    twice = models.Corrected(models.Corrected(first, correction), correction)
    write_onnx(tmp_path / "twice.onnx", twice)
    x, u = 2 * rng.normal(size=(2, 9, 2))
    read = models.Onnx(str(tmp_path / "twice.onnx")).step(x, u[:, :1])
    np.testing.assert_allclose(read, twice.step(x, u[:, :1]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "model",
    [
        models.Linear(np.eye(3), np.ones((3, 1))),
        models.GaussianProcessModel.fit(
            Transitions(np.random.default_rng(0).random((9, 3)), np.ones((9, 1)), np.zeros((9, 3))), 5
        ),
    ],
    ids=["linear", "gaussian-process"],
)
def test_a_given_model_of_another_size_is_refused_in_one_sentence(model: Any) -> None:
    with refuses(ModelError, 2, 1):
        fit(RECORDED, ["linear"], given=model)
