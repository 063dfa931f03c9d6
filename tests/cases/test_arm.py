"""The arm: its kinematics, its data, its three models, and what the case says of itself."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import cases, models, testing
from ctxval.cases import arm
from ctxval.errors import UnknownNameError

SMALL = arm.Settings(horizon=20, rollouts=60, points=60, restarts=1, training=60, iterations=5)


def test_the_end_effector_is_where_the_angles_put_it() -> None:
    data = arm.record(arm.arm(SMALL), SMALL, seed=3)
    first, both = data.x_next[:, 0], data.x_next[:, 0] + data.x_next[:, 1]
    y = 0.1 * np.cos(first) + 0.11 * np.cos(both)
    z = 0.1 * np.sin(first) + 0.11 * np.sin(both)
    np.testing.assert_allclose(data.x_next[:, 4:], np.stack([y, z], axis=1), atol=1e-12)


def test_all_models_learn_from_the_same_data_and_other_seeds_from_other() -> None:
    linear, gaussian = (arm.experiment(2, name, SMALL).validation.model for name in ("linear", "gp"))
    assert isinstance(linear, models.Linear)
    assert isinstance(gaussian, models.GaussianProcessModel)
    assert linear.data is not None
    np.testing.assert_array_equal(linear.data.x_next, gaussian.data.x_next)
    assert not np.array_equal(linear.data.u, arm.record(arm.arm(SMALL), SMALL, seed=4).u)


@pytest.mark.parametrize("name", arm.MODELS)
def test_every_model_conforms_and_its_closed_loops_run(name: str) -> None:
    validation = arm.experiment(0, name, SMALL).validation
    testing.check_model(validation.model, states=6, inputs=2, scale=0.1)
    points = validation.space.iid(4, np.random.default_rng(0))
    batch = validation.distances(points)
    assert np.isfinite(batch).all()
    single = [validation.outcome(point).distance for point in points]
    np.testing.assert_allclose(batch, single, rtol=1e-6, atol=1e-9)


def test_the_arm_starts_extended_and_at_rest() -> None:
    validation = arm.experiment(0, "linear", SMALL).validation
    task = validation.task(validation.space.parameters([0.1, -0.05]))
    np.testing.assert_allclose(task.initial_state, [0, 0, 0, 0, 0.21, 0], atol=1e-12)
    np.testing.assert_array_equal(task.goal[4:], [0.1, -0.05])


def test_the_truth_is_not_below_what_any_task_shows() -> None:
    experiment = arm.experiment(0, "linear", SMALL)
    assert experiment.truth is not None
    points = experiment.validation.space.iid(200, np.random.default_rng(1))
    assert experiment.truth().distance >= experiment.validation.distances(points).max()


def test_both_aspects_are_measured_from_the_target() -> None:
    found = arm.aspects(0, "linear", SMALL, per_axis=3)
    assert found.targets.shape == (9, 2)
    assert found.model_error.shape == found.system_error.shape == (9,)
    validation = arm.experiment(0, "linear", SMALL).validation
    outcome = validation.outcome(found.targets[0])
    miss = np.linalg.norm(outcome.system_trajectory.final_state[4:] - found.targets[0])
    assert found.system_error[0] == pytest.approx(miss, rel=1e-6)


def test_an_unknown_model_is_named_with_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'linear'"):
        cases.by_name("arm", model="liner")
