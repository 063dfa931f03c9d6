"""The four frameworks of the paper's Example 1."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Validation, distances
from ctxval.cases import pendulum
from ctxval.reproduce import frameworks as module
from ctxval.reproduce.frameworks import Frameworks, frameworks


@pytest.fixture(scope="module")
def result() -> Frameworks:
    return frameworks(0, per_axis=41, restarts=4)


def with_distance(distance: distances.Distance) -> Validation:
    parts = pendulum.experiment(0).validation
    return Validation(
        space=parts.space,
        task=parts.task,
        system=parts.system,
        model=parts.model,
        synthesizer=parts.synthesizer,
        distance=distance,
    )


def test_the_closed_loop_profiles_are_the_distances_of_validations(result: Frameworks) -> None:
    goals = result.goals[:, None]
    np.testing.assert_allclose(result.ccdt, with_distance(distances.WholeTrajectory()).distances(goals), rtol=1e-9)
    np.testing.assert_allclose(result.custom, with_distance(distances.FinalState(norm=1)).distances(goals), rtol=1e-9)


def test_ccdt_is_largest_at_the_goal_farthest_from_the_start_as_in_the_paper(result: Frameworks) -> None:
    assert abs(result.goals[result.ccdt.argmax()]) <= 1.01 * np.diff(result.goals)[0]  # the grid is coarse


def test_open_loop_distances_are_far_larger_than_closed_loop_ones(result: Frameworks) -> None:
    assert result.oldt.distance > 10 * result.ccdt.max()
    assert result.olcd.distance > 10 * result.custom.max()


def test_the_open_loops_stay_within_the_recorded_torques(result: Frameworks) -> None:
    assert result.bound == pendulum.Settings().torque < result.closed_loop_torque
    for worst in (result.oldt, result.olcd):
        assert np.abs(worst.inputs).max() <= result.bound
        assert worst.restarts.shape == (4,)


def test_the_final_sum_of_both_states_is_no_less_than_the_largest_of_them(result: Frameworks) -> None:
    final = np.abs(result.oldt.system_trajectory.final_state - result.oldt.model_trajectory.final_state).sum()
    assert result.olcd.distance >= final * (1 - 1e-9)


def test_a_larger_bound_allows_larger_distances(result: Frameworks) -> None:
    validation = pendulum.experiment(0).validation
    larger = module.open_loop(validation, module.FINAL, 2 * result.bound, restarts=2, seed=0)
    assert larger.distance > result.olcd.distance


def test_the_open_loops_have_converged(result: Frameworks) -> None:
    for worst in (result.oldt, result.olcd):
        assert worst.restarts[-1] == pytest.approx(worst.distance, rel=1e-6)
