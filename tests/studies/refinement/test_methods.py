"""Corrections that are learned from records, exactly or with noise that is averaged."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Trajectory, Transitions, models
from ctxval.core.model import Model
from ctxval.studies.refinement import Records, ResidualCorrection
from ctxval.studies.refinement.methods import averaged_correction, exact_correction
from rig_refine import FIRST, cart

NOISE = 0.05


def runs(noise: float, count: int = 4, horizon: int = 150) -> tuple[Trajectory, ...]:
    """Return runs of the cart under random forces, with noise of its speed."""
    rng, made = np.random.default_rng(0), []
    for _ in range(count):
        u, x = np.repeat(rng.uniform(-2, 2, size=(horizon // 10, 1)), 10, axis=0), [np.zeros(2)]
        for t in range(horizon):
            x.append(cart(x[-1], u[t]) + noise * np.array([0.0, rng.normal()]))
        made.append(Trajectory(0.1 * np.arange(horizon + 1), np.array(x), u))
    return tuple(made)


def error_of(model: Model) -> float:
    """Return the error of the next speed without noise, over that of the model without friction."""
    data = Records(runs(0.0)).transitions
    left, before = (data.x_next - either.step(data.x, data.u) for either in (model, FIRST))
    return float(np.sqrt((left[:, 1] ** 2).mean() / (before[:, 1] ** 2).mean()))


def test_noise_is_averaged() -> None:
    correction = averaged_correction(FIRST, Records(runs(NOISE)))
    assert correction is not None
    assert error_of(models.Corrected(FIRST, correction)) < 0.2
    assert np.array_equal(correction(np.zeros((3, 2)), np.ones((3, 1)))[:, 0], np.zeros(3))  # of the position


def test_transitions_of_the_model_are_averaged_too() -> None:
    run = runs(NOISE)
    whole = Records(run)
    parted = Records(run[:1], own=Transitions.joined([one.transitions() for one in run[1:]]))
    x, u = np.array([[0.0, 0.5], [1.0, -1.0]]), np.ones((2, 1))
    first, second = (averaged_correction(FIRST, records) for records in (whole, parted))
    assert first is not None
    assert second is not None
    assert first(x, u)[:, 1] == pytest.approx(second(x, u)[:, 1], abs=0.01)


def test_what_a_model_explains_is_not_corrected() -> None:
    true = models.Function(cart, vectorized=True)
    assert averaged_correction(true, Records(runs(0.0))) is None


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_the_correction_is_used_that_errs_less_on_held_out_executions(noise: float) -> None:
    records = Records(runs(noise))
    exact, averaged = exact_correction(FIRST, records), averaged_correction(FIRST, records)
    learned = ResidualCorrection().learn(FIRST, records)
    used = averaged if noise else exact
    assert used is not None
    assert isinstance(learned.model, models.Corrected)
    x, u = np.array([[0.0, 0.5], [1.0, -1.0]]), np.ones((2, 1))
    assert learned.model.correction(x, u)[:, 1] == pytest.approx(used(x, u)[:, 1], abs=1e-12)
    assert error_of(learned.model) < (0.2 if noise else 0.01)
