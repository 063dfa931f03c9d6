"""A magnet that floats above an electromagnet: the benchmark NN of the ARCH competition.

Source: the plant of *Use the NARMA-L2 Neurocontroller* (The MathWorks), which the ARCH competition took over with its
controller: ``d2y/dt2 = -g + (alpha / M) i^2 sgn(i) / y - (beta / M) dy/dt`` with alpha = 15, beta = 12, M = 3,
g = 9.8, currents from 0 to 4, and references of the position between 0.5 and 4.

The source identifies the plant by a network and inverts that; here M is a network as well and is inverted as well
(:class:`Inversion`), at a period of 0.02 s instead of 0.01 s.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ctxval import Experiment, Parameters, Task, TaskSpace, Transitions, distances, models
from ctxval._util.arrays import Array
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from dynamics_systems import experiment, record, simulated

DT, HORIZON = 0.02, 100
STRENGTH, FRICTION, MASS, GRAVITY = 15.0, 12.0, 3.0, 9.8
LIMIT = 4.0
"""The largest current."""


def derivative(x: Array, u: Array) -> Array:
    """Return the derivative of position and speed; u is the current."""
    current = np.clip(u[..., 0], 0.0, LIMIT)
    # The magnet rests on the electromagnet before the force of the source becomes infinite.
    lift = STRENGTH / MASS * current**2 / np.maximum(x[..., 0], 0.2)
    return np.stack([x[..., 1], lift - GRAVITY - FRICTION / MASS * x[..., 1]], axis=-1)


def holding_current(position: float) -> float:
    """Return the current at which the magnet floats."""
    return float(np.sqrt(GRAVITY * MASS * position / STRENGTH))


@dataclass(frozen=True)
class Inversion:
    """The controller that inverts M, which it takes to be affine in the square of the current (as NARMA-L2 does).

    Attributes:
        stiffness, damping: of the motion that it aims at, 1/s^2 and 1/s.
    """

    stiffness: float = 25.0
    damping: float = 10.0

    batched = True

    def design(self, task: Task, model: Model) -> Controller:
        """Return the controller, which asks M for the next speed under two currents."""

        def control(t: int, x: Array) -> Array:
            gap = task.reference[..., t, :] - x
            aim = x[..., 1] + task.dt * (self.stiffness * gap[..., 0] + self.damping * gap[..., 1])
            low, high = (model.step(x, np.full((*x.shape[:-1], 1), current))[..., 1] for current in (1.0, 2.0))
            share = (aim - low) / np.maximum(high - low, 1e-3)
            return np.sqrt(np.clip(1.0 + 3.0 * share, 0.0, LIMIT**2))[..., None]

        return control


def lift(p: Parameters) -> Task:
    """Return the task: from a height to another one, then to a third."""
    share = 1 / (1 + np.exp(-(np.arange(HORIZON + 1) * DT - 1.0) / 0.05))
    first, second = np.asarray(p.first)[..., None], np.asarray(p.second)[..., None]
    position = first + share * (second - first)
    reference = np.stack([position, np.zeros_like(position)], axis=-1)
    return Task([p.start, p.speed], reference=reference, horizon=HORIZON, dt=DT)


def network(data: Transitions, seed: int) -> models.ScikitLearn:
    """Return a small network in standardised units."""
    from sklearn.compose import TransformedTargetRegressor
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    layers = MLPRegressor(
        hidden_layer_sizes=(10,), activation="tanh", solver="lbfgs", max_iter=300, alpha=1e-4, random_state=seed
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return models.ScikitLearn.fit(
            make_pipeline(StandardScaler(), TransformedTargetRegressor(layers, transformer=StandardScaler())), data
        )


def make(seed: int) -> Experiment:
    """Return the magnet, led between heights by a controller that inverts a network. 4-D."""
    system = simulated(derivative, DT)
    data = record(system, [0.8, -1.0], [2.5, 1.0], [1.0], DT, seed, rollouts=40, steps=12, around=[1.8])
    return experiment(
        "magnetic-levitation",
        "position",
        space=TaskSpace(start=(0.5, 3.0), speed=(-1, 1, "1/s"), first=(0.5, 4.0), second=(0.5, 4.0)),
        task=lift,
        system=system,
        model=network(data, seed),
        synthesizer=Inversion(),
        distance=distances.WholeTrajectory(components=(0,)),
    )
