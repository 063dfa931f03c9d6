"""Whether executions are found to be noisy, or to depend on a history."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.trajectory import Transitions
from ctxval.learning.dynamics_study import DynamicsStudy

WAGONS, DT, HARDENING = 4, 0.08, 28.0


def wagons(x: Array, u: Array) -> Array:
    """Return the next state of wagons on couplings that stiffen, of which the outer ones are driven."""

    def rates(x: Array) -> Array:
        gaps, rates_of_gaps = (np.diff(part, axis=-1) for part in (x[..., :WAGONS], x[..., WAGONS:]))
        pull = 6.0 * gaps + HARDENING * gaps**3 + rates_of_gaps
        nothing = np.zeros((*x.shape[:-1], 1))
        forces = np.concatenate([pull, nothing], axis=-1) - np.concatenate([nothing, pull], axis=-1)
        driven = np.concatenate([u[..., :1], *[nothing] * (WAGONS - 2), u[..., 1:]], axis=-1)
        return np.concatenate([x[..., WAGONS:], forces + driven - 0.2 * x[..., WAGONS:]], axis=-1)

    for _ in range(4):
        x = x + DT / 4 * rates(x + DT / 8 * rates(x))
    return x


@pytest.fixture(scope="module")
def train() -> Validation:
    """The wagons, with a linear model of small moves."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-0.1, 0.1, (300, 2 * WAGONS)), rng.uniform(-0.3, 0.3, (300, 2))

    def task(p: dict[str, float]) -> Task:
        places = p["start"] + p["stretch"] * np.linspace(-1, 1, WAGONS)
        start = np.concatenate([places, np.full(WAGONS, p["speed"])])
        return Task(start, goal=np.repeat([p["goal"], 0.0], WAGONS), horizon=30, dt=DT)

    return Validation(
        system=systems.Simulated(wagons, vectorized=True),
        model=models.Linear.fit(Transitions(x, u, wagons(x, u))),
        synthesizer=controllers.LQR([3.0] * WAGONS + [1.0] * WAGONS, [0.3, 0.3]),
        space=TaskSpace(start=(-1, 1), stretch=(-0.8, 0.8), speed=(-0.5, 0.5), goal=(-1, 1)),
        task=task,
        distance=distances.WholeTrajectory(components=tuple(range(WAGONS))),
    )


def test_a_history_whose_closed_loops_diverge_is_no_history(train: Validation) -> None:
    """Earlier errors tell the next one along smooth records, even if it is a function of state and input alone."""
    points = np.random.default_rng(0).random((7, 4))
    executed = [(point, train.execute(train.plan(train.space.from_unit(point)))) for point in points]
    learned = DynamicsStudy(train).learned_alone(executed)
    assert learned is not None
    found = learned.study.noise.learn(learned.posterior, learned.study.extended.records(executed), learned.ledger)
    assert found is not None  # by errors of single steps
    assert learned.noisy is None
