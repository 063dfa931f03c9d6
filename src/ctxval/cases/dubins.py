"""The paper's Dubins car (Sec. V-A): a linear model learned from it, LQR to follow sums of ten sine waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import ctxval.truth
from ctxval import Experiment, Parameters, Task, TaskSpace, Transitions, Validation, controllers, distances, models
from ctxval import systems
from ctxval.arrays import Array
from ctxval.errors import UnknownNameError

WAVES = 10
"""Sine components of the reference, as in the paper."""


@dataclass(frozen=True)
class Dubins:
    """A car that cannot slip: ``y' = v cos phi``, ``z' = v sin phi``, ``phi' = w``."""

    def derivative(self, x: Array, u: Array) -> Array:
        """Return (y', z', phi') in m/s and rad/s for states ``(..., 3)`` in m and rad and inputs (v, w) ``(..., 2)``."""
        heading, speed, turn_rate = x[..., 2], u[..., 0], u[..., 1]
        parts = speed * np.cos(heading), speed * np.sin(heading), turn_rate
        return np.stack(np.broadcast_arrays(*parts), axis=-1)


@dataclass(frozen=True)
class Settings:
    """Every free parameter of the case, with the reason for its value; the defaults are the variant ``paper``.

    The paper gives the horizon, the start and the task space, and that the maximum is an average deviation of 3.5 m
    which GP-UCB, but not 500 random tasks, comes near to.

    Attributes:
        horizon: steps, the paper's H.
        dt: s; the ten waves then have 0.1 to 1 Hz. Slower (0.2 s and more), the loop on S loses stability.
        heading_weight: of the deviation, 1/rad^2, where positions weigh 1/m^2. A reference of heading 0 is at odds
            with its own waves, so little; with 1 the car hardly turns and no task is much worse than another.
        input_weight: s^2/m^2 and s^2/rad^2. Below 0.05 the loop on S loses stability in many tasks.
        samples: recorded transitions. With many more, all models are the same one, and the paper learns ten.
        data_heading: rad; recorded headings are uniform in plus or minus this. A quarter turn either way: over a
            full turn, the average effect of the speed vanishes, and with it the model's hold on y.
        data_speed: m/s; recorded speeds are uniform from 0 to this. The model steers z at their mean; the slower it
            believes the car to be, the harder it turns, and the worse is the worst task: d* is about 1.2 m with 2,
            3.5 m with 1.25, 5 m with 1.
        data_turn_rate: rad/s; recorded turn rates are uniform in plus or minus this. They enter linearly: any do.
        data_position: m; recorded positions are uniform in plus or minus this, the size of one wave.
        distance: a name of ``DISTANCES``.
        threshold: in the units of the distance: twice what 500 random tasks find is more than they ever show.
    """

    horizon: int = 100
    dt: float = 0.1
    heading_weight: float = 0.1
    input_weight: float = 0.1
    samples: int = 400
    data_heading: float = np.pi / 2
    data_speed: float = 1.25
    data_turn_rate: float = 1.0
    data_position: float = 1.0
    distance: str = "mean-deviation"
    threshold: float = 2.5


