"""Actuators that act late."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval.systems.actuator import Actuator

COLUMN = np.array([[0.3], [2.0], [7.5]])


@pytest.mark.parametrize("parts", [1, 4])
@pytest.mark.parametrize("sizes", [{"lag": 3.0}, {"lag": 1e-3, "delay": 1.3}, {"lag": COLUMN}, {"delay": COLUMN}])
def test_all_steps_at_once_are_the_steps_one_by_one(sizes: dict[str, Any], parts: int) -> None:
    actuator, inputs = Actuator(**sizes), np.random.default_rng(0).normal(size=(3, 2, 200, 2))
    memory, steps = None, []
    for t in range(200):
        acting, memory = actuator.follow(inputs[..., t, :], memory, parts)
        steps.append(acting)
    np.testing.assert_allclose(actuator.acting(inputs, parts), np.stack(steps, axis=2), rtol=0, atol=1e-12)
