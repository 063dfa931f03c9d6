"""A cart with a pole and dry friction.

Sources: Barto, Sutton and Anderson, *Neuronlike Adaptive Elements That Can Solve Difficult Learning Control Problems*,
IEEE Transactions on Systems, Man, and Cybernetics 1983 (parameters: 1 kg, 0.1 kg, half a length of 0.5 m), and
Florian, *Correct Equations for the Dynamics of the Cart-Pole System*, 2007: Newton's equations of the cart and the pole
with friction of both, of which the force on the rail depends on the accelerations.

Differences from the source: the coefficient of the cart's friction is 0.15 instead of 0.0005, because a cart on a rail
sticks; the sign of its speed is a steep tanh, so that the integration is well defined.
"""

from __future__ import annotations

import numpy as np

from ctxval import Experiment, Task, TaskSpace, controllers, distances, models
from ctxval._util.arrays import Array
from dynamics_systems import experiment, record, simulated

DT, HORIZON = 0.05, 40
GRAVITY, CART, POLE, HALF = 9.8, 1.0, 0.1, 0.5
"""m/s^2, kg, kg, m."""
CART_FRICTION, POLE_FRICTION = 0.15, 2e-6


def derivative(x: Array, u: Array, friction: float = CART_FRICTION) -> Array:
    """Return the derivative of position, angle from upright, speed and rate; u is the force in N."""
    angle, speed, rate = x[..., 1], x[..., 2], x[..., 3]
    sine, cosine, total, moment = np.sin(angle), np.cos(angle), CART + POLE, POLE * HALF
    grip = friction * np.tanh(speed / 0.01)
    # The force on the rail and both accelerations belong together: the rail carries less while the pole falls.
    fixed = (u[..., 0] + moment * rate**2 * (sine + grip * cosine)) / total - grip * GRAVITY
    turned = GRAVITY * sine - cosine * fixed - POLE_FRICTION * rate / moment
    turned = turned / (4 / 3 * HALF - moment * cosine * (cosine - grip * sine) / total)
    return np.stack([speed, rate, fixed - moment * turned * (cosine - grip * sine) / total, turned], axis=-1)


def make(seed: int) -> Experiment:
    """Return the cart-pole that is led to rest by iLQR; M is linear, from small angles. 2-D."""
    system = simulated(derivative, DT, substeps=4)
    return experiment(
        "cart-pole",
        "m, rad",
        space=TaskSpace(angle=(-0.4, 0.4, "rad"), goal=(-1, 1, "m")),
        task=lambda p: Task([0.0, p.angle, 0.0, 0.0], goal=[p.goal, 0.0, 0.0, 0.0], horizon=HORIZON, dt=DT),
        system=system,
        model=models.Linear.fit(record(system, [-1, -0.1, -1.0, -0.5], [1, 0.1, 1.0, 0.5], [6.0], DT, seed, steps=8)),
        synthesizer=controllers.ILQR([2.0, 10.0, 0.5, 0.5], [0.05], limits=15.0, iterations=10),
        distance=distances.WholeTrajectory(norm=np.inf, components=(0, 1)),
    )
