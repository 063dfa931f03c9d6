"""The MuJoCo adapter against MuJoCo's own integrator, closed forms and physics."""

from __future__ import annotations

import os
import pickle
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, searches, systems, testing
from ctxval._util.arrays import Array
from ctxval._util.describe import describe, first_difference
from ctxval.errors import InputError, ShapeError, UnknownNameError
from facts import assert_names, refuses

ARM = """
<mujoco>
  <option timestep="0.01" integrator="RK4"/>
  <default><joint type="hinge" axis="0 0 1" damping="0.01"/><geom type="capsule" size="0.01" contype="0"/></default>
  <worldbody>
    <body><joint name="joint0"/><geom fromto="0 0 0 0.3 0 0"/><site name="elbow" pos="0.3 0 0"/>
      <body pos="0.3 0 0"><joint name="joint1" limited="true" range="-60 60"/><geom fromto="0 0 0 0.2 0 0"/>
        <site name="tip" pos="0.2 0 0"/></body></body>
  </worldbody>
  <actuator><motor joint="joint0" gear="0.2"/><motor joint="joint1" gear="0.2"/></actuator>
</mujoco>
"""

# A ball above a table and a pusher: contacts, a free joint, an actuator with a state of its own.
BALL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.12"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body>
    <body pos="-0.3 0 0.1"><joint name="push" type="slide" axis="1 0 0" damping="1"/>
      <geom type="box" size="0.1 0.1 0.05" mass="1"/><site name="hand"/></body>
  </worldbody>
  <actuator><general joint="push" dyntype="filter" dynprm="0.05" gainprm="20"/></actuator>
</mujoco>
"""

# A hinge that is pushed away from its middle until it diverges.
UNSTABLE = """
<mujoco>
  <option timestep="0.05"/>
  <worldbody><body><joint name="j" axis="0 1 0" stiffness="-1e5"/><geom size="0.1" mass="1"/></body></worldbody>
  <actuator><motor joint="j"/></actuator>
</mujoco>
"""

PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody><body><joint axis="0 1 0"/><inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.1"/></body></worldbody>
</mujoco>
"""


def feedback(t: int, x: Array) -> Array:
    """Damp the joints and wobble, so that the inputs depend on states and time."""
    return -0.3 * x[..., 2:4] - 0.5 * x[..., :2] + np.sin(0.3 * t)


def push(t: int, x: Array) -> Array:
    return np.clip(4 * (0.5 - x[..., 7:8]) - x[..., 14:15], -1, 1)


def bare_loop(xml: str, substeps: int, controller: Any, task: Task, sites: tuple[str, ...]) -> Array:
    """Return the states of one closed loop written on MuJoCo alone."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    x = task.initial_state
    data.qpos[:], data.qvel[:] = x[: model.nq], x[model.nq : model.nq + model.nv]
    states = [np.array(x)]
    for t in range(task.horizon):
        data.ctrl[:] = controller(t, states[-1])
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        tips = [data.site(site).xpos[:2] for site in sites]
        states.append(np.concatenate([data.qpos, data.qvel, *tips]))
    return np.array(states)


@pytest.fixture
def arm() -> systems.MuJoCo:
    return systems.MuJoCo(ARM, substeps=2, sites=("tip",))


def arm_task(arm: systems.MuJoCo, count: int = 5, horizon: int = 40) -> Task:
    """Return tasks from random states, some of which run into the joint's limit."""
    rng = np.random.default_rng(0)
    states = arm.state(rng.uniform(-1, 1, (count, 2)), rng.uniform(-3, 3, (count, 2)))
    return Task(states, horizon=horizon, dt=0.02)


# Against MuJoCo's own integrator


def test_one_closed_loop_is_what_a_plain_loop_of_mj_step_does(arm: systems.MuJoCo) -> None:
    for index in range(5):
        task = arm_task(arm)[index]
        trajectory = arm.execute(feedback, task)
        assert trajectory.ended == "complete"
        np.testing.assert_allclose(trajectory.states, bare_loop(ARM, 2, feedback, task, ("tip",)), rtol=0, atol=1e-12)


def test_contacts_and_actuator_states_are_carried_over_from_step_to_step() -> None:
    system = systems.MuJoCo(BALL, substeps=4, sites=("hand",))
    task = Task(system.state([0, 0, 0.12, 1, 0, 0, 0, 0]), horizon=40, dt=0.02)
    expected = bare_loop(BALL, 4, push, task, ("hand",))
    assert expected[-1, 0] > 0.05  # the ball was hit
    np.testing.assert_allclose(system.execute(push, task).states, expected, rtol=0, atol=1e-12)


