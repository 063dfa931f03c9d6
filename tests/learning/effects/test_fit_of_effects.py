"""What residuals show beside the noise of measurements, and the shares that effects explain."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Array, Trajectory, models
from ctxval.learning import effects
from ctxval.learning.effects import ModelWithEffects
from ctxval.learning.effects.fit import Segments

DT = 0.05
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])


def runs(gain: float, noise: Array, seed: int = 0) -> list[Trajectory]:
    """Return four recordings of a carriage whose motor has a gain, with noise of the measurements."""
    rng, made = np.random.default_rng(seed), []
    for _ in range(4):
        u = np.repeat(rng.normal(size=(25, 1)), 8, axis=0)
        x = np.zeros((len(u) + 1, 2))
        for t, each in enumerate(u):
            x[t + 1] = MODEL.step(x[t], gain * each)
        made.append(Trajectory(DT * np.arange(len(x)), x + noise * rng.standard_normal(x.shape), u))
    return made


@pytest.mark.parametrize("noise", [[0.0, 0.0], [0.002, 0.01]])
def test_residuals_show_the_noise_of_measurements(noise: list[float]) -> None:
    right = ModelWithEffects(MODEL, (effects.InputGain((0.7,), 0),))
    segments = Segments(MODEL, runs(0.7, np.array(noise)))
    np.testing.assert_allclose(segments.noise(right), noise, rtol=0.15, atol=1e-6)


def test_noise_hides_neither_an_effect_nor_that_it_is_wrong() -> None:
    noise = np.array([0.002, 0.01])
    segments = Segments(MODEL, runs(0.7, noise))
    right, half = (ModelWithEffects(MODEL, (effects.InputGain((gain,), 0),)) for gain in (0.7, 0.85))
    share, uncertainty = segments.explained(right, noise)
    assert uncertainty < 0.1
    assert share > 1 - 3 * uncertainty
    share, _ = segments.explained(half, noise)  # of the squares: 1 - 0.5**2
    assert share == pytest.approx(0.75, abs=0.02)
    assert segments.explained(right, 0 * noise)[1] == 0.0


def test_residuals_of_draws_are_those_of_each_draw() -> None:
    segments = Segments(MODEL, runs(0.7, np.zeros(2)))
    gains, delays = np.array([[0.7], [0.9]]), np.array([[0.4], [1.6]])
    together = ModelWithEffects(MODEL, (effects.InputGain((gains,), 0), effects.Delay((delays,), held=False)), 1)
    for window in segments.windows:
        left = segments.left_by(together, window)
        for k, (gain, delay) in enumerate(zip(gains[:, 0], delays[:, 0], strict=True)):
            alone = (effects.InputGain((gain,), 0), effects.Delay((delay,), held=False))
            expected = segments.left_by(ModelWithEffects(MODEL, alone, 1), window)
            np.testing.assert_allclose(left[k], expected, rtol=1e-9, atol=1e-12)
