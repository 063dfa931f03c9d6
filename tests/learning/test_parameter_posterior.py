"""The posterior of uncertain parameters: what segments of executions tell of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import models
from ctxval.core.trajectory import Trajectory
from ctxval.learning.parameter_posterior import ParameterMode, ParameterSettings, Segments, blocks_of

TRUE = {"mass": 1.3, "drag": 0.4, "pull": -0.5}


def _mass_on_a_rail(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
    force = u[..., 0] - theta[1] * x[..., 1] * np.abs(x[..., 1]) + theta[2]
    rate = x[..., 1] + 0.05 * force / theta[0]
    return np.stack([x[..., 0] + 0.05 * rate, rate], axis=-1)


def _model() -> models.Parametric:
    values = {"mass": 1.0, "drag": 0.2, "pull": 0.0}
    deviations: dict[str, float | str] = {"mass": "20 %", "drag": 0.2, "pull": 0.5}
    return models.Parametric(_mass_on_a_rail, values, uncertain=deviations, vectorized=True)


def _executions(noise: float, outliers: bool = False) -> list[Trajectory]:
    system, rng = models.Parametric(_mass_on_a_rail, TRUE, vectorized=True), np.random.default_rng(1)
    runs = []
    for _ in range(2):
        x, u = [np.zeros(2)], rng.normal(0, 3, (60, 1)).cumsum(axis=0) * 0.3
        for k, each in enumerate(u):
            hit = np.array([0.0, 2.0]) if outliers and k % 20 == 10 else np.zeros(2)
            x.append(system.step(x[-1], each) + noise * rng.normal(size=2) + hit)
        runs.append(Trajectory(0.05 * np.arange(61), np.array(x), u))
    return runs


def _posterior(executed: list[Trajectory], seed: int = 0) -> np.ndarray:
    model, rng = _model(), np.random.default_rng(seed)
    segments = Segments.of(model, executed, rng, ParameterSettings())
    assert segments is not None
    drawn = ParameterMode.of(model, segments, ParameterSettings()).posterior(rng).draw(200, rng)
    return np.stack([each.at(drawn[:, k]) for k, each in enumerate(model.uncertain)], axis=1)


def test_exact_executions_tell_the_parameters() -> None:
    found = _posterior(_executions(0.0))
    np.testing.assert_allclose(np.median(found, axis=0), list(TRUE.values()), rtol=0.01)


def test_a_few_hits_hardly_move_them() -> None:
    found = _posterior(_executions(1e-3, outliers=True))
    np.testing.assert_allclose(np.median(found, axis=0), list(TRUE.values()), rtol=0.1, atol=0.05)


def test_the_truth_lies_within_the_draws() -> None:
    found = _posterior(_executions(0.01))
    away = np.abs(found.mean(axis=0) - list(TRUE.values())) / found.std(axis=0)
    assert away.max() < 4


def test_draws_of_one_seed_are_the_same() -> None:
    np.testing.assert_array_equal(_posterior(_executions(0.01), 3), _posterior(_executions(0.01), 3))


def _ridge(count: int) -> tuple[models.Parametric, list[Trajectory]]:
    """A model whose first uncertain parameters act as their product alone, and exact executions."""

    def step(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
        gain = np.prod(theta[:count], axis=0)
        rate = x[..., 1] + 0.05 * (gain * u[..., 0] - theta[count] * x[..., 1]) / theta[count + 1]
        return np.stack([x[..., 0] + 0.05 * rate, rate], axis=-1)

    names = [*(f"gain{k}" for k in range(count)), "drag", "mass"]
    share: dict[str, float | str] = dict.fromkeys(names, "30 %")
    model = models.Parametric(step, dict.fromkeys(names, 1.0) | {"drag": 0.2}, uncertain=share, vectorized=True)
    rng, runs, true = np.random.default_rng(0), [], np.array([*np.linspace(0.8, 1.3, count), 0.3, 1.1])
    for _ in range(8):
        states, inputs = [rng.normal(size=2)], 2 * rng.normal(size=(40, 1))
        for u in inputs:
            states.append(step(states[-1], u, true))
        runs.append(Trajectory(0.05 * np.arange(41), np.array(states), inputs))
    return model, runs


@pytest.mark.parametrize("count", [2, 4])
def test_parameters_of_which_executions_tell_the_product_alone_stay_uncertain(count: int) -> None:
    model, runs = _ridge(count)
    segments = Segments.of(model, runs, np.random.default_rng(0), ParameterSettings())
    assert segments is not None
    posterior = ParameterMode.of(model, segments, ParameterSettings()).posterior(np.random.default_rng(1))
    z = posterior.draw(400, np.random.default_rng(2))
    # Of parameters with one normal prior, a known product leaves all directions but one.
    np.testing.assert_allclose(z[:, :count].std(axis=0), np.sqrt(1 - 1 / count), rtol=0.3)
    assert 1 / (posterior.weights**2).sum() > 29
    assert posterior.left < 1e-3


def test_parameters_that_are_known_very_unequally_have_samples() -> None:
    model, runs = _ridge(2)
    segments = Segments.of(model, runs, np.random.default_rng(0), ParameterSettings())
    assert segments is not None
    mode = ParameterMode.of(model, segments, ParameterSettings())
    turned = np.linalg.qr(np.random.default_rng(1).normal(size=(4, 4)))[0]
    precision = turned * [1.0, 1.0, 1e9, 3e10] @ turned.T
    posterior = replace(mode, precision=precision).posterior(np.random.default_rng(1))
    assert np.isfinite(posterior.samples).all()


def test_without_a_finite_step_there_are_no_segments() -> None:
    run = Trajectory(np.arange(3.0), np.full((3, 2), np.nan), np.zeros((2, 1)))
    assert Segments.of(_model(), [run], np.random.default_rng(0), ParameterSettings()) is None


@given(st.lists(st.integers(1, 30), min_size=1, max_size=4), st.integers(1, 50), st.integers(1, 8))
def test_blocks_are_consecutive_rows_of_one_record(lengths: list[int], horizon: int, block: int) -> None:
    rows = blocks_of(lengths, 3, horizon, block, np.random.default_rng(0))
    assert rows.shape == (3, horizon)
    assert rows.min() >= 0
    assert rows.max() < sum(lengths)
    source = np.repeat(np.arange(len(lengths)), lengths)
    if min(lengths) >= block:
        for first in range(0, horizon, block):
            some = rows[:, first : first + block]
            assert (np.diff(some, axis=1) == 1).all()
            assert (source[some] == source[some[:, :1]]).all()
