"""Inputs that follow with play."""

from __future__ import annotations

import numpy as np

from ctxval import models
from ctxval.learning import effects
from ctxval.learning.effects import ModelWithEffects

DT = 0.05
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])


def test_backlash_loses_its_play_when_the_input_turns_round() -> None:
    inputs = np.array([0.0, 1.0, 0.9, 0.5, -1.0])[:, None]
    acting = ModelWithEffects(MODEL, (effects.Backlash((0.2,)),)).acting(inputs)[:, 0]
    np.testing.assert_allclose(acting, [0.0, 0.8, 0.8, 0.7, -0.8])