def test_a_batch_does_what_its_tasks_do_alone(arm: systems.MuJoCo) -> None:
    task = arm_task(arm)
    batch = arm.execute(feedback, task)
    assert batch.states.shape == (5, 41, 6)
    assert batch.inputs.shape == (5, 40, 2)
    for index in range(5):
        np.testing.assert_array_equal(batch[index].states, arm.execute(feedback, task[index]).states)


def test_threads_change_nothing(arm: systems.MuJoCo) -> None:
    task = arm_task(arm, count=64)
    threaded = systems.MuJoCo(ARM, substeps=2, sites=("tip",), threads=2)
    np.testing.assert_array_equal(threaded.execute(feedback, task).states, arm.execute(feedback, task).states)


def test_batches_of_several_axes_keep_their_shape(arm: systems.MuJoCo) -> None:
    flat = arm_task(arm, count=6)
    task = Task(flat.initial_state.reshape(2, 3, 6), horizon=40, dt=0.02)
    states = arm.execute(feedback, task).states
    assert states.shape == (2, 3, 41, 6)
    np.testing.assert_array_equal(states.reshape(6, 41, 6), arm.execute(feedback, flat).states)


def test_it_keeps_the_contract_of_a_system(arm: systems.MuJoCo) -> None:
    testing.check_system(arm, feedback, arm_task(arm)[0])


def test_a_controller_with_memory_begins_anew_in_every_execution(arm: systems.MuJoCo) -> None:
    tasks = arm_task(arm)
    pid = controllers.PID([1.0, 1.0], [0.5, 0.5], [0.1, 0.1], components=(0, 1), limits=0.5)
    model = models.Linear(np.eye(6), np.zeros((6, 2)))
    testing.check_system(arm, pid.design(tasks[0], model), tasks[0])
    batch = arm.execute(pid.design(tasks, model), tasks)
    for index in range(5):
        alone = arm.execute(pid.design(tasks[index], model), tasks[index])
        np.testing.assert_allclose(batch[index].states, alone.states, rtol=0, atol=1e-12)


# Kinematics and physics


def test_sites_are_where_the_forward_kinematics_puts_them() -> None:
    system = systems.MuJoCo(ARM, substeps=2, sites=("tip", "elbow"), axes="xyz")
    rng = np.random.default_rng(1)
    q = rng.uniform(-1, 1, (7, 2))
    task = Task(system.state(q), horizon=10, dt=0.02)
    states = system.execute(feedback, task).states
    first, both = states[..., 0], states[..., 0] + states[..., 1]
    elbow = np.stack([0.3 * np.cos(first), 0.3 * np.sin(first), 0 * first], axis=-1)
    tip = elbow + np.stack([0.2 * np.cos(both), 0.2 * np.sin(both), 0 * both], axis=-1)
    np.testing.assert_allclose(states[..., 4:7], tip, rtol=0, atol=1e-12)
    np.testing.assert_allclose(states[..., 7:], elbow, rtol=0, atol=1e-12)


def test_a_frictionless_pendulum_keeps_its_energy_and_falls_as_the_ode_says() -> None:
    system = systems.MuJoCo(PENDULUM, substeps=5)
    task = Task(system.state([2.0]), horizon=200, dt=0.01)
    states = system.execute(lambda t, x: np.zeros((*x.shape[:-1], 0)), task).states
    inertia, weight = 0.1 + 2 * 0.5**2, 2 * 9.81 * 0.5
    energy = 0.5 * inertia * states[:, 1] ** 2 - weight * np.cos(states[:, 0])
    np.testing.assert_allclose(energy, energy[0], rtol=0, atol=1e-6)
    step = systems.rk4(lambda x, u: np.stack([x[..., 1], -weight / inertia * np.sin(x[..., 0])], axis=-1), 0.01)
    x = states[0]
    for t in range(200):
        x = step(x, np.zeros(0))
        np.testing.assert_allclose(states[t + 1], x, rtol=0, atol=1e-4)


# Failures


def test_a_diverging_simulation_is_told_from_a_healthy_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings into the working directory
    system = systems.MuJoCo(UNSTABLE)
    task = Task(system.state([[0.0], [0.1], [0.0]]), horizon=30, dt=0.05)
    trajectory = system.execute(lambda t, x: np.zeros((*x.shape[:-1], 1)), task)
    assert_names(trajectory.ended, "MuJoCo", "BADQACC", 2)
    assert trajectory.finite.tolist() == [True, False, True]
    assert np.isnan(trajectory.states[1, 2:]).all()
    alone = system.execute(lambda t, x: np.zeros(1), task[1])
    assert alone.ended == trajectory.ended
    assert system.execute(lambda t, x: np.zeros(1), task[0]).ended == "complete"


