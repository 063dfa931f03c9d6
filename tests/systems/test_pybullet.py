"""PyBullet against MuJoCo, which integrates the same equations: joints, free bases, springs, actuators, contacts."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, systems, testing
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from ctxval.errors import InputError, ShapeError
from facts import refuses

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'ctxval[pybullet]'")

# Joints of one body with anchors, a reference, a spring and limits; a servo and a motor with gears and ranges.
ARM = """<mujoco><option timestep="0.001" gravity="1 0 -9.8"/><default><geom contype="0" conaffinity="0"/></default>
<worldbody><body pos=".1 .2 .3" euler="10 20 30"><joint name="rail" type="slide" axis="1 0 0" pos=".1 0 0" damping="1"/>
  <joint name="turn" axis="0 0 1" pos=".1 .2 0" ref="20" stiffness="3" springref="5"/>
  <geom type="box" size=".1 .2 .3" mass="1" pos=".1 .1 .1" euler="0 90 30"/>
  <body pos=".2 0 .1" euler="0 40 0"><joint name="elbow" axis="1 1 0" damping=".1"/>
    <geom type="capsule" size=".05" fromto="0 0 0 .3 .1 .2" mass="2"/>
    <body euler="90 0 0" pos="0 .1 0"><geom type="sphere" size=".1" pos=".2 0 0"/></body></body></body></worldbody>
<actuator><position joint="elbow" kp="9" kv="0.5" forcerange="-4 4"/><motor joint="rail" gear="3" ctrlrange="-1 1"/>
</actuator></mujoco>"""

# A trunk that flies with a swinging leg; with a floor, it falls onto it.
LEG = """<mujoco><option timestep="{dt}"/><worldbody>{floor}<body pos="0 0 1"><freejoint/>
  <inertial pos="0.02 0.03 -0.01" quat="0.9 0.1 0.3 0.2" mass="3" diaginertia=".05 .08 .1"/>
  <geom type="box" size=".2 .1 .05"/><body pos=".2 0 0"><joint name="hip" axis="0 1 0" damping=".3"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/></body></body></worldbody>
<actuator><motor joint="hip"/></actuator></mujoco>"""
FLYING = (0.0, 0.0, 1.0, 0.8, 0.6, 0.0, 0.0, 0.3, 1.0, 0.0, 0.5, 1.0, 2.0, 3.0, 0.0)

URDF = """<robot name="arm"><link name="world"/>
<joint name="shoulder" type="continuous"><parent link="world"/><child link="upper"/><axis xyz="0 1 0"/>
  <dynamics damping="0.1" friction="0"/></joint>
<link name="upper"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>{inertia}</inertial></link>
<joint name="elbow" type="continuous"><origin xyz="0 0 -0.5"/><parent link="upper"/><child link="lower"/>
  <axis xyz="0 1 0"/><dynamics damping="0.2" friction="0"/></joint>
<link name="lower"><inertial><origin xyz="0 0 -0.2"/><mass value="0.5"/>{inertia}</inertial></link></robot>""".format(
    inertia='<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
)
# The same arm, whose joints have another order: the lower link is named first by the actuators.
TWIN = """<mujoco><option timestep="0.001"/><worldbody>
<body><joint name="shoulder" axis="0 1 0" damping="0.1"/>
  <inertial pos="0 0 -0.25" mass="1" diaginertia="0.01 0.01 0.01"/>
  <body pos="0 0 -0.5"><joint name="elbow" axis="0 1 0" damping="0.2"/>
    <inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.01 0.01 0.01"/></body></body></worldbody>
