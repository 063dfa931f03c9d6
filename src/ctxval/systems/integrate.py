"""Discrete-time steps of continuous-time dynamics."""

from __future__ import annotations

from collections.abc import Callable

from ctxval._util.arrays import Array

Derivative = Callable[[Array, Array], Array]


def rk4(derivative: Derivative, dt: float) -> Callable[[Array, Array], Array]:
    """Return the step ``(x, u) -> x_next`` of the classical Runge-Kutta method of order 4, of dt seconds.

    The derivative is a function ``(x, u) -> dx/dt``, shapes ``(..., n), (..., m) -> (..., n)``; inputs are held.
    """

    def step(x: Array, u: Array) -> Array:
        k1 = derivative(x, u)
        k2 = derivative(x + 0.5 * dt * k1, u)
        k3 = derivative(x + 0.5 * dt * k2, u)
        k4 = derivative(x + dt * k3, u)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    return step
