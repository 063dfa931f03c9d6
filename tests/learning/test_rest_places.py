"""Friction at rest is tested where a joint leaves rest under a small force; tasks go where it was not."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.coverage import UntestedRest
from ctxval.learning import DynamicsStudy
from ctxval.learning.learned_dynamics import LearnedDynamics

DT, SLIDES, HOLDS = 0.05, 0.4, 0.5
CORNERS = [
    (0.0, 1.0),
    (1.0, 0.0),
    (0.1, 0.9),
    (0.75, 0.15),
    (0.4, 0.8),
]  # starts and goals that are far from each other


def step(x: Array, u: Array) -> Array:
    """A cart that slides against less friction than what holds it at rest, in 20 short steps."""
    position, speed = x[..., 0], x[..., 1]
    dt = DT / 20
    for _ in range(20):
        free = speed + dt * u[..., 0]
        most = np.where(speed == 0, HOLDS, SLIDES)
        speed = np.sign(free) * np.maximum(np.abs(free) - dt * most, 0.0)
        position = position + dt * speed
    return np.stack([position, speed], axis=-1)


CART = Validation(
    space=TaskSpace(start=(-1.0, 1.0, "m"), goal=(-2.0, 2.0, "m")),
    task=lambda p: Task(
        np.stack([p.start, 0 * p.start], -1), goal=np.stack([p.goal, 0 * p.goal], -1), horizon=40, dt=DT
    ),
    system=systems.Simulated(step, vectorized=True),
    model=models.Linear(np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.0], [DT]])),
    synthesizer=controllers.LQR([10.0, 1.0], [1.0]),
    distance=distances.MaximumDeviation(components=(0,)),
)


def near(start: float, force: float) -> tuple[float, float]:
    """Return the task that leaves rest at a start with about this force, a point of the unit cube."""
    goal = start + force / 2.9
    return (start + 1) / 2, (goal + 2) / 4


@functools.cache
def learned(small: tuple[float, ...]) -> LearnedDynamics:
    """Return what executions with large forces teach, and others with a small one from these starts."""
    points = np.array([*CORNERS, *(near(start, 0.6) for start in small)])
    executed = [(point, CART.outcome(CART.space.from_unit(point)).system_trajectory) for point in points]
    found = DynamicsStudy(CART).learn([(point, run) for point, run in executed if run is not None])
    assert found is not None
    assert found.friction["u[0]"] == pytest.approx(SLIDES, rel=0.1)
    return found


def test_a_place_is_tested_by_a_joint_that_leaves_rest_there_under_a_small_force() -> None:
    rest = learned((-0.5, 0.0)).untested_rest
    assert rest is not None
    assert HOLDS < rest.force < 2 * HOLDS
    assert rest.size == pytest.approx(0.5, abs=0.05)  # from 0 to the end at 1
    assert rest.length == pytest.approx(2 * rest.size, rel=0.05)
    assert 0 < rest.place["x[0]"] <= 1
    assert rest.times * HOLDS / 3.2 < rest.highest < 3 * rest.times * HOLDS  # what is held stays short of its goal
    filled = learned(tuple(np.linspace(-1, 1, 21).tolist())).untested_rest
    assert filled is not None
    assert filled.size <= UntestedRest.MOST
    assert filled.tasks == ()


def test_the_tasks_of_an_untested_stretch_leave_rest_in_it_under_a_small_force() -> None:
    known = learned((-0.5, 0.0))
    rest = known.untested_rest
    assert rest is not None
    space = CART.space
    start, goal = space.from_unit(np.array(rest.tasks[0]))
    assert 0 < start < 1
    assert abs(start * 10 - round(start * 10)) < 0.15  # one of the tasks that divide the stretch evenly
    assert HOLDS < 2.9 * abs(goal - start) < 1.15 * rest.force
    moved = known.at_untested_rest(np.array(near(-0.7, 0.55)))
    assert moved is not None
    start, goal = space.from_unit(moved)
    assert 0 < start < 1
    assert 2.9 * abs(goal - start) == pytest.approx(0.55, rel=0.15)
    assert known.at_untested_rest(np.array(CORNERS[0])) is None  # it leaves rest under a large force


def test_nothing_is_untested_without_dry_friction() -> None:
    smooth = CART.with_parts(
        system=systems.Simulated(lambda x, u: CART.model.step(x, u) - 0.01 * x * [0, 1], vectorized=True)
    )
    executed = [(np.array(p), smooth.outcome(CART.space.from_unit(np.array(p))).system_trajectory) for p in CORNERS]
    found = DynamicsStudy(smooth).learn([(point, run) for point, run in executed if run is not None])
    assert found is not None
    assert found.untested_rest is None
    assert found.at_untested_rest(np.array(CORNERS[0])) is None
