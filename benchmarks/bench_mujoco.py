"""What feedback in batches costs on top of MuJoCo: whole closed loops against the bare mj_step calls that they make.

Prints ratios measured in one run, on one thread; run it with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import statistics
import time

import mujoco
import numpy as np

from ctxval import Task, Trajectory, systems
from ctxval._util.arrays import Array
from ctxval.controllers import AffineFeedback
from ctxval.paper.cases import arm

HORIZON = 100
REPEATS = 5

CART = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
    <body><joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" contype="0"/></body>
  </body></worldbody>
  <actuator><motor joint="slide"/></actuator>
</mujoco>
"""


def closed_loop_seconds(system: systems.MuJoCo, starts: Array, gain: Array) -> tuple[float, Trajectory]:
    """Run a linear feedback around the starting points."""
    task = Task(starts, horizon=HORIZON, dt=system.dt)
    inputs = np.zeros((len(starts), HORIZON, len(gain)))
    controller = AffineFeedback(np.broadcast_to(gain, (HORIZON, *gain.shape)), inputs, task.reference)
    started = time.perf_counter()
    trajectory = system.execute(controller, task)
    return time.perf_counter() - started, trajectory


def bare_seconds(xml: str, substeps: int, trajectory: Trajectory) -> float:
    """Replay the inputs of a batch with MuJoCo alone."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    started = time.perf_counter()
    for states, inputs in zip(trajectory.states, trajectory.inputs, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = states[0, : model.nq], states[0, model.nq : model.nq + model.nv]
        for u in inputs:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, substeps)
    return time.perf_counter() - started


def report(name: str, xml: str, system: systems.MuJoCo, starts: Array, gain: Array) -> None:
    ratios, microseconds = [], []
    for _ in range(REPEATS):
        closed, trajectory = closed_loop_seconds(system, starts, gain)
        bare = bare_seconds(xml, system.substeps, trajectory)
        ratios.append(closed / bare)
        microseconds.append(1e6 * closed / (len(starts) * HORIZON))
    print(
        f"{name}, {len(starts)} closed loops of {HORIZON} steps: {statistics.median(microseconds):.1f} us a step, "
        f"{statistics.median(ratios):.2f} times the bare mj_step calls (asked: at most 2)"
    )


def main() -> None:
    rng = np.random.default_rng(0)
    for count in (100, 1000):
        reacher = arm.arm(arm.Settings())
        starts = reacher.state(rng.uniform(-1, 1, (count, 2)))
        name = f"arm, Runge-Kutta, {reacher.substeps} substeps, a site"
        report(name, arm.MJCF, reacher, starts, -0.05 * np.eye(2, 6))
        for substeps in (1, 5):
            cart = systems.MuJoCo(CART, substeps=substeps)
            starts = cart.state(rng.uniform(-0.5, 0.5, (count, 2)))
            report(f"cart, Euler, {substeps} substeps", CART, cart, starts, np.array([[-1.0, 2.0, -1.0, 0.5]]))


if __name__ == "__main__":
    main()