def test_an_input_that_is_not_finite_never_becomes_zero(arm: systems.MuJoCo) -> None:
    task = arm_task(arm)

    def broken(t: int, x: Array) -> Array:
        u = feedback(t, x)
        u[2] = np.nan if t == 3 else u[2]
        return u

    trajectory = arm.execute(broken, task)
    assert_names(trajectory.ended, 4)
    assert trajectory.finite.tolist() == [True, True, False, True, True]
    whole = arm.execute(feedback, task)
    np.testing.assert_array_equal(trajectory.states[[0, 1, 3, 4]], whole.states[[0, 1, 3, 4]])


def test_a_diverged_execution_is_a_failed_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    system = systems.MuJoCo(UNSTABLE)
    broken = Validation(
        space=TaskSpace(start=(0.0, 0.2)),
        task=lambda p: Task([p.start, 0.0], horizon=30, dt=0.05),
        system=system,
        model=models.Linear(0.5 * np.eye(2), np.ones((2, 1))),
        synthesizer=controllers.Policy(lambda t, x, task: 0 * x[..., :1]),
        distance=distances.FinalState(),
    )
    assert np.isnan(broken.distances([[0.0], [0.1]])).tolist() == [False, True]
    campaign = Campaign(broken, search=searches.Random()).run(3)
    assert len(campaign.failed) == 3
    for trial in campaign.failed:
        assert_names(str(trial.failure), "BADQACC", 2)


# What the user may get wrong


def test_the_time_step_must_fit(arm: systems.MuJoCo) -> None:
    assert arm.dt == pytest.approx(0.02)
    with refuses(InputError, 0.01, 2, 0.02):
        arm.execute(feedback, Task(np.zeros(6), horizon=3, dt=0.05))


def test_the_shapes_must_fit(arm: systems.MuJoCo) -> None:
    with refuses(ShapeError, 6, 2, 4):
        arm.execute(feedback, Task(np.zeros(4), horizon=3, dt=0.02))
    task = arm_task(arm)
    with refuses(ShapeError, 2, 1):
        arm.execute(lambda t, x: x[..., :1], task)


def test_an_initial_state_must_have_the_sites_where_they_are(arm: systems.MuJoCo) -> None:
    with refuses(InputError, [0.5, 0.0], [0.0, 0.0]):
        arm.execute(feedback, Task(np.zeros(6), horizon=3, dt=0.02))


def test_models_come_from_text_and_from_files(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    for source in (path, str(path)):
        assert first_difference(describe(systems.MuJoCo(source)), describe(systems.MuJoCo(ARM))) is None
    with refuses(InputError, "no.xml"):
        systems.MuJoCo(tmp_path / "no.xml")
    os.mkfifo(tmp_path / "fifo.xml")
    with refuses(InputError, "fifo.xml", "FIFO"):
        systems.MuJoCo(tmp_path / "fifo.xml")
    with refuses(InputError, "XML_ERROR_MISMATCHED_ELEMENT", 14):
        systems.MuJoCo("<mujoco><worldbody><body/></mujoco>")
    with refuses(InputError, "joint1", 1):
        systems.MuJoCo(ARM.replace("joint1", "joint2", 1))


@pytest.mark.parametrize("substeps", [0, -1, 1.5, True])
def test_substeps_are_a_positive_integer(substeps: Any) -> None:
    with refuses(InputError, "substeps"):
        systems.MuJoCo(ARM, substeps=substeps)


def test_sites_and_axes_must_be_known() -> None:
    assert systems.MuJoCo(ARM, sites="tip").sites == ("tip",)
    with refuses(UnknownNameError, "tip"):
        systems.MuJoCo(ARM, sites=("tips",))
    with refuses(InputError, "xyz", "axes"):
        systems.MuJoCo(ARM, sites=("tip",), axes="xw")


def test_without_mujoco_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)  # an import of it fails
    with refuses(InputError, "ctxval[mujoco]"):
        systems.MuJoCo(ARM)


# What a store and other processes see


def test_the_description_tells_models_apart(arm: systems.MuJoCo) -> None:
    same = systems.MuJoCo(ARM, substeps=2, sites=("tip",), threads=2)
    assert first_difference(describe(arm), describe(same)) is None
    heavier = systems.MuJoCo(ARM.replace('size="0.01"', 'size="0.02"'), substeps=2, sites=("tip",))
    assert first_difference(describe(arm), describe(heavier)) is not None
    assert first_difference(describe(arm), describe(systems.MuJoCo(ARM, substeps=2))) is not None


def test_it_can_be_sent_to_another_process(arm: systems.MuJoCo) -> None:
    task = arm_task(arm)
    other = pickle.loads(pickle.dumps(arm))
    np.testing.assert_array_equal(other.execute(feedback, task).states, arm.execute(feedback, task).states)
