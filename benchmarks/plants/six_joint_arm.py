"""A UR5e arm with six joints, in MuJoCo.

Source: the kinematics, masses and inertias that Universal Robots publishes for the UR5e, as in the MuJoCo Menagerie
(``universal_robots_ur5e``, Google DeepMind), with the rated torques of the joints (150 Nm and 28 Nm).

Differences from the source: the joints are driven by torques instead of position servos, so the damping of the servos
is replaced by a joint damping of 2 and 0.5 Nm s and a dry friction of 2 and 0.5 Nm; nothing collides.
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, controllers, distances, models, systems
from ctxval._util.arrays import Array
from dynamics_systems import experiment, record

TIMESTEP, SUBSTEPS, HORIZON = 0.005, 8, 40
DT = TIMESTEP * SUBSTEPS
TORQUES = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
"""Rated, Nm."""
HOME = np.array([-1.5708, -1.5708, 1.5708, -1.5708, -1.5708, 0.0])

MJCF = f"""
<mujoco model="ur5e">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="implicitfast"><flag contact="disable"/></option>
  <default>
    <joint axis="0 1 0" armature="0.1"/>
    <default class="large"><joint damping="2" frictionloss="2"/><motor ctrlrange="-150 150"/></default>
    <default class="small"><joint damping="0.5" frictionloss="0.5"/><motor ctrlrange="-28 28"/></default>
  </default>
  <worldbody>
    <body name="base" quat="1 0 0 1">
      <inertial mass="4.0" pos="0 0 0" diaginertia="0.00443333156 0.00443333156 0.0072"/>
      <body name="shoulder" pos="0 0 0.163">
        <inertial mass="3.7" pos="0 0 0" diaginertia="0.0102675 0.0102675 0.00666"/>
        <joint name="shoulder_pan" class="large" axis="0 0 1"/>
        <body name="upper_arm" pos="0 0.138 0" quat="1 0 1 0">
          <inertial mass="8.393" pos="0 0 0.2125" diaginertia="0.133886 0.133886 0.0151074"/>
          <joint name="shoulder_lift" class="large"/>
          <body name="forearm" pos="0 -0.131 0.425">
            <inertial mass="2.275" pos="0 0 0.196" diaginertia="0.0311796 0.0311796 0.004095"/>
            <joint name="elbow" class="large"/>
            <body name="wrist_1" pos="0 0 0.392" quat="1 0 1 0">
              <inertial mass="1.219" pos="0 0.127 0" diaginertia="0.0025599 0.0025599 0.0021942"/>
              <joint name="wrist_1" class="small"/>
              <body name="wrist_2" pos="0 0.127 0">
                <inertial mass="1.219" pos="0 0 0.1" diaginertia="0.0025599 0.0025599 0.0021942"/>
                <joint name="wrist_2" class="small" axis="0 0 1"/>
                <body name="wrist_3" pos="0 0 0.1">
                  <inertial mass="0.1889" pos="0 0.0771683 0" quat="1 0 0 1"
                            diaginertia="0.000132134 9.90863e-05 9.90863e-05"/>
                  <joint name="wrist_3" class="small"/>
                  <site name="flange" pos="0 0.1 0"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor class="large" joint="shoulder_pan"/>
    <motor class="large" joint="shoulder_lift"/>
    <motor class="large" joint="elbow"/>
    <motor class="small" joint="wrist_1"/>
    <motor class="small" joint="wrist_2"/>
    <motor class="small" joint="wrist_3"/>
  </actuator>
</mujoco>
"""


def reach(p: Parameters) -> Task:
    """Return the task: from rest in a configuration to another one, on a quintic path."""
    share = np.arange(HORIZON + 1) / HORIZON
    way = (share**3 * (10 - 15 * share + 6 * share**2))[:, None]
    slope = (30 * share**2 * (1 - share) ** 2 / (HORIZON * DT))[:, None]
    gap = (p.goal - p.start)[..., None, :]
    reference = np.concatenate([HOME + p.start[..., None, :] + way * gap, slope * gap], axis=-1)
    start: Array = np.concatenate([HOME + p.start, 0 * p.start], axis=-1)
    return Task(start, reference=reference, horizon=HORIZON, dt=DT)


def make(seed: int) -> Experiment:
    """Return the arm that reaches under LQR; M is linear, from small motions around its home. 12-D."""
    system = systems.MuJoCo(MJCF, substeps=SUBSTEPS)
    box = np.array([*[0.2] * 6, *[0.4] * 6])
    middle = np.concatenate([HOME, np.zeros(6)])
    effort, weight = [10.0, 30.0, 15.0, 2.0, 2.0, 1.0], [0.0, -20.0, -10.0, 0.0, 0.0, 0.0]
    data = record(system, list(middle - box), list(middle + box), effort, DT, seed, rollouts=40, steps=6, around=weight)
    return experiment(
        "six-joint-arm",
        "rad",
        space=TaskSpace(start=([-0.4] * 6, [0.4] * 6, "rad"), goal=([-0.8] * 6, [0.8] * 6, "rad")),
        task=reach,
        system=system,
        model=models.Linear.fit(data),
        synthesizer=controllers.LQR(
            [100.0] * 6 + [1.0] * 6, [1e-4] * 3 + [1e-3] * 3, limits=[[-most, most] for most in TORQUES]
        ),
        distance=distances.MeanDeviation(norm=2, components=tuple(range(6))),
    )
