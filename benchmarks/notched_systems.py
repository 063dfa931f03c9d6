"""Joints that one place holds with more at rest, beside those of ``friction_systems``; nothing was tuned on them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval import Experiment, TaskSpace, models
from ctxval._util.arrays import Array
from dynamics_systems import repeated
from friction_systems import Push, _moves, geared_pendulum, pair

_SUBSTEPS = 40


def notched(push: Push, sliding: float, rest: float, dt: float, notch: tuple[float, float, float]) -> models.Function:
    """Return a joint that rests until a force overcomes more than it slides with, a multiple of it in a notch.

    The push is without friction, and the notch is a place, a distance from it within which it holds, and the multiple.
    """
    place, within, times = notch

    def step(x: Array, u: Array) -> Array:
        h = dt / _SUBSTEPS
        places, speeds = x[..., :1], x[..., 1:]
        free = speeds + h * push(places, speeds, u)
        grips = np.where(np.abs(places - place) < within, times * rest, rest)
        speeds = np.sign(free) * np.maximum(np.abs(free) - h * np.where(speeds == 0, grips, sliding), 0.0)
        return np.concatenate([places + h * speeds, speeds], axis=-1)

    return models.Function(repeated(step, _SUBSTEPS), vectorized=True)


SYSTEMS: dict[str, Callable[[], Experiment]] = {
    "notched-hinge": lambda: pair(
        "notched-hinge", "rad", TaskSpace(**_moves("rad", 0.9, 1.1)),
        notched(geared_pendulum(1.05, 0.0), 0.5, 0.65, 0.04, (-0.37, 0.09, 2.5)), geared_pendulum(1.0, 0.0),
        60, 0.04, [25.0, 3.0], 0.2, (0,),
    ),
}  # fmt: skip
