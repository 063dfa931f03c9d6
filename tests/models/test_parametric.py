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
