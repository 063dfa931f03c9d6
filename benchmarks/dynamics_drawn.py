"""The systems to report on whose residual is a draw of a random function, another one for each seed.

Listed with the others in ``dynamics_reporting.py``. The length-scales and the sizes of the draws are drawn too.
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Task, TaskSpace, controllers, distances, models, systems
from ctxval._util.arrays import Array
from dynamics_systems import Entry, RandomFunction, experiment, record


def _scales(rng: np.random.Generator, ranges: list[float]) -> Array:
    return np.asarray(ranges) * np.exp(rng.uniform(np.log(0.5), np.log(2.5), len(ranges)))


def drawn_smooth(seed: int) -> Experiment:
    """Return a scalar system whose residual is a draw of a squared exponential in state and input. 2-D."""
    rng = np.random.default_rng([seed, 23])
    residual = RandomFunction.draw(rng, _scales(rng, [1.0, 1.0]), np.array([rng.uniform(0.03, 0.1)]))
    A, B = np.array([[0.95]]), np.array([[0.2]])

    def step(x: Array, u: Array) -> Array:
        return np.asarray(x @ A.T + u @ B.T + residual(np.concatenate([x, u], axis=-1)))

    return experiment(
        "drawn-smooth",
        "",
        space=TaskSpace(start=(-1.5, 1.5), goal=(-1.5, 1.5)),
        task=lambda p: Task([p.start], goal=[p.goal], horizon=25, dt=0.1),
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([1.0], [0.3]),
        distance=distances.FinalState(),
    )


def drawn_rough(seed: int) -> Experiment:
    """Return an oscillator whose residual is a draw of a Matern 5/2 kernel in states and input. 3-D."""
    rng = np.random.default_rng([seed, 29])
    residual = RandomFunction.draw(rng, _scales(rng, [1.0, 1.5, 2.0]), rng.uniform(0.005, 0.04, 2), smoothness=2.5)
    A, B = np.array([[1.0, 0.1], [-0.15, 0.95]]), np.array([[0.0], [0.1]])

    def step(x: Array, u: Array) -> Array:
        return np.asarray(x @ A.T + u @ B.T + residual(np.concatenate([x, u], axis=-1)))

    return experiment(
        "drawn-rough",
        "",
        space=TaskSpace(start=(-1, 1), speed=(-1, 1), goal=(-1, 1)),
        task=lambda p: Task([p.start, p.speed], goal=[p.goal, 0.0], horizon=30, dt=0.1),
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([5.0, 1.0], [0.5]),
        distance=distances.WholeTrajectory(components=(0,)),
    )


def drawn_affine(seed: int) -> Experiment:
    """Return three states and two inputs; the residual is a draw that is affine in the inputs. M is linear. 5-D."""
    rng = np.random.default_rng([seed, 31])
    scales, size = _scales(rng, [1.5, 1.5, 1.5]), rng.uniform(0.02, 0.05)
    residual = RandomFunction.draw(rng, scales, np.repeat([size, 0.6 * size], [3, 6]))
    A = np.array([[0.97, 0.08, 0.0], [-0.08, 0.95, 0.06], [0.0, -0.06, 0.93]])
    B = np.array([[0.1, 0.0], [0.0, 0.03], [0.0, 0.1]])

    def step(x: Array, u: Array) -> Array:
        drawn = residual(x)
        gain = drawn[..., 3:].reshape(*drawn.shape[:-1], 3, 2)
        return np.asarray(x @ A.T + u @ B.T + drawn[..., :3] + (gain @ u[..., None])[..., 0])

    system = systems.Simulated(step, vectorized=True)
    return experiment(
        "drawn-affine",
        "",
        space=TaskSpace(start=([-1] * 3, [1] * 3), goal=([-1] * 2, [1] * 2)),
        task=lambda p: Task(p.start, goal=[p.goal[..., 0], 0.0, p.goal[..., 1]], horizon=25, dt=0.1),
        system=system,
        model=models.Linear.fit(record(system, [-0.6] * 3, [0.6] * 3, [0.5, 0.5], 0.1, seed, rollouts=20, steps=10)),
        synthesizer=controllers.LQR([3.0, 1.0, 3.0], [0.5, 0.5]),
        distance=distances.MeanDeviation(norm=2),
    )


DRAWN = (
    Entry("drawn-smooth", "prior", drawn_smooth, seeds=5),
    Entry("drawn-rough", "prior", drawn_rough, seeds=5),
    Entry("drawn-affine", "prior", drawn_affine, seeds=5),
)
