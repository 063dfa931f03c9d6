from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Array, Task, Trajectory
from ctxval.errors import InputError, ShapeError, UnknownNameError
from ctxval.specs import Ball, Box, Outside, ReachAvoid, Specification
from facts import refuses

H, DT = 4, 0.5
TASK = Task([0.0, 0.0, 0.0], horizon=H, dt=DT, environment={"goal": [1.0, 1.0]})
SPEC = ReachAvoid(
    avoid=[Ball([0.0, 1.0], radius=0.3), Outside(Box(low=[-1, -1], high=[2, 2]))],
    reach=Ball("goal", radius=0.5),
    times=(1.0, 2.0),
    components=(0, 2),
)
STATES = arrays(np.float64, (H + 1, 3), elements=st.floats(-3, 3))


def trajectory(states: Array) -> Trajectory:
    return Trajectory(DT * np.arange(H + 1), states, np.zeros((*states.shape[:-2], H, 1)))


def satisfied(states: np.ndarray) -> bool:
    at = states[:, [0, 2]]
    avoided = (np.linalg.norm(at - [0.0, 1.0], axis=1) > 0.3).all() and ((at > -1) & (at < 2)).all()
    return bool(avoided and (np.linalg.norm(at[2:] - 1.0, axis=1) < 0.5).any())


@given(STATES)
def test_the_robustness_is_positive_if_and_only_if_the_specification_holds(states: np.ndarray) -> None:
    rho = float(SPEC.robustness(trajectory(states), TASK))
    if abs(rho) > 1e-9:
        assert (rho > 0) == satisfied(states)


@given(STATES, STATES)
def test_the_robustness_changes_by_at_most_the_largest_deviation(states: np.ndarray, others: np.ndarray) -> None:
    # This law makes d_b at most d_a.
    change = abs(float(SPEC.robustness(trajectory(states), TASK) - SPEC.robustness(trajectory(others), TASK)))
    assert change <= np.linalg.norm((states - others)[:, [0, 2]], axis=1).max() + 1e-9


@given(STATES, STATES, st.floats(0.01, 0.4))
def test_what_satisfies_the_tightened_specification_may_deviate(a: np.ndarray, b: np.ndarray, by: float) -> None:
    deviation = (b - a) / max(np.linalg.norm((b - a)[:, [0, 2]], axis=1).max(), 1e-9) * 0.999 * by
    if SPEC.tightened(by).robustness(trajectory(a), TASK) > 0:
        assert SPEC.robustness(trajectory(a + deviation), TASK) > 0


def test_a_batch_has_the_robustness_of_each() -> None:
    states = np.random.default_rng(0).normal(size=(6, 4, H + 1, 3))
    tasks = Task(np.zeros((4, 3)), horizon=H, dt=DT, environment={"goal": np.random.default_rng(1).normal(size=(4, 2))})
    rho = SPEC.robustness(trajectory(states), tasks)
    assert rho.shape == (6, 4)
    for s, k in ((0, 0), (5, 3)):
        np.testing.assert_allclose(rho[s, k], SPEC.robustness(trajectory(states[s, k]), tasks[k]), rtol=1e-12)


def test_one_trajectory_is_judged_in_many_environments() -> None:
    states = np.random.default_rng(0).normal(size=(H + 1, 3))
    tasks = Task(np.zeros((5, 3)), horizon=H, dt=DT, environment={"goal": np.linspace([0, 0], [1, 1], 5)})
    rho = SPEC.robustness(trajectory(states[None]), tasks)
    np.testing.assert_allclose(rho, [SPEC.robustness(trajectory(states), tasks[k]) for k in range(5)])


def test_a_drift_with_one_wall_has_its_closed_form() -> None:
    # x(t) = v t, and the wall is at 1: rho = 1 - v H dt.
    v = np.linspace(0.1, 1.0, 7)
    states = v[:, None, None] * (DT * np.arange(H + 1))[None, :, None]
    tasks = Task(np.zeros((7, 1)), horizon=H, dt=DT)
    rho = ReachAvoid(avoid=Box(low=[1.0], high=[np.inf])).robustness(trajectory(states), tasks)
    np.testing.assert_allclose(rho, 1 - v * H * DT)


def test_the_reach_set_counts_within_its_times_only() -> None:
    states = np.zeros((H + 1, 1))
    states[1] = 1.0
    reach = Ball([1.0], radius=0.25)
    assert ReachAvoid(reach=reach).robustness(trajectory(states), TASK) == -0.75
    assert ReachAvoid(reach=reach, times=(0.5, 0.5)).robustness(trajectory(states), TASK) == 0.25
    # The windows contain the recorded time 0.5 s, and not the nearest ones outside of them.
    assert ReachAvoid(reach=reach, times=(0.3, 0.9)).robustness(trajectory(states), TASK) == 0.25
    assert ReachAvoid(reach=reach, times=(0.6, 1.1)).robustness(trajectory(states), TASK) == -0.75
    assert ReachAvoid(reach=reach, times=(0.1 + 0.2 + 0.2, 0.5)).robustness(trajectory(states), TASK) == 0.25
    with refuses(InputError, 0.5, 0.6, 0.9):
        ReachAvoid(reach=reach, times=(0.6, 0.9)).robustness(trajectory(states), TASK)
    with refuses(InputError, 2, 9):
        ReachAvoid(reach=reach, times=(0.0, 9.0)).robustness(trajectory(states), TASK)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({}, ("avoid", "reach")),
        ({"avoid": []}, ("avoid", "reach")),
        ({"avoid": 3}, ("avoid", 3)),
        ({"reach": {"type": "Ball", "radius": 0.0}}, ("radius", 0.0)),
        ({"avoid": Ball([0], radius=1.0), "times": [0, 1]}, ("reach", "times")),
        ({"reach": Ball([0], radius=1.0), "times": [2, 1]}, ("times", [2, 1])),
        ({"avoid": Ball([0], radius=1.0), "components": []}, ("components",)),
    ],
)
def test_a_specification_that_cannot_be_is_refused(options: dict[str, Any], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        ReachAvoid(**options)


def test_states_have_names() -> None:
    named = ReachAvoid(avoid=Ball([0.0], radius=1.0), components=["height"])
    with refuses(ShapeError, 3, "components"):
        named.robustness(trajectory(np.zeros((H + 1, 3))), TASK)
    assert named.with_states(["x", "speed", "height"]).components == (2,)
    with refuses(UnknownNameError, "height", "x"):
        named.with_states(["x"])


def test_it_is_a_specification() -> None:
    assert isinstance(SPEC, Specification)
    assert len(SPEC.sets) == 3
