"""Constants and drifts that are added to inputs."""

from __future__ import annotations

import numpy as np

from ctxval import models
from ctxval.learning import effects
from ctxval.learning.effects import ModelWithEffects

DT = 0.05
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])


def test_a_drift_grows_with_the_time_of_an_execution() -> None:
    acting = ModelWithEffects(MODEL, (effects.InputDrift((0.2,), 0, DT),)).acting(np.ones((4, 1)))[:, 0]
    np.testing.assert_allclose(acting, 1.0 + 0.2 * DT * np.arange(4))
