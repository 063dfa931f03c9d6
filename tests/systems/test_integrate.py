from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from ctxval.systems.functions import rk4


def pendulum(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 1], 9.81 * np.sin(x[..., 0]) + u[..., 0]], axis=-1)


def run(dt: float, seconds: float, x: np.ndarray) -> np.ndarray:
    step = rk4(pendulum, dt)
    for _ in range(round(seconds / dt)):
        x = step(x, np.array([0.3]))
    return x


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    start = np.array([0.3, 0.0])
    truth = run(1 / 4096, 1.0, start)
    errors = [np.abs(run(dt, 1.0, start) - truth).max() for dt in (1 / 32, 1 / 64, 1 / 128, 1 / 256)]
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 16, rtol=0.05)


def test_a_step_of_linear_dynamics_is_the_taylor_series_to_order_four() -> None:
    rng = np.random.default_rng(0)
    A, x, h = rng.normal(size=(3, 3)), rng.normal(size=3), 0.1
    series = sum(np.linalg.matrix_power(h * A, k) / np.prod(np.arange(1, k + 1)) for k in range(5))
    step = rk4(lambda x, u: x @ A.T, h)
    np.testing.assert_allclose(step(x, np.zeros(1)), series @ x, rtol=1e-14)
    np.testing.assert_allclose(step(x, np.zeros(1)), expm(h * A) @ x, rtol=1e-5)


def test_the_energy_of_the_undriven_pendulum_is_nearly_conserved() -> None:
    step, x = rk4(pendulum, 0.01), np.array([0.5, 0.0])
    energies = []
    for _ in range(2000):
        energies.append(0.5 * x[1] ** 2 + 9.81 * np.cos(x[0]))
        x = step(x, np.zeros(1))
    # The pendulum falls through its lowest point many times: kinetic energy comes and goes by some 18 J/(kg m^2).
    np.testing.assert_allclose(energies, energies[0], rtol=0, atol=1e-4)


def test_the_input_is_held_over_the_step() -> None:
    step = rk4(lambda x, u: u, 0.25)
    np.testing.assert_allclose(step(np.array([1.0]), np.array([2.0])), [1.5], rtol=1e-15)


@pytest.mark.parametrize("batch", [(7,), (2, 3)])
def test_a_batch_of_steps_is_the_loop_over_them(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    x, u, step = rng.normal(size=(*batch, 2)), rng.normal(size=(*batch, 1)), rk4(pendulum, 0.05)
    loop = [step(xi, ui) for xi, ui in zip(x.reshape(-1, 2), u.reshape(-1, 1), strict=True)]
    np.testing.assert_allclose(step(x, u).reshape(-1, 2), loop, rtol=1e-14)
