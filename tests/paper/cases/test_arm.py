"""The arm: Reacher's physics, three models of one set of data, and the two aspects of Remark 1."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from ctxval import Campaign, Experiment, Validation, cases, distances, grid_truth, searches
from ctxval._util.arrays import Array
from ctxval._util.describe import describe, first_difference
from ctxval.errors import UnknownNameError
from ctxval.paper.cases import arm
from facts import refuses
from rig_thorough import more

SMALL = arm.Settings(rollouts=100, points=150, restarts=1, training=150)
"""Enough to learn from, in a second."""


@pytest.fixture(scope="module", params=arm.MODELS)
def experiment(request: pytest.FixtureRequest) -> Experiment:
    return arm.experiment(1, request.param, SMALL)


@pytest.fixture(scope="module")
def aspects() -> dict[str, arm.Aspects]:
    return {model: arm.aspects(1, model, SMALL, per_axis=5) for model in arm.MODELS}


def fingertip(angles: Array) -> Array:
    """Return (y, z) of joint angles ``(..., 2)`` for links of 0.1 m and 0.11 m."""
    first, both = angles[..., 0], angles.sum(axis=-1)
    return np.stack([0.1 * np.cos(first) + 0.11 * np.cos(both), 0.1 * np.sin(first) + 0.11 * np.sin(both)], axis=-1)


# The arm


def test_its_physics_are_those_of_gymnasiums_reacher() -> None:
    spec = importlib.util.find_spec("gymnasium")
    assert spec is not None
    assert spec.origin is not None
    reacher = mujoco.MjModel.from_xml_path(str(Path(spec.origin).parent / "envs/mujoco/assets/reacher.xml"))
    own = mujoco.MjModel.from_xml_string(arm.MJCF)
    assert own.opt.timestep == reacher.opt.timestep
    assert own.opt.integrator == reacher.opt.integrator
    for name in ("dof_armature", "dof_damping"):
        np.testing.assert_array_equal(getattr(own, name), getattr(reacher, name)[:2])
    np.testing.assert_array_equal(own.jnt_range[1], reacher.jnt_range[1])
    np.testing.assert_array_equal(own.jnt_limited, reacher.jnt_limited[:2])
    np.testing.assert_array_equal(own.actuator_gear, reacher.actuator_gear)
    np.testing.assert_array_equal(own.actuator_ctrlrange, reacher.actuator_ctrlrange)
    # Reacher's fingertip is a body of its own.
    masses = [reacher.body("body0").mass, reacher.body("body1").mass + reacher.body("fingertip").mass]
    np.testing.assert_allclose(own.body_mass[1:], np.ravel(masses), rtol=1e-12)


def test_it_moves_as_gymnasiums_reacher() -> None:
    spec = importlib.util.find_spec("gymnasium")
    assert spec is not None
    assert spec.origin is not None
    reacher = mujoco.MjModel.from_xml_path(str(Path(spec.origin).parent / "envs/mujoco/assets/reacher.xml"))
    own = mujoco.MjModel.from_xml_string(arm.MJCF)
    ours, theirs = mujoco.MjData(own), mujoco.MjData(reacher)
    rng = np.random.default_rng(0)
    for _ in range(100):
        ours.ctrl[:] = theirs.ctrl[:] = rng.uniform(-0.3, 0.3, 2)
        mujoco.mj_step(own, ours)
        mujoco.mj_step(reacher, theirs)
    np.testing.assert_allclose(ours.qpos, theirs.qpos[:2], rtol=0, atol=1e-9)
    mujoco.mj_kinematics(own, ours)
    mujoco.mj_kinematics(reacher, theirs)
    np.testing.assert_allclose(ours.site("fingertip").xpos, theirs.body("fingertip").xpos, rtol=0, atol=1e-9)


def test_the_end_effector_is_where_the_forward_kinematics_puts_it(experiment: Experiment) -> None:
    validation = experiment.validation
    outcome = validation.outcome([0.1, 0.05])
    states = outcome.system_trajectory.states
    np.testing.assert_allclose(states[:, 4:], fingertip(states[:, :2]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(states[0], [0, 0, 0, 0, 0.21, 0], rtol=0, atol=1e-15)


def test_every_target_is_within_reach_and_clear_of_the_stops() -> None:
    settings = arm.Settings()
    y, z = np.meshgrid(np.linspace(*settings.y, 50), np.linspace(*settings.z, 50))
    radius = np.hypot(y, z)
    assert radius.max() < 0.21
    assert radius.min() > np.linalg.norm(fingertip(np.array([0.0, 3.0])))


# The data and the models


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *more(1, 2, 3, 4)])
def test_the_recordings_hardly_meet_the_stops(seed: int) -> None:
    settings = arm.Settings()
    data = arm.record(arm.arm(settings), settings, seed)
    assert len(data) == 2000
    assert np.mean(np.abs(data.x_next[:, 1]) > 3.0) < 0.01
    assert np.abs(data.u).max() <= settings.torque


def test_all_models_of_a_seed_learn_from_the_same_data() -> None:
    learned = [arm.experiment(3, model, SMALL).validation.model.data for model in arm.MODELS]
    other = arm.experiment(4, "linear", SMALL).validation.model.data
    for data in learned[1:]:
        np.testing.assert_array_equal(data.x, learned[0].x)
        np.testing.assert_array_equal(data.u, learned[0].u)
    assert not np.allclose(other.u, learned[0].u)


def test_the_same_seed_gives_the_same_experiment(experiment: Experiment) -> None:
    model = experiment.name.removeprefix("arm-")
    again, other = (arm.experiment(seed, model, SMALL).validation for seed in (1, 2))
    assert first_difference(experiment.validation.describe(), again.describe()) is None
    assert len(json.dumps(describe(experiment.validation))) < 5000
    x, u = again.model.data.x[:5], again.model.data.u[:5]
    np.testing.assert_array_equal(again.model.step(x, u), experiment.validation.model.step(x, u))
    assert not np.allclose(other.model.step(x, u), experiment.validation.model.step(x, u))


def test_the_command_line_knows_it() -> None:
    case = cases.by_name("arm", 1, model="linear", settings=SMALL)
    assert (case.name, case.units, case.budget, case.threshold) == ("arm-linear", "m", 50, 0.03)
    assert case.validation.space.names == ("y", "z")
    assert len(case.states) == 6
    assert len(case.inputs) == 2
    with refuses(UnknownNameError, "linear", "model"):
        cases.by_name("arm", model="linea")


# The validation


def test_a_batch_of_tasks_gives_what_each_gives_alone(experiment: Experiment) -> None:
    validation = experiment.validation
    points = validation.space.grid(3)
    alone = [validation.outcome(point).distance for point in points]
    # The network's kinks let rounding decide which way iLQR takes, seldom and by little.
    tolerance = 1e-6 if experiment.name == "arm-fnn" else 1e-9
    np.testing.assert_allclose(validation.distances(points), alone, rtol=0, atol=tolerance)


def test_the_grid_finds_a_distance_that_is_attained(experiment: Experiment) -> None:
    truth = grid_truth(experiment.validation, per_axis=5, refinements=0)
    assert experiment.validation.outcome(truth.parameters.points).distance == pytest.approx(truth.distance, abs=1e-6)
    assert experiment.truth is not None


@pytest.mark.parametrize("experiment", ["linear", *more("gp", "fnn")], indirect=True)
def test_a_campaign_runs_on_it(experiment: Experiment) -> None:
    campaign = Campaign(experiment.validation, search=searches.GPUCB(), seed=0).run(7)
    assert len(campaign.completed) == 7
    assert campaign.worst is not None


# The two aspects


@pytest.mark.slow
@pytest.mark.thorough
def test_aspects_are_the_distances_to_the_targets(aspects: dict[str, arm.Aspects]) -> None:
    whole = arm.experiment(1, "gp", SMALL).validation
    to_goal = Validation(
        space=whole.space,
        task=whole.task,
        system=whole.system,
        model=whole.model,
        synthesizer=whole.synthesizer,
        distance=distances.GoalError(norm=2, components=arm.END_EFFECTOR),
    )
    found = aspects["gp"]
    np.testing.assert_allclose(to_goal.distances(found.targets), found.system_error, rtol=0, atol=1e-9)
    nominal = np.array([whole.plan(target).model_trajectory.final_state[4:] for target in found.targets[:5]])
    np.testing.assert_allclose(
        np.linalg.norm(nominal - found.targets[:5], axis=1), found.model_error[:5], rtol=0, atol=1e-9
    )
    # By the triangle inequality the distance of the campaign is within the sum of the two.
    assert (whole.distances(found.targets) <= found.model_error + found.system_error + 1e-12).all()
    assert str(found).startswith("model 0.0")


def test_the_gaussian_process_does_the_tasks_and_the_linear_model_does_not(aspects: dict[str, arm.Aspects]) -> None:
    assert np.median(aspects["gp"].model_error) < 0.02
    assert np.median(aspects["gp"].system_error) < 0.02
    for error in (aspects["linear"].model_error, aspects["linear"].system_error, aspects["fnn"].model_error):
        assert np.median(error) > 0.02


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, *more(1)])
def test_the_gaussian_process_mimics_the_arm_best_and_the_linear_model_worst(seed: int) -> None:
    settings = replace(arm.Settings(), restarts=1, training=300)
    largest = {}
    for model in arm.MODELS:
        validation = arm.experiment(seed, model, settings).validation
        largest[model] = validation.distances(validation.space.grid(5)).max()
    assert largest["gp"] < largest["fnn"] < largest["linear"]
