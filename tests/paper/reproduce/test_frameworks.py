"""The four frameworks of the paper's Example 1."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Validation, distances
from ctxval.paper.cases import pendulum
from ctxval.paper.reproduce.frameworks import frameworks


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
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


def test_the_closed_loop_profiles_are_the_distances_of_validations(result: dict[str, Any]) -> None:
    goals = np.array(result["goals"])[:, None]
    for name, distance in (("ccdt", distances.WholeTrajectory()), ("custom", distances.FinalState(norm=1))):
        np.testing.assert_allclose(result[name], with_distance(distance).distances(goals), rtol=1e-9)


def test_ccdt_is_largest_at_the_goal_farthest_from_the_start_as_in_the_paper(result: dict[str, Any]) -> None:
    goals = result["goals"]
    assert abs(goals[int(np.argmax(result["ccdt"]))]) <= 1.01 * (goals[1] - goals[0])  # the grid is coarse


def test_open_loop_distances_are_far_larger_than_closed_loop_ones_and_have_converged(result: dict[str, Any]) -> None:
    assert result["bound"] == pendulum.Settings().torque < result["closed_loop_torque"]
    for open_loop, closed_loop in (("oldt", "ccdt"), ("olcd", "custom")):
        assert result[open_loop][0] > 10 * max(result[closed_loop])
        assert len(result[open_loop]) == 4
        assert result[open_loop][-1] == pytest.approx(result[open_loop][0], rel=1e-6)
