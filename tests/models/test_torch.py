"""Torch modules as models, beside the same formulas in NumPy."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from ctxval import Task, controllers, testing
from ctxval._util.describe import describe, first_difference
from ctxval.core.model import linearize
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ModelError, ShapeError
from ctxval.models import Torch
from facts import refuses

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'ctxval[torch]'")

RNG = np.random.default_rng(0)
W1, b1, W2 = 0.5 * RNG.normal(size=(3, 8)), 0.1 * RNG.normal(size=8), 0.3 * RNG.normal(size=(8, 2))


def network(dtype: Any = torch.float64) -> Any:
    """Return ``tanh((x, u) W1 + b1) W2`` as a module."""
    first, last = torch.nn.Linear(3, 8, dtype=dtype), torch.nn.Linear(8, 2, bias=False, dtype=dtype)
    with torch.no_grad():
        first.weight.copy_(torch.as_tensor(W1.T))
        first.bias.copy_(torch.as_tensor(b1))
        last.weight.copy_(torch.as_tensor(W2.T))
    return torch.nn.Sequential(first, torch.nn.Tanh(), last)


class Separate(torch.nn.Module):  # type: ignore[misc]
    """The network with two arguments, and a layer that mixes rows while it is trained."""

    def __init__(self) -> None:
        super().__init__()
        self.network, self.dropout = network(), torch.nn.Dropout(0.5)

    def forward(self, x: Any, u: Any) -> Any:
        return self.dropout(self.network(torch.cat([x, u], dim=-1)))


def expected(x: Any, u: Any) -> Any:
    return np.tanh(np.concatenate([x, u], axis=-1) @ W1 + b1) @ W2


@pytest.mark.parametrize("module", [network(), Separate()], ids=["one tensor", "two tensors"])
def test_step_and_jacobian(module: Any) -> None:
    x, u = RNG.normal(size=(4, 5, 2)), RNG.normal(size=(5, 1))
    model = Torch(module, increments=True)
    np.testing.assert_allclose(model.step(x, u), x + expected(x, np.broadcast_to(u, (4, 5, 1))), rtol=1e-13)
    np.testing.assert_allclose(model.step(x[0, 0], u[0]), model.step(x, u)[0, 0], rtol=1e-13)
    slope = (1 - np.tanh(np.concatenate([x, np.broadcast_to(u, (4, 5, 1))], axis=-1) @ W1 + b1) ** 2)[..., None] * W2
    wanted = np.moveaxis(np.einsum("ij,...jk->...ik", W1, slope), -1, -2)
    A, B = linearize(model, x, u)
    np.testing.assert_allclose(A, np.eye(2) + wanted[..., :2], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(B, wanted[..., 2:], rtol=1e-12, atol=1e-14)
    assert module.training  # as it was given


def test_contract() -> None:
    testing.check_model(Torch(network()), states=2, inputs=1)


def test_single_precision_and_controllers() -> None:
    model = Torch(network(torch.float32), increments=True)
    task = Task([0.5, -0.2], horizon=10, dt=0.1)
    controller = controllers.ILQR([1.0, 1.0], [0.1]).design(task, model)
    double = Torch(network(), increments=True)
    np.testing.assert_allclose(
        rollout(model.step, controller, task).states, rollout(double.step, controller, task).states, atol=1e-5
    )


def test_identity_and_copies() -> None:
    model, changed = Torch(network()), Torch(network())
    copied = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(copied.step(np.ones(2), np.ones(1)), model.step(np.ones(2), np.ones(1)))
    assert first_difference(describe(model), describe(changed)) is None
    with torch.no_grad():
        changed.module[0].bias += 1e-9
    assert first_difference(describe(model), describe(changed)) is not None


def test_refused() -> None:
    with refuses(InputError):
        Torch(lambda x, u, t: x)
    with refuses(ShapeError):
        Torch(lambda x, u: u).step(np.ones((3, 2)), np.ones((3, 1)))
    with refuses(ModelError):
        Torch(network()).step(np.ones(4), np.ones(1))
