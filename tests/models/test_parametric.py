"""A user's function with named parameters as a model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import models, testing
from ctxval.cli.config.parts import part
from ctxval.errors import InputError
from facts import refuses


def cart(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 0] + 0.1 * x[..., 1], x[..., 1] + 0.1 * u[..., 0] / theta[0] - theta[1]], axis=-1)


@pytest.mark.parametrize("vectorized", [True, False])
def test_a_function_with_parameters_is_a_model(vectorized: bool) -> None:
    model = models.Parametric(cart, {"mass": 2.0, "drift": 0.5}, vectorized=vectorized)
    testing.check_model(model, states=2, inputs=1)
    assert model.step(np.array([1.0, 2.0]), np.array([4.0])).tolist() == pytest.approx([1.2, 1.7])


def test_it_is_written_in_an_experiment_file(tmp_path: Path) -> None:
    (tmp_path / "my_cart.py").write_text("def step(x, u, theta):\n    return x + theta[0] * u\n")
    table: dict[str, Any] = {"type": "Parametric", "step": {"ref": "my_cart:step"}, "theta": {"gain": 0.5}}
    assert part("model", table, tmp_path).step(np.ones(1), np.ones(1)).tolist() == [1.5]


@pytest.mark.parametrize(
    ("step", "theta", "facts"),
    [
        (3, {"a": 1}, ("step", 3)),
        (cart, {}, ("theta", {})),
        (cart, [1.0], ("theta", [1.0])),
        (cart, {"a": float("nan")}, ("theta",)),
        (cart, {"a": "b"}, ("theta",)),
    ],
)
def test_what_is_no_model_is_refused(step: Any, theta: Any, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        models.Parametric(step, theta)


@pytest.mark.parametrize("vectorized", [True, False])
def test_draws_of_uncertain_parameters_run_together_as_each_alone(vectorized: bool) -> None:
    model = models.Parametric(
        cart, {"mass": 2.0, "drift": 0.5}, uncertain={"mass": "20 %", "drift": 0.1}, vectorized=vectorized
    )
    rng = np.random.default_rng(0)
    z, x, u = rng.normal(size=(3, 2)), rng.normal(size=(3, 4, 2)), rng.normal(size=(3, 4, 1))
    together = model.drawn(z).step(x, u)
    for k in range(3):
        theta = {"mass": 2.0 * np.exp(0.2 * z[k, 0]), "drift": 0.5 + 0.1 * z[k, 1]}
        alone = models.Parametric(cart, theta, vectorized=vectorized)
        np.testing.assert_allclose(together[k], alone.step(x[k], u[k]), rtol=1e-12)
    np.testing.assert_allclose(model.drawn(np.zeros((1, 2))).step(x[:1], u[:1])[0], model.step(x[0], u[0]), rtol=1e-12)


def test_a_function_that_would_mix_draws_runs_draw_by_draw() -> None:
    def mixing(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return x * theta[0] + u  # a draw (S, 1) times states (S, q, n) is not draw by draw

    model = models.Parametric(mixing, {"gain": 1.0}, uncertain={"gain": "50 %"}, vectorized=True)
    x, u, z = np.ones((2, 2, 2)), np.zeros((2, 2, 2)), np.array([[0.0], [1.0]])
    expected = np.ones((2, 2, 2)) * np.exp([0.0, 0.5]).reshape(2, 1, 1)
    np.testing.assert_allclose(model.drawn(z).step(x, u), expected, rtol=1e-12)


def test_uncertain_parameters_must_be_parameters() -> None:
    with refuses(InputError, "weight"):
        models.Parametric(cart, {"mass": 1.0, "drift": 0.0}, uncertain={"weight": "10 %"})