<actuator><motor joint="elbow"/><motor joint="shoulder" gear="2"/></actuator></mujoco>"""


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF, encoding="utf-8")
    return path


def wave(inputs: int) -> Controller:
    return lambda t, x: np.sin(0.02 * t + np.arange(inputs))


def differences(mjcf: str, start: Array, inputs: int, seconds: float) -> Array:
    """Return the largest difference of each state of the two engines."""
    ours, theirs = systems.PyBullet(mjcf), systems.MuJoCo(mjcf)
    task = Task(start, horizon=round(seconds / ours.dt), dt=ours.dt)
    testing.check_system(ours, wave(inputs), task)
    states = [system.execute(wave(inputs), task).states for system in (ours, theirs)]
    return np.abs(states[0] - states[1]).max(axis=0)


def test_an_arm_moves_as_in_mujoco() -> None:
    start = np.array([0.0, 0.5, 0.2, 0.3, 0.0, 0.0])
    coarse = differences(ARM, start, 2, 0.4)
    fine = differences(ARM.replace("0.001", "0.0002"), start, 2, 0.4)
    assert (coarse < 0.02).all()
    assert (fine < 0.4 * coarse).all()  # both are of first order in the timestep, and have one limit


def test_a_free_base_moves_as_in_mujoco() -> None:
    coarse, fine = (differences(LEG.format(dt=dt, floor=""), np.array(FLYING), 1, 0.4) for dt in (0.002, 0.00025))
    assert (coarse < 0.06).all()
    assert (fine < 0.5 * coarse + 1e-5).all()


def test_a_base_comes_to_rest_on_the_floor_and_repeats_exactly() -> None:
    floor = '<geom type="plane" size="5 5 .1" friction="0.8"/>'
    system = systems.PyBullet(LEG.format(dt=0.002, floor=floor))
    task = Task(np.array(FLYING), horizon=1500, dt=system.dt)
    first = system.execute(lambda t, x: np.zeros(1), task)
    system.execute(wave(1), Task(np.array(FLYING) * -1.0, horizon=100, dt=system.dt))
    again = pickle.loads(pickle.dumps(system)).execute(lambda t, x: np.zeros(1), task)
    assert np.array_equal(first.states, again.states)
    assert np.array_equal(first.states, system.execute(lambda t, x: np.zeros(1), task).states)
    assert 0.04 < first.final_state[2] < 0.15
    assert np.abs(first.final_state[8:]).max() < 0.05


def test_links_touch_as_the_mjcf_says() -> None:
    geoms = '<geom type="sphere" size="0.1" mass="1" {mask}/>'
    bodies = "".join(
        f'<body pos="0 0 {z}"><joint type="slide" axis="0 0 1"/>{geoms.format(mask=mask)}</body>'
        for z, mask in ((1.0, ""), (0.5, ""), (1.5, 'contype="2" conaffinity="4"'))
    )
    mjcf = f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    masked = mjcf.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>')
    task = Task(np.array([0.0, 0.0, 0.0, -1.0, 0.0, -2.0]), horizon=400, dt=0.002)
    final = systems.PyBullet(masked).execute(lambda t, x: np.zeros(0), task).final_state
    assert abs(final[5] + 2.0) < 1e-9  # it passes through the others
    assert abs(final[3] + final[4] + 1.0) < 1e-6  # these met, and kept their momentum
    assert final[4] < -0.4
    excluded = masked.replace('<body pos="0 0 1.0">', '<body name="a" pos="0 0 1.0">')
    excluded = excluded.replace('<body pos="0 0 0.5">', '<body name="b" pos="0 0 0.5">')
    excluded = excluded.replace("</mujoco>", '<contact><exclude body1="a" body2="b"/></contact></mujoco>')
    assert abs(systems.PyBullet(excluded).execute(lambda t, x: np.zeros(0), task).final_state[3] + 1.0) < 1e-9


def test_dry_friction_holds_a_joint() -> None:
    mjcf = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="a" axis="0 1 0" frictionloss="1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1"/></body></worldbody></mujoco>"""
    run = systems.PyBullet(mjcf).execute(lambda t, x: np.zeros(0), Task([0.3, 0.0], horizon=300, dt=0.001))
    assert np.abs(run.states[:, 0] - 0.3).max() < 1e-3  # gravity asks for 0.72 N m
    assert abs(differences(mjcf, np.array([0.8, 3.0]), 0, 0.3)[0]) < 0.03


def test_joints_of_a_urdf_have_the_order_of_the_model(urdf: Path) -> None:
    system, model = systems.PyBullet(urdf, mjcf=TWIN, substeps=5), systems.MuJoCo(TWIN, substeps=5)
    task = Task([0.4, -0.8, 0.0, 1.0], horizon=60, dt=system.dt)
    runs = [each.execute(wave(2), task).states for each in (system, model)]
    assert np.abs(runs[0] - runs[1]).max() < 0.02
    assert np.abs(runs[0]).max() > 1.0


def test_an_unstable_simulation_has_ended() -> None:
    mjcf = """<mujoco><option timestep="0.02"/><worldbody><body><joint name="a" axis="0 1 0" damping="5" armature="1"/>
      <geom size=".01" pos="0 0 .1" mass=".01"/></body></worldbody></mujoco>"""
    run = systems.PyBullet(mjcf).execute(lambda t, x: np.zeros(0), Task([0.1, 1.0], horizon=100, dt=0.02))
    assert run.is_outcome
    assert not run.finite


def test_what_does_not_fit_is_named(urdf: Path) -> None:
    with refuses(InputError, "wrist"):
        systems.PyBullet(urdf, mjcf=TWIN.replace('"elbow"', '"wrist"'))
    for given in ({"file": urdf}, {"file": ARM, "mjcf": ARM}):
        with refuses(InputError, "mjcf"):
            systems.PyBullet(**given)
    with refuses(InputError, "ball"):
        systems.PyBullet(ARM.replace('axis="1 1 0"', 'type="ball"').replace('joint="elbow"', 'joint="turn"'))
    with refuses(InputError, "1"):
        systems.PyBullet(ARM.replace("<motor ", '<general dyntype="filter" dynprm="0.1" '))
    with refuses(InputError, "missing.urdf"):
        systems.PyBullet(urdf.with_name("missing.urdf"), mjcf=TWIN)
    system = systems.PyBullet(ARM)
    with refuses(ShapeError, 6, 4):
        system.execute(wave(2), Task(np.zeros(4), horizon=2, dt=0.001))
    with refuses(InputError, 0.01):
        system.execute(wave(2), Task(np.zeros(6), horizon=2, dt=0.01))


def test_mujoco_against_pybullet_is_validated() -> None:
    mjcf = TWIN.replace("0.001", "0.002")
    validation = Validation(
        space=TaskSpace(angle=(-0.5, 0.5, "rad")),
        task=lambda p: Task([p.angle, 0.0, 0.0, 0.0], horizon=40, dt=0.02),
        system=systems.PyBullet(mjcf, substeps=10),
        model=models.MuJoCo(mjcf, dt=0.02),
        synthesizer=controllers.Policy(lambda t, x, task: -0.5 * x[..., [1, 0]] - 0.1 * x[..., [3, 2]]),
        distance=distances.MaximumDeviation(),
    )
    campaign = Campaign(validation).run(5)
    assert max(trial.distance for trial in campaign.trials) < 0.05
