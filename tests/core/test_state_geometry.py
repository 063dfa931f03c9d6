"""Orientations are subtracted as rotations and added on the sphere; plain vectors stay as they are."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Trajectory, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval._util.quaternions import product
from ctxval.core.state_geometry import PLAIN, StateGeometry, geometry_of
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, UnknownNameError
from ctxval.learning.dynamics_posterior import learn_posterior
from ctxval.learning.residual_data import InvarianceWarning, residual_data
from ctxval.models import Corrected
from ctxval.models.mujoco import proposed_invariant
from facts import refuses

FREE = StateGeometry((3, 8))  # a free joint, a hinge and a ball joint
MJCF = """<mujoco><option timestep="0.005"/><worldbody><body pos="0 0 1"><freejoint/>
  <geom type="box" size=".2 .1 .05" mass="{mass}"/><body pos=".2 0 0"><joint axis="0 1 0"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".2"/>
  <body pos="0 0 -.3"><joint type="ball"/><geom type="box" size=".1 .05 .02"/></body></body></body>
</worldbody></mujoco>"""


def states(count: int, seed: int = 0) -> Array:
    x = np.random.default_rng(seed).standard_normal((count, 12))
    for w in FREE.quaternions:
        x[:, w : w + 4] /= np.linalg.norm(x[:, w : w + 4], axis=1, keepdims=True)
    return x


def test_a_sum_undoes_a_difference() -> None:
    x, y = states(50), states(50, 1)
    gap = FREE.difference(x, y)
    assert np.array_equal(gap[:, FREE.quaternions], np.zeros((50, 2)))
    again = FREE.add(y, gap)
    assert np.abs(FREE.features(again) - FREE.features(x)).max() < 1e-12
    assert np.abs(np.linalg.norm(again[:, 3:7], axis=1) - 1).max() < 1e-15
    small = 1e-9 * gap
    assert np.abs(FREE.difference(FREE.add(y, small), y) - small).max() < 1e-15
    assert np.array_equal(FREE.difference(x, x), np.zeros((50, 12)))


def test_both_signs_of_a_quaternion_are_one_orientation() -> None:
    x, y = states(50), states(50, 1)
    turned = x.copy()
    turned[:, 3:7] *= -1.0
    assert np.abs(FREE.difference(turned, y) - FREE.difference(x, y)).max() < 1e-14
    assert np.abs(FREE.difference(turned, x)).max() < 1e-15
    assert np.array_equal(FREE.features(turned), FREE.features(x))
    assert np.linalg.norm(FREE.difference(x, y)[:, 4:7], axis=1).max() <= np.pi


def test_leading_axes_broadcast() -> None:
    x, y = states(6).reshape(2, 3, 12), states(1)[0]
    gap = FREE.difference(x, y)
    assert gap.shape == (2, 3, 12)
    assert np.abs(FREE.add(y, gap) - FREE.add(np.broadcast_to(y, gap.shape), gap)).max() == 0
    assert FREE.add(x, np.zeros(12)).shape == (2, 3, 12)


def test_plain_vectors_are_subtracted_and_added() -> None:
    x, y = states(9), states(9, 1)
    assert np.array_equal(PLAIN.difference(x, y), x - y)
    assert np.array_equal(PLAIN.add(x, y), x + y)
    assert PLAIN.features(x) is x


def test_a_mujoco_model_knows_its_joints() -> None:
    pytest.importorskip("mujoco")
    model = models.MuJoCo(MJCF.format(mass=1))
    assert geometry_of(model) == FREE
    assert geometry_of(Corrected(model, lambda x, u: 0 * x)) == FREE  # type: ignore[arg-type]
    assert geometry_of(models.Linear([[1.0]], [[1.0]])) is PLAIN


def test_residuals_of_orientations_are_rotations() -> None:
    """A residual that turns the body by a small angle is found, whatever the signs of the recorded quaternions."""
    pytest.importorskip("mujoco")
    model, rng = models.MuJoCo(MJCF.format(mass=1)), np.random.default_rng(0)
    x = np.concatenate([states(200), 0.3 * rng.standard_normal((200, 10))], axis=1)
    turn = np.zeros(22)
    turn[4:7] = 1e-3, -2e-3, 3e-3
    following = FREE.add(model.step(x, np.zeros((200, 0))), turn)
    signs = rng.choice([-1.0, 1.0], (2, 200, 1))
    x[:, 3:7] *= signs[0]
    following[:, 3:7] *= signs[1]
    data = residual_data(model, Transitions(x, np.zeros((200, 0)), following), np.zeros(200, dtype=np.intp))
    assert data is not None
    assert np.flatnonzero(data.learned).tolist() == [4, 5, 6]
    assert np.abs(data.outputs[:, 4:7] * data.units[4:7] - turn[4:7]).max() < 1e-12
    assert np.array_equal(data.standardised(x, np.zeros((200, 0))), data.pairs)


def run(states: Array) -> Trajectory:
    return Trajectory(np.arange(len(states)) * 0.1, states, np.zeros((len(states) - 1, 0)))


def test_distances_compare_orientations_as_rotations() -> None:
    half = np.pi / 8
    first = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (2, 1))
    turned = np.array([first[0], [0.0, 0.0, 0.3, -np.cos(half), 0.0, -np.sin(half), 0.0]])
    task = Task(first[0], horizon=1, dt=0.1)
    for distance, expected in (
        (distances.MaximumDeviation(), np.hypot(0.3, np.pi / 4)),
        (distances.FinalState(components=[3, 4, 5, 6]), np.pi / 4),
        (distances.AtTimes(times=[0.1], components=[3, 4, 5, 6], scales=[1, 1, 2, 1]), np.pi / 8),
        (distances.WholeTrajectory(norm=2), np.hypot(0.3, np.pi / 4)),
        (distances.RelativeDeviation(components=[3, 4, 5, 6], least=[1, 1, 1, 1]), np.pi / 4),
    ):
        found = distance.with_quaternions((3,))
        assert abs(float(found(run(first), run(turned), task)) - expected) < 1e-12
    assert distances.FinalState(components=[0, 3]).with_quaternions((3,)).quaternions == ()
    assert distances.FinalState(quaternions=["w"]).with_states(list("xyzwabc")).quaternions == (3,)


def test_recorded_quaternions_of_any_sign_are_accepted() -> None:
    """A system whose quaternions jump between q and -q is the same as one whose quaternions do not."""
    pytest.importorskip("mujoco")
    system, mjcf = systems.MuJoCo(MJCF.format(mass=1.2)), MJCF.format(mass=1)

    class Flipping:
        def execute(self, controller: controllers.Policy, task: Task) -> Trajectory:
            run = system.execute(controller, task)
            signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(run.states), 1))
            run.states[:, 3:7] *= signs
            return run

    def validation(of: object) -> Validation:
        return Validation(
            space=TaskSpace(spin=(-2.0, 2.0, "rad/s")),
            task=lambda p: Task(
                [0, 0, 1, 1, 0, 0, 0, 0.2, 1, *[0] * 6, p.spin, 0, 0, 0, 0, 0, 1], horizon=60, dt=0.005
            ),
            system=of,  # type: ignore[arg-type]
            model=models.MuJoCo(mjcf),
            synthesizer=controllers.Policy(lambda t, x, task: np.zeros((*x.shape[:-1], 0))),
            distance=distances.MaximumDeviation(),
        )

    plain, flipping = (validation(each).outcome([0.7]) for each in (system, Flipping()))
    assert plain.distance == flipping.distance > 1e-4
    assert np.array_equal(plain.system_trajectory.states, flipping.system_trajectory.states)


# Invariance

DRONE = """<mujoco><option timestep="0.02"{wind}/><worldbody><body pos="0 0 1"><freejoint/>
  <inertial pos="{offset} 0 0" mass="1" diaginertia="0.02 0.03 0.04"/><site name="hub"/></body></worldbody>
  <actuator><motor site="hub" gear="0 0 1 0 0 0"/><motor site="hub" gear="0 0 0 0 1 0"/></actuator></mujoco>"""
ELSEWHERE = ["x", "y", "yaw"]


def elsewhere(x: Array, angle: float) -> Array:
    """Return states (N, 13) of a free joint at another place, turned about the vertical axis."""
    moved, turn = np.array(x), np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved[:, :2] = x[:, :2] @ turn.T + [3.0, -2.0]
    moved[:, 7:9] = x[:, 7:9] @ turn.T
    half = np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
    moved[:, 3:7] = product(np.broadcast_to(half, x[:, 3:7].shape), x[:, 3:7])
    return moved


def flights(count: int, yaw: float, seed: int = 0) -> tuple[Array, Array]:
    """Return states and inputs of a drone that heads to about one yaw angle."""
    rng = np.random.default_rng(seed)
    x = np.concatenate(
        [rng.normal(size=(count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)), rng.normal(size=(count, 6))], 1
    )
    turn = np.concatenate([np.zeros((count, 4)), 0.2 * rng.normal(size=(count, 2)), np.zeros((count, 7))], axis=1)
    return elsewhere(StateGeometry((3,)).add(x, turn), yaw), rng.normal([9.81, 0.0], [3.0, 0.3], (count, 2))


def test_features_and_what_is_missed_do_not_change_elsewhere() -> None:
    pytest.importorskip("mujoco")
    model = models.MuJoCo(DRONE.format(offset=0, wind=""), invariant=ELSEWHERE)
    geometry = geometry_of(model)
    assert geometry == StateGeometry((3,), (0, 1), (0, 7))
    x, u = flights(50, 0.0)
    for angle in (0.0, 1.0, 3.0, -2.5):
        there = elsewhere(x, angle)
        assert np.abs(geometry.features(there) - geometry.features(x)).max() < 1e-12
        reached, predicted = x + 0.01, model.step(x, u)
        missed = geometry.missed(reached, predicted, x)
        assert np.abs(geometry.missed(elsewhere(reached, angle), model.step(there, u), there) - missed).max() < 1e-12
        again = geometry.corrected(model.step(there, u), missed, there)
        assert np.abs(geometry.difference(again, elsewhere(reached, angle))).max() < 1e-12
    assert not geometry.features(x)[:, :2].any()


def test_what_was_learned_at_one_yaw_holds_at_another() -> None:
    """A drone with a centre of mass elsewhere: its error at yaw 2.5 is predicted from flights at yaw 0."""
    pytest.importorskip("mujoco")
    system, left = models.MuJoCo(DRONE.format(offset=0.05, wind="")), []
    for invariant in (ELSEWHERE, []):
        model = models.MuJoCo(DRONE.format(offset=0, wind=""), invariant=invariant)
        x, u = flights(150, 0.0)
        posterior = learn_posterior(model, Transitions(x, u, system.step(x, u)), np.zeros(150, dtype=np.intp))
        assert posterior is not None
        assert posterior.data.recorded[:, :2].any() == (not invariant)  # so records need not cover places
        x, u = flights(60, 2.5, 1)
        geometry, reached = StateGeometry((3,)), system.step(x, u)
        errors = [geometry.difference(reached, each.step(x, u)) for each in (posterior.mean, model)]
        left.append(np.sqrt((errors[0] ** 2).sum() / (errors[1] ** 2).sum()))
    assert left[0] < 0.01 < 0.1 < left[1]


def test_executions_may_contradict_invariance() -> None:
    """Wind blows in one direction of the world, so that the error depends on where the drone heads."""
    pytest.importorskip("mujoco")
    system = models.MuJoCo(DRONE.format(offset=0, wind=' gravity="1.5 0 -9.81"'))
    model = models.MuJoCo(DRONE.format(offset=0, wind=""), invariant=ELSEWHERE)
    parts = [flights(40, yaw, k) for k, yaw in enumerate(np.linspace(-3, 3, 5))]
    x, u = (np.concatenate(each) for each in zip(*parts, strict=True))
    with pytest.warns(InvarianceWarning):
        posterior = learn_posterior(model, Transitions(x, u, system.step(x, u)), np.zeros(200, dtype=np.intp))
    assert posterior is not None
    assert posterior.data.geometry == StateGeometry((3,))


def test_invariant_states_are_named() -> None:
    pytest.importorskip("mujoco")
    assert geometry_of(models.MuJoCo(DRONE.format(offset=0, wind=""), invariant=["y"])).invariant == (1,)
    plane = '<worldbody><geom type="plane" size="1 1 1" euler="{} 0 0"/>'
    for tilt, proposed in ((0, ("x", "y", "yaw")), (5, ())):
        ground = DRONE.format(offset=0, wind="").replace("<worldbody>", plane.format(tilt))
        assert proposed_invariant(models.MuJoCo(ground).compiled) == proposed
    assert proposed_invariant(models.MuJoCo(DRONE.format(offset=0, wind=' gravity="1 0 -9"')).compiled) == ()
    rail = DRONE.replace("<freejoint/>", '<joint name="rail" type="slide"/>').format(offset=0, wind="")
    assert geometry_of(models.MuJoCo(rail, invariant=["rail"])) == StateGeometry(invariant=(0,))
    with refuses(UnknownNameError, "x", "rail"):
        models.MuJoCo(rail, invariant=["x"])
    with refuses(InputError, "yaw"):
        models.MuJoCo(DRONE.format(offset=0, wind=""), invariant=["yaw"])
    with refuses(InputError, "sites"):
        models.MuJoCo(DRONE.format(offset=0, wind=""), invariant=["x", "y"], sites="hub")
