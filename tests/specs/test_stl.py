from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from ctxval import Array, Task, Trajectory
from ctxval.errors import InputError, ShapeError
from ctxval.specs import STL, Ball, Box, ReachAvoid
from facts import refuses

TASK = Task([0.0], horizon=6, dt=0.1, environment={"limit": [0.9]})
there = pytest.mark.skipif(importlib.util.find_spec("rtamt") is None, reason="rtamt is an extra")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:antlr4", "ignore:.*typing.io:DeprecationWarning")


def trajectory(states: Array) -> Trajectory:
    return Trajectory(0.1 * np.arange(7), states, np.zeros((*states.shape[:-2], 6, 1)))


@pytest.mark.skipif(importlib.util.find_spec("rtamt") is not None, reason="rtamt is installed")
def test_without_the_extra_one_sentence_says_how_to_get_it() -> None:
    with refuses(InputError, "ctxval[stl]", "rtamt"):
        STL("always (x < 1.0)", ["x"])


@there
def test_a_formula_agrees_with_sets() -> None:
    states = np.random.default_rng(0).normal(size=(3, 7, 1))
    formula = STL("always (x < 1.0) and eventually[0.2:0.4] (abs(x - 0.5) < 0.25)", ["x"])
    sets = ReachAvoid(Box(low=[1.0], high=[np.inf]), Ball([0.5], radius=0.25), (0.2, 0.4))
    tasks = Task(np.zeros((3, 1)), horizon=6, dt=0.1)
    rho = formula.robustness(trajectory(states), tasks)
    np.testing.assert_allclose(rho, sets.robustness(trajectory(states), tasks))


@there
def test_a_formula_knows_the_environment_and_refuses_what_it_cannot_read() -> None:
    states = np.full((7, 1), 0.5)
    assert STL("always (x < limit_0)", ["x"]).robustness(trajectory(states), TASK) == pytest.approx(0.4)
    with refuses(InputError, "y"):
        STL("always (y < 1)", ["x"]).robustness(trajectory(states), TASK)
    with refuses(InputError, 0.6):
        STL("eventually[0.8:0.9] (x > 0)", ["x"]).robustness(trajectory(states), TASK)
    with refuses(ShapeError, 1, 2):
        STL("always (x < 1.0)", ["x"], (0, 1))
