"""Inputs with limits."""

from __future__ import annotations

import numpy as np

from ctxval import models
from ctxval.learning import effects
from ctxval.learning.effects import ModelWithEffects

DT = 0.05
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])


def test_an_input_follows_with_a_limited_rate() -> None:
    inputs = np.array([1.0, 1.0, 1.0, 0.9, -1.0])[:, None]
    acting = ModelWithEffects(MODEL, (effects.RateLimit((8.0,), 0, DT),)).acting(inputs)[:, 0]
    np.testing.assert_allclose(acting, [0.4, 0.8, 1.0, 0.9, 0.5])
