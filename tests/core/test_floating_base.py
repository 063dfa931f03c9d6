"""The base of a robot in states of MuJoCo, its fall, and distances until it."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.floating_base import Fall, FloatingBase, UntilFall
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError
from facts import refuses

H, DT = 10, 0.1


def states(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 15))
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    return x


def test_velocities_and_gravity_are_those_of_mujoco() -> None:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom size="0.1 0.2 0.3" type="box"/><site name="imu" pos=".1 .2 -.3"/>'
        '<body pos="1 0 0"><joint/><geom size="0.1"/></body></body></worldbody><sensor><velocimeter site="imu"/>'
        '<gyro site="imu"/><framezaxis objtype="xbody" objname="world" reftype="site" refname="imu"/></sensor></mujoco>'
    )
    data, base = mujoco.MjData(model), FloatingBase()
    for x in states(5):
        data.qpos[:], data.qvel[:] = x[:8], x[8:]
        mujoco.mj_forward(model, data)
        assert base.linear_velocity(x, (0.1, 0.2, -0.3)) == pytest.approx(data.sensordata[:3])
        assert base.angular_velocity(x) == pytest.approx(data.sensordata[3:6])
        assert base.gravity(x) == pytest.approx(-data.sensordata[6:9])
        assert base.height(x) == x[2]
    whole = states(6).reshape(2, 3, 15)
    assert base.linear_velocity(whole)[1, 2] == pytest.approx(base.linear_velocity(whole[1, 2]))


def test_places_of_other_bases() -> None:
    x = states(3)
    assert FloatingBase(velocity=8).first_velocity(np.zeros(17)) == 8
    still = FloatingBase().at_rest(x)
    assert np.array_equal(still[:, :8], x[:, :8])
    assert not still[:, 8:].any()
    planar = FloatingBase("planar")
    assert planar.tilt(np.array([0.0, 1.2, -0.3, 0.0, 0.0, 0.0])) == pytest.approx(0.3)
    assert not planar.at_rest(np.ones(6))[3:].any()
    with refuses(ShapeError, "15"):
        planar.first_velocity(x)
    with refuses(InputError, "planar"):
        planar.quaternion(x)
    with refuses(InputError, "fall"):
        Fall()


def dropped(speed: float) -> Trajectory:
    """Return a base that sinks with a speed while it moves along x with 1 m/s."""
    x = np.zeros((H + 1, 13))
    t = DT * np.arange(H + 1)
    x[:, 0], x[:, 2], x[:, 3], x[:, 7], x[:, 9] = t, 1.0 - speed * t, 1.0, 1.0, -speed
    return Trajectory(t, x, np.zeros((H, 1)))


def test_a_robot_lies_still_from_its_fall_on() -> None:
    fall, run = Fall(height=0.55), dropped(1.0)
    assert fall.seconds(run) == pytest.approx(0.5)
    assert fall.seconds(dropped(0.1)) is None
    lying = fall.lying(run, run.times)
    assert np.array_equal(lying.states[:5], run.states[:5])
    assert (lying.states[5:, :7] == run.states[5, :7]).all()
    assert not lying.states[5:, 7:].any()
    both = Trajectory(run.times, np.stack([run.states, dropped(0.1).states]), np.zeros((2, H, 1)))
    assert fall.steps(both).tolist() == [5, H + 1]
    batch = fall.lying(both, run.times)
    assert np.array_equal(batch.states[0], lying.states)
    assert np.array_equal(batch.states[1], both.states[1])
    cut = fall.lying(run.first(5), run.times)
    assert np.array_equal(cut.states, lying.states)


def test_a_tilt_is_a_fall() -> None:
    x = np.zeros((3, 13))
    angles = np.array([0.0, 0.9, 1.1])
    x[:, 3], x[:, 4] = np.cos(angles / 2), np.sin(angles / 2)
    assert Fall(tilt=1.0)(x).tolist() == [False, False, True]


def test_the_distance_until_a_fall_has_the_options_of_the_distance() -> None:
    distance = UntilFall(distances.FinalState(components=["z"]), Fall(height=0.55)).with_states(tuple("xyz"))
    assert distance.components == (2,)
    task = Task(np.zeros(13), horizon=H, dt=DT)
    assert distance(dropped(0.1), dropped(1.0), task) == pytest.approx(0.4)
    assert distance.error(dropped(0.1), dropped(1.0), task) == pytest.approx([-0.4])
    assert not hasattr(UntilFall(distances.MaximumDeviation(), distance.fall), "error")
    assert pickle.loads(pickle.dumps(distance)) == distance


class Sinking:
    """A robot that sinks with a speed; a simulator may stop at the fall."""

    def __init__(self, factor: float, stops: bool) -> None:
        self.factor, self.stops = factor, stops

    def execute(self, controller: Any, task: Task) -> Trajectory:
        x = [np.array(task.initial_state)]
        for _ in range(H):
            x.append(sink(self.factor)(x[-1], np.zeros(1)))
            if self.stops and x[-1][2] < 0.55:
                ended = "terminated: the environment ended the episode"
                return Trajectory(task.times[: len(x)], np.array(x), np.zeros((len(x) - 1, 1)), ended)
        return Trajectory(task.times, np.array(x), np.zeros((H, 1)))


def sink(factor: float) -> Any:
    def step(x: Array, u: Array) -> Array:
        moved = np.array(x)
        moved[..., 2] += factor * DT * x[..., 9]
        return moved

    return step


class Falling(controllers.Policy):
    fall = Fall(height=0.55)


@pytest.mark.parametrize("stops", [True, False])
def test_a_fall_of_s_alone_has_a_distance_and_is_said(stops: bool, tmp_path: Path) -> None:
    start = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    parts = Validation(
        space=TaskSpace(speed=(0.2, 0.44, "m/s")),
        task=lambda p: Task([*start, -p.speed, 0.0, 0.0, 0.0], horizon=H, dt=DT),
        system=Sinking(1.3, stops),
        model=models.Function(sink(1.0), vectorized=True),
        synthesizer=Falling(lambda t, x, task: 0 * x[..., :1]),
        distance=distances.FinalState(components=[2]),
    )
    campaign = Campaign(parts, store=tmp_path / "a.sqlite").run(4, explore=True)
    assert not campaign.failed
    for trial in campaign.completed:
        speed = float(trial.parameters["speed"])  # type: ignore[arg-type]
        step = int(np.ceil(0.45 / (0.13 * speed) - 1e-9))
        of_system = 1 - 0.13 * speed * min(step, H)
        assert trial.distance == pytest.approx(abs(of_system - (1 - speed)))
        fell = trial.note.falls
        assert (fell is not None) == (step <= H)
        if fell is not None:
            assert fell.model is None
            assert fell.system == pytest.approx(step * DT)
    assert any(trial.note.falls for trial in campaign.completed)
    again = Campaign(parts, store=tmp_path / "a.sqlite")
    assert again.trials.distances.tolist() == campaign.trials.distances.tolist()
    assert again.run(6, explore=True).executions == 6
    assert parts.with_parts(distance=parts.distance).distance == parts.distance


def test_a_fall_of_m_is_known_from_its_plan() -> None:
    parts = Validation(
        space=TaskSpace(speed=(0.5, 1.0, "m/s")),
        task=lambda p: Task([0, 0, 1, 1, 0, 0, 0, 0, 0, -p.speed, 0, 0, 0], horizon=H, dt=DT),
        system=systems.Simulated(sink(0.5), vectorized=True),
        model=models.Function(sink(1.0), vectorized=True),
        synthesizer=Falling(lambda t, x, task: 0 * x[..., :1]),
        distance=distances.FinalState(components=[2]),
    )
    assert parts.falls(parts.plan([0.8]).model_trajectory)
    outcome = parts.outcome([0.8])
    assert not parts.falls(outcome.system_trajectory)
    assert outcome.distance == pytest.approx(abs(0.6 - 0.52))
    assert parts.distances(np.array([[0.8], [0.9]]))[0] == pytest.approx(outcome.distance)
