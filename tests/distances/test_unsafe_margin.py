from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Task, Trajectory
from ctxval.distances import MaximumDeviation, UnsafeMargin, by_name
from ctxval.errors import InputError, UnknownNameError
from ctxval.specs import Ball, ReachAvoid
from ctxval.testing import check_distance
from facts import refuses

H = 3
TASK = Task([0.0, 0.0], horizon=H, dt=0.1)
SPEC = ReachAvoid(avoid=Ball([0.0, 1.0], radius=0.5), reach=Ball([1.0, 0.0], radius=1.0))
STATES = arrays(np.float64, (2, H + 1, 2), elements=st.floats(-2, 2))


def both(states: np.ndarray) -> tuple[Trajectory, Trajectory]:
    model, system = (Trajectory(0.1 * np.arange(H + 1), x, np.zeros((H, 1))) for x in states)
    return model, system


def test_it_conforms() -> None:
    tasks = Task(np.zeros((4, 2)), horizon=H, dt=0.1)
    states = np.random.default_rng(0).normal(size=(2, 4, H + 1, 2))
    model, system = (Trajectory(0.1 * np.arange(H + 1), x, np.zeros((4, H, 1))) for x in states)
    check_distance(by_name("UnsafeMargin", spec=SPEC, margin=0.3), model, system, tasks)


@given(STATES)
def test_it_is_the_margin_of_an_unsafe_task_and_at_most_the_deviation(states: np.ndarray) -> None:
    model, system = both(states)
    of_model, of_system = (float(SPEC.robustness(one, TASK)) for one in (model, system))
    distance = float(UnsafeMargin(SPEC)(model, system, TASK))
    if of_system <= 0 < of_model:
        assert distance == of_model
    assert distance <= max(of_model, 0.0)
    assert distance <= float(MaximumDeviation(2)(model, system, TASK)) + 1e-9  # d_b is at most d_a


@given(STATES, st.floats(0.05, 0.9))
def test_with_a_margin_it_exceeds_the_margin_for_counterexamples_alone(states: np.ndarray, margin: float) -> None:
    model, system = both(states)
    of_model, of_system = (float(SPEC.robustness(one, TASK)) for one in (model, system))
    exceeds = float(UnsafeMargin(SPEC, margin)(model, system, TASK)) > margin
    if min(abs(of_model - margin), abs(of_system)) > 1e-9:
        assert exceeds == (of_model > margin and of_system < 0)


def test_it_is_made_from_tables_without_code_of_other_packages() -> None:
    table = {"avoid": [{"type": "Ball", "center": [0, 1], "radius": 0.5}], "components": ["x", "y"]}
    made = UnsafeMargin(table).with_states(["x", "y"])
    assert made.spec.components == (0, 1)
    for wrong, facts in (
        ({"type": "other"}, ("other",)),
        ({"avoid": {"type": "other"}}, ("other", "Polytope")),
        ({}, ("specification",)),
        (3, ("spec", 3)),
    ):
        with refuses((InputError, UnknownNameError), *facts):
            UnsafeMargin(wrong)
    with refuses(InputError, "penalty", 1):
        UnsafeMargin(SPEC, penalty=0.5)
    with refuses(InputError, "margin", -0.1):
        UnsafeMargin(SPEC, -0.1)
