"""CPU time of designs, beside the code of an earlier revision (`landed.py`): ratios measured in one run.

- iLQR of 40 steps on a planar quadrotor, a vectorised NumPy model without a Jacobian: batches of tasks, with and
  without limits of the thrusts, and the second suggestion of an `auto` campaign.
- iLQR on a network of scikit-learn, for a system that is a plain Python function: the distances of 40 tasks.
- Designs on linear models, as in the cases pendulum and dubins.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

import landed
from ctxval import (
    Campaign,
    Task,
    TaskSpace,
    Trajectory,
    Transitions,
    Validation,
    cases,
    controllers,
    distances,
    models,
    searches,
    systems,
)
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout

DT = 0.05
TASKS = 40
REPEATS = 3
"""Of the figures for which a ratio is asked."""
FEW = 4
"""Number of tasks for the earlier revision, whose time is proportional to it because it plans one task at a time."""


def planar_quadrotor(mass: float, inertia: float, drag: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a step of (x, z, tilt, and their rates) under the thrusts of two rotors, 0.17 m from the centre."""

    def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        tilt, thrust, torque = x[..., 2], u[..., 0] + u[..., 1], 0.17 * (u[..., 0] - u[..., 1])
        along = -thrust * np.sin(tilt) / mass - drag * x[..., 3]
        up = thrust * np.cos(tilt) / mass - 9.81 - drag * x[..., 4]
        return np.stack([x[..., 3], x[..., 4], x[..., 5], along, up, torque / inertia], axis=-1)

    return systems.rk4(derivative, DT)


def quadrotor(limits: object) -> Validation:
    return Validation(
        space=TaskSpace(x=(-2, 2), z=(-1, 1), tilt=(-0.6, 0.6), rate=(-1, 1)),
        task=lambda p: Task([0, 0, p.tilt, p.rate, 0, 0], goal=[p.x, p.z, 0, 0, 0, 0], horizon=40, dt=DT),
        system=systems.Simulated(planar_quadrotor(0.55, 0.0045, 0.3), vectorized=True),
        model=models.Function(planar_quadrotor(0.5, 0.004, 0.0), vectorized=True),
        synthesizer=controllers.ILQR([1, 1, 0.5, 0.1, 0.1, 0.05], [0.05, 0.05], [50, 50, 5, 5, 5, 1], limits=limits),
        distance=distances.WholeTrajectory(norm=2, per_step=True),
    )


def network(activation: str) -> Validation:
    """Return the swing of a pendulum on a network; its system is a Python function that takes one state at a time."""
    from sklearn.neural_network import MLPRegressor

    def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack([x[..., 1], 14.7 * np.sin(x[..., 0]) + 3 * u[..., 0]], axis=-1)

    step, rng = systems.rk4(derivative, DT), np.random.default_rng(0)
    x, u = rng.uniform([-4, -8], [4, 8], (800, 2)), rng.uniform(-6, 6, (800, 1))
    regressor = MLPRegressor(hidden_layer_sizes=(32, 32), activation=activation, max_iter=400, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the training stops at its limit
        model = models.ScikitLearn.fit(regressor, Transitions(x, u, step(x, u)))

    def execute(controller: Controller, task: Task) -> Trajectory:
        return rollout(lambda state, action: np.array(step(state, action).tolist()), controller, task)

    return Validation(
        space=TaskSpace(goal=(-2, 2), rate=(-1, 1)),
        task=lambda p: Task([np.pi, p.rate], goal=[p.goal, 0], horizon=40, dt=DT),
        system=systems.Function(execute),
        model=model,
        synthesizer=controllers.ILQR([1, 0.1], [0.01], [10, 1]),
        distance=distances.FinalState(norm=2),
    )


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the least CPU time of several calls."""
    costs = []
    for _ in range(repeats):
        started = time.process_time()
        work()
        costs.append(time.process_time() - started)
    return min(costs)


def design_seconds(validation: Validation, count: int) -> float:
    space = validation.space
    points = space.from_unit(np.random.default_rng(0).random((count, space.dimension)))
    task = validation.task(space.parameters(points))
    return seconds(lambda: validation.synthesizer.design(task, validation.model))


def distance_seconds(validation: Validation, count: int) -> float:
    points = validation.space.from_unit(np.random.default_rng(0).random((count, 2)))
    return seconds(lambda: validation.distances(points), repeats=1)


def suggestion_seconds(limits: object) -> float:
    """Return the CPU time of the second suggestion of `auto`, with the second execution, which takes milliseconds."""
    with tempfile.TemporaryDirectory() as folder:
        search = searches.by_name("auto")
        campaign = Campaign(quadrotor(limits), search=search, store=Path(folder) / "quadrotor.sqlite", seed=0)
        campaign.run(budget=1)
        return seconds(lambda: campaign.run(budget=2), repeats=1)


LIMITS = [[0.0, 6.0], [0.0, 6.0]]
FIGURES: dict[str, Callable[[], float]] = {
    **{f"quadrotor, {n} tasks": lambda n=n: design_seconds(quadrotor(None), n) for n in (8, 16, 64)},
    **{f"quadrotor with limits, {n} tasks": lambda n=n: design_seconds(quadrotor(LIMITS), n) for n in (8, 64)},
    "quadrotor with limits, second suggestion": lambda: suggestion_seconds(LIMITS),
    **{f"network (tanh), {n} distances": lambda n=n: distance_seconds(network("tanh"), n) for n in (FEW, TASKS)},
    "pendulum, 64 tasks": lambda: design_seconds(cases.by_name("pendulum").validation, 64),
    "dubins, 64 tasks": lambda: design_seconds(cases.by_name("dubins").validation, 64),
}
COMPARED = {f"network (tanh), {TASKS} distances": (f"network (tanh), {FEW} distances", TASKS / FEW)}
"""Figures for which the earlier revision measures another one, which is multiplied by a factor."""
ASKED = {"quadrotor with limits, second suggestion": 10, f"network (tanh), {TASKS} distances": 20}


def compared(name: str) -> landed.Ratio:
    """Return one figure of the earlier revision and of this checkout."""
    other, factor = COMPARED.get(name, (name, 1))
    before, now = [], []
    for _ in range(REPEATS if name in ASKED else 1):
        before.append(factor * landed.figures(__file__, other, revision=landed.LANDED))
        now.append(landed.figures(__file__, name))
    return landed.Ratio("bench_designs", name, before, now, least=ASKED.get(name))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", nargs="?", choices=list(FIGURES), help="report one figure of the package in use")
    landed.add_store_option(parser)
    options = parser.parse_args()
    if options.figure is not None:
        landed.report(FIGURES[options.figure]())
        return
    for name in FIGURES:
        if name not in [other for other, _ in COMPARED.values()]:
            compared(name).tell(options.store)


if __name__ == "__main__":
    main()
