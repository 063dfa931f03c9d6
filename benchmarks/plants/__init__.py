"""Plants from the falsification literature and from robotics, on which searches are developed and reported.

Each module states the source of its equations and what differs from it, and returns an experiment for a seed, which
draws the data that M is learned from. ``plants/truths.py`` finds the maxima, ``study_plants.py`` runs the searches.

Nothing may be chosen by a plant of the kind ``reporting``: no search, no option, no default. The kinds below were
written down before any search had run on any of the plants.

| plant | source | tasks | M | controller | distance | kind |
|---|---|---|---|---|---|---|
| automatic-transmission | ARCH competition, AT | 5-D | network, ReLU | driver (policy) | mean deviation | development |
| fuel-control | ARCH competition, AFC | 5-D | linear | published PI (policy) | largest deviation | development |
| wind-turbine | ARCH competition, WT | 5-D | Gaussian process | published PI (policy) | mean deviation | development |
| cart-pole | robotics | 2-D | linear | iLQR | largest deviation | development |
| f16-pull-up | ARCH competition, F16 | 5-D | polynomial | LQR | final deviation | reporting |
| magnetic-levitation | ARCH competition, NN | 4-D | network, tanh | inversion of M | whole trajectory | reporting |
| quadrotor-3d | ARCH competition, AFF | 12-D | linear | LQR | mean deviation | reporting |
| six-joint-arm | robotics, MuJoCo | 12-D | linear | LQR | mean deviation | reporting |
"""

from __future__ import annotations

from plants import (
    automatic_transmission,
    cart_pole,
    f16,
    fuel_control,
    magnetic_levitation,
    quadrotor,
    six_joint_arm,
    wind_turbine,
)
from plants.base import DEVELOPMENT, REPORTING, Plant, listed

__all__ = ["DEVELOPMENT", "PLANTS", "REPORTING", "Plant"]

PLANTS: dict[str, Plant] = listed(
    Plant("automatic-transmission", DEVELOPMENT, automatic_transmission.make, dimension=5, samples=10000),
    Plant("fuel-control", DEVELOPMENT, fuel_control.make, dimension=5, samples=20000),
    Plant("wind-turbine", DEVELOPMENT, wind_turbine.make, dimension=5, samples=20000),
    Plant("cart-pole", DEVELOPMENT, cart_pole.make, dimension=2, samples=5000),
    Plant("f16-pull-up", REPORTING, f16.make, dimension=5, samples=10000),
    Plant("magnetic-levitation", REPORTING, magnetic_levitation.make, dimension=4, samples=10000),
    Plant("quadrotor-3d", REPORTING, quadrotor.make, dimension=12, samples=20000, budget=30),
    Plant("six-joint-arm", REPORTING, six_joint_arm.make, dimension=12, samples=4000, budget=30),
)
