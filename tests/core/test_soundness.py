from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import make_validation
from ctxval import Task, Trajectory, controllers, distances
from ctxval.core.soundness import aimed_states, flips, goal_misses, saturation

T = np.linspace(0, 6, 60)[:, None]


def test_controllers_that_turn_the_other_way_flip_and_those_that_only_grow_do_not() -> None:
    points = np.array([[0.50], [0.52], [0.54], [0.9]])
    found = flips(points, [np.sin(T), 1.1 * np.sin(T), -np.sin(T), np.sin(T)])
    assert found is not None
    assert (found.pairs, found.flipped) == (3, 2)
    assert found.example in ((0, 2), (1, 2))
    alike = flips(points, [scale * np.sin(T) for scale in (1.0, 1.1, 1.2, -5.0)])
    assert alike is not None
    assert alike.flipped == 0


def test_a_controller_that_leaves_its_limit_one_step_later_does_not_flip() -> None:
    early, late = np.where(T < 3, 1.0, -1.0), np.where(T < 3.2, 1.0, -1.0)
    found = flips(np.array([[0.5], [0.51]]), [early, late])
    assert found is not None
    assert found.largest == 1.0
    assert found.flipped == 0


def test_tasks_without_neighbours_show_nothing() -> None:
    assert flips(np.array([[0.0], [1.0]]), [T, T]) is None


def test_neighbours_are_nearer_than_a_tenth_of_the_diagonal_in_any_dimension() -> None:
    near = np.stack([np.full(9, 0.5), np.full(9, 0.59)])
    assert flips(near, [T, T]) is not None
    assert flips(np.stack([np.full(9, 0.5), np.full(9, 0.61)]), [T, T]) is None


@given(st.floats(0.1, 100.0), st.floats(-50.0, 50.0))
def test_a_share_at_the_limits_does_not_depend_on_the_units(scale: float, centre: float) -> None:
    u = np.clip(2 * np.sin(T), -1, 1)
    plain = saturation([u], controllers.LQR([1], [1], limits=1.0))
    limits = controllers.Limits(centre - scale, centre + scale)
    scaled = saturation([centre + scale * u], controllers.LQR([1], [1], limits=limits))
    assert plain is not None
    assert scaled is not None
    assert plain.known
    assert plain.shares == pytest.approx(scaled.shares)
    assert plain.shares[0] == pytest.approx(np.mean(np.abs(u) == 1))


def test_limits_that_nobody_states_are_extreme_values_that_repeat() -> None:
    repeated, smooth = saturation([np.clip(2 * np.sin(T), -1, 1)], None), saturation([np.sin(T)], None)
    assert repeated is not None
    assert smooth is not None
    assert not repeated.known
    assert repeated.shares[0] > 0.5
    assert smooth.shares[0] == 0
    assert saturation([np.zeros((5, 0))], None) is None


def test_goals_are_those_of_states_that_are_weighed_and_compared() -> None:
    validation = make_validation(distance=distances.FinalState(components=[1]))
    assert aimed_states(make_validation(), 2).tolist() == [0, 1]
    assert aimed_states(validation, 2).tolist() == [1]
    for components, aimed in (([-1], [1]), ([0, 7], [0]), ([7], [])):
        compared = make_validation(distance=distances.FinalState(components=components))
        assert aimed_states(compared, 2).tolist() == aimed
    # A policy does not tell what it brings to a goal.
    told = validation.with_parts(synthesizer=controllers.Policy(lambda t, x, task: 0 * x[..., :1]))
    assert not len(aimed_states(told, 2))


def test_a_miss_is_a_share_of_the_range_over_all_tasks() -> None:
    times, inputs = np.arange(3.0), np.zeros((2, 1))
    ends = [Trajectory(times, np.array([[0, 0], [end, 0], [end, 0]], dtype=float), inputs) for end in (1.0, 2.0)]
    found = goal_misses(make_validation(), ends, [np.array([1.0, 0.0]), np.array([2.5, 0.0])])
    assert found is not None
    assert found.misses.tolist() == [[0, 0], [0.5, 0]]
    assert found.shares.tolist() == [[0, 0], [0.25, 0]]
    assert found.missed.tolist() == [False, True]
    assert found.worst == (1, 0, 0.5)


def test_only_a_task_that_was_given_a_goal_or_a_reference_has_one() -> None:
    assert not Task([0.0], horizon=2, dt=0.1).has_goal
    assert not Task([np.zeros(3)], horizon=2, dt=0.1)[1].has_goal
    assert Task([0.0], goal=[0.0], horizon=2, dt=0.1).has_goal
    assert Task([np.zeros(3)], goal=[1.0], horizon=2, dt=0.1)[1].has_goal
