"""Tests of the effects of whole executions."""

from itertools import pairwise

import numpy as np
import pytest

from ctxval.learning.run_effects import RunEffects, run_effects

RUNS, STEPS, LIVE = 12, 40, np.array([True, False])
ROWS = [k * STEPS + np.arange(STEPS) for k in range(RUNS)]


def found(effects: np.ndarray, seed: int = 0, correlation: float = 0.0) -> RunEffects:
    """Return the effects that are found if those of one state are constants and gains of the input, ``(K, 2)``."""
    rng = np.random.default_rng(seed)
    pairs, noise = rng.standard_normal((RUNS * STEPS, 3)), rng.standard_normal((RUNS * STEPS, 2))
    for run in ROWS:
        for before, after in pairwise(run):
            noise[after] = correlation * noise[before] + np.sqrt(1 - correlation**2) * noise[after]
        noise[run, 0] += effects[run[0] // STEPS, 0] + effects[run[0] // STEPS, 1] * pairs[run, 2]
    noise[:, 1] = 0.0
    return run_effects(pairs, noise / np.sqrt((noise[:, 0] ** 2).mean()), LIVE, ROWS, None)


def test_independent_steps_have_no_effects() -> None:
    assert not any(found(np.zeros((RUNS, 2)), seed).matter for seed in range(20))


def test_a_gain_of_each_execution_is_found_with_its_size() -> None:
    rng = np.random.default_rng(1)
    gains = np.column_stack([np.zeros(RUNS), rng.normal(size=RUNS)])
    effects = found(gains)
    assert effects.matter
    assert np.corrcoef(effects.effects[:, 3, 0], gains[:, 1])[0, 1] > 0.97
    assert (effects.effects[:, :, 1] == 0).all()
    assert (effects.within[:, 0] ** 2).mean() < 0.8


def test_one_execution_of_twelve_that_differs_is_found() -> None:
    wet = np.zeros((RUNS, 2))
    wet[5, 1] = 2.0
    effects = found(wet)
    assert effects.matter
    assert np.abs(effects.effects[:, 3, 0]).argmax() == 5


def test_noise_that_is_correlated_from_step_to_step_matters() -> None:
    assert found(np.zeros((RUNS, 2)), correlation=0.6).matter


def test_a_residual_that_has_taken_a_part_of_the_effects_leaves_larger_ones() -> None:
    wet = np.zeros((RUNS, 2))
    wet[:, 1] = np.random.default_rng(3).normal(size=RUNS)
    rng = np.random.default_rng(0)
    pairs = rng.standard_normal((RUNS * STEPS, 3))
    own = np.zeros((RUNS * STEPS, RUNS))  # a feature for each execution, as places that one execution visits are
    for k, run in enumerate(ROWS):
        own[run, k] = pairs[run, 2]
    errors = own @ wet[:, 1] + 0.3 * rng.standard_normal(RUNS * STEPS)
    inverse = np.linalg.inv(own.T @ own + 20 * np.eye(RUNS))
    left = np.column_stack([errors - own @ inverse @ own.T @ errors, np.zeros(len(errors))])
    left /= np.sqrt((left[:, 0] ** 2).mean())
    aware, unaware = (run_effects(pairs, left, LIVE, ROWS, hats) for hats in ([(own, inverse)], None))
    assert np.abs(aware.effects[:, 3, 0]).sum() > 1.5 * np.abs(unaware.effects[:, 3, 0]).sum()


def test_effects_that_change_with_the_order_are_told_from_others() -> None:
    order, rng = np.arange(RUNS, dtype=float), np.random.default_rng(4)
    columns = np.column_stack([order, rng.random(RUNS)])
    wearing = found(np.column_stack([np.zeros(RUNS), 0.3 * order]))
    column, p_value = wearing.drift(columns) or (-1, 1.0)
    assert (column, p_value) == (0, pytest.approx(0.001, abs=0.002))
    scattered = found(np.column_stack([np.zeros(RUNS), rng.permutation(0.3 * order)]))
    assert (scattered.drift(columns) or (0, 0.0))[1] > 0.01
    assert found(np.zeros((RUNS, 2))).drift(columns) is None
