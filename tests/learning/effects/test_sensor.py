"""What is recorded of states, and the states of what is recorded."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import models
from ctxval.learning import effects
from ctxval.learning.effects import Effect

DT = 0.05
MODEL = models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])


@pytest.mark.parametrize(
    "effect",
    [
        effects.SensorOffset((0.3,), 1),
        effects.SensorScale((1.2,), (0, 2)),
        effects.SwappedJoints((), (0, 2), (1, 3)),
    ],
)
def test_states_are_found_again_in_what_is_recorded(effect: Effect) -> None:
    x = np.random.default_rng(0).normal(size=(5, 4))
    assert np.abs(effect.recorded(x) - x).max() > 0.1
    np.testing.assert_allclose(effect.true(effect.recorded(x)), x, rtol=1e-12)
