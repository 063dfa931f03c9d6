"""Campaigns on a system with noise that nobody declared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.certificates import Automatic, CertificateOptions
from facts import assert_names

FEW_TESTS = CertificateOptions(Automatic(tests=2))


def step(x: Array, u: Array) -> Array:
    speed = x[..., 1]
    return np.asarray(x + 0.1 * np.stack([speed, u[..., 0] - 0.4 * speed - 0.2 * speed * np.abs(speed)], axis=-1))


def cart(process: float = 0.01, seed: int = 1, start: float = 0.0) -> Validation:
    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0)),
        task=lambda p: Task(np.stack([0 * p.goal, 0 * p.goal], axis=-1), goal=[p.goal, 0.0], horizon=20, dt=0.1),
        system=systems.Imperfect(step, vectorized=True, start=start, process=[0.0, process], seed=seed),
        model=models.Linear([[1.0, 0.1], [0.0, 0.97]], [[0.0], [0.1]]),
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
        start_tolerance=1.0,
    )


def largest_quantile(validation: Validation) -> float:
    tasks = np.repeat(np.linspace(-2, 2, 41), 100)[:, None]
    return float(np.quantile(validation.distances(tasks).reshape(41, 100), 0.9, axis=1).max())


@pytest.mark.slow
def test_a_bound_on_the_quantile_is_validated_and_says_so(tmp_path: Path) -> None:
    validation = cart()
    largest = largest_quantile(validation)
    campaign = Campaign(validation, store=tmp_path / "a.sqlite", seed=0).run(20, 1.5 * largest, certificate=FEW_TESTS)
    verdict = campaign.verdict(1.5 * largest, certificate=FEW_TESTS)
    assert verdict.answer == "validated"
    assert campaign.executions < 20
    assert verdict.bound is not None
    assert 0.85 * largest < verdict.bound < 1.5 * largest
    assert_names(verdict.reason, 90, "executions")
    assert verdict.rests_on is not None
    assert_names(verdict.rests_on, "noise")
    assert "deterministic" not in verdict.rests_on
    assert verdict.certificate is not None
    assert verdict.certificate.details["quantile"] == 0.9
    # The stored predictions of later executions know the noise.
    noisy = [trial for trial in campaign.trials if (trial.note.prediction or {}).get("noise")]
    assert noisy


@pytest.mark.slow
@pytest.mark.thorough
def test_one_execution_above_the_threshold_is_not_enough() -> None:
    validation = cart()
    largest = largest_quantile(validation)
    campaign = Campaign(validation, seed=0).run(20, 0.7 * largest, certificate=FEW_TESTS)
    verdict = campaign.verdict(0.7 * largest, certificate=FEW_TESTS)
    assert verdict.answer == "falsified"
    assert sum((trial.distance or 0) > 0.7 * largest for trial in campaign.trials) >= 2


@pytest.mark.slow
@pytest.mark.thorough
def test_without_noise_nothing_changes() -> None:
    campaign = Campaign(cart(0.0), seed=0).run(20, 0.5, certificate=FEW_TESTS)
    verdict = campaign.verdict(0.5, certificate=FEW_TESTS)
    assert verdict.answer == "validated"
    assert verdict.certificate is not None
    assert verdict.certificate.details["quantile"] is None
    assert verdict.certificate.details["lags"] == 0
    assert "executions" not in verdict.reason


@pytest.mark.slow
@pytest.mark.thorough
def test_measurement_noise_that_hardly_moves_a_distance_is_no_end() -> None:
    """It is a large part of what M misses, and a small one of the distance: the bound is one on the quantile."""
    noisy = systems.Imperfect(step, vectorized=True, measurement=[3e-4, 3e-4], seed=1)
    campaign = Campaign(cart().with_parts(system=noisy), seed=0).run(14, 0.6, certificate=FEW_TESTS)
    verdict = campaign.verdict(0.6, certificate=FEW_TESTS)
    assert verdict.answer == "validated"
    assert verdict.certificate is not None
    assert verdict.certificate.kind == "dynamics"
    assert verdict.certificate.details["noise"] > 0.01
    assert verdict.certificate.details["quantile"] == 0.9


@pytest.mark.slow
@pytest.mark.thorough
def test_initial_states_that_scatter_are_noise_too() -> None:
    validation = cart(0.0, start=0.03)
    largest = largest_quantile(validation)
    campaign = Campaign(validation, seed=0).run(20, 1.5 * largest, certificate=FEW_TESTS)
    verdict = campaign.verdict(1.5 * largest, certificate=FEW_TESTS)
    assert verdict.answer == "validated"
    assert verdict.bound is not None
    assert 0.9 * largest < verdict.bound < 1.5 * largest
    assert_names(verdict.reason, 90)
