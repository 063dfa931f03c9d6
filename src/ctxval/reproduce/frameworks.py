"""The paper's Example 1, in which four frameworks compare M and S of the running example.

Two frameworks compare open loops, by whole trajectories (OLDT) or by final states (OLCD). The other two compare closed
loops, by whole trajectories (CCDT) or by final states (CuSTOM).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval import Task, Trajectory, Validation, distances, systems
from ctxval._util.arrays import Array
from ctxval.cases import pendulum
from ctxval.reproduce.open_loop import OpenLoopWorst, worst_open_loop

WHOLE = distances.WholeTrajectory(norm=np.inf)
"""The distance of OLDT and CCDT."""

FINAL = distances.FinalState(norm=1)
"""The distance of OLCD and CuSTOM."""

PAPERS_GOAL = 0.04
"""The goal angle of the paper's Fig. 2, rad, where CCDT is largest in the paper."""

BOUND = pendulum.Settings().torque
"""Bound of the open-loop torques, N m. It is that of the training data, so that the model does not extrapolate.

The paper leaves the torque unbounded, but then no largest open-loop distance exists. The distance grows with the bound:
if it exceeds the closed-loop distance here, it also does so with the far larger torques of the closed loops.
"""


@dataclass(frozen=True, eq=False)
class Frameworks:
    """The distance between M and S in each framework.

    Attributes:
        goals: the goal angles theta_final, shape ``(N,)``, rad.
        ccdt: distance of the closed loops' trajectories for each goal, shape ``(N,)``.
        custom: distance of the closed loops' final states for each goal, shape ``(N,)``.
        oldt: the largest distance of open-loop trajectories, the same for every goal.
        olcd: the largest distance of open-loop final states, the same for every goal.
        bound: the bound of the open-loop torques, N m.
        closed_loop_torque: the largest torque of any closed loop, on M or on S, N m.
    """

    goals: Array
    ccdt: Array
    custom: Array
    oldt: OpenLoopWorst
    olcd: OpenLoopWorst
    bound: float
    closed_loop_torque: float


def frameworks(seed: int = 0, *, per_axis: int = 2001, restarts: int = 64, bound: float = BOUND) -> Frameworks:
    """Return the four distances of the running example."""
    validation = pendulum.experiment(seed).validation
    goals = validation.space.grid(per_axis)
    task = validation.task(validation.space.parameters(goals))
    on_model, on_system = closed_loops(validation, task)
    torque = max(float(np.abs(loop.inputs).max()) for loop in (on_model, on_system))
    ccdt, custom = (distance(on_model, on_system, task) for distance in (WHOLE, FINAL))
    oldt, olcd = (open_loop(validation, distance, bound, restarts, seed) for distance in (WHOLE, FINAL))
    return Frameworks(goals[:, 0], ccdt, custom, oldt, olcd, bound, torque)


def closed_loops(validation: Validation, task: Task) -> tuple[Trajectory, Trajectory]:
    """Return the closed loops on M and on S for a batch of tasks."""
    controller = validation.synthesizer.design(task, validation.model)
    on_model = systems.Simulated(validation.model).execute(controller, task)
    return on_model, validation.system.execute(controller, task)


def open_loop(
    validation: Validation,
    distance: distances.FinalState | distances.WholeTrajectory,
    bound: float,
    restarts: int,
    seed: int,
) -> OpenLoopWorst:
    """Return the worst open loop from the running example's initial state."""
    assert isinstance(validation.system, systems.Simulated)  # as in the running example
    task = validation.task(validation.space.parameters([0.0]))
    step = validation.system.model
    return worst_open_loop(step, validation.model, task, bound, distance, restarts=restarts, seed=seed)
