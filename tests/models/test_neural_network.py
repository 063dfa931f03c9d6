"""The network: scikit-learn's own prediction, Jacobians against differences, batches against loops."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest

from ctxval import Transitions, models, testing
from ctxval._util.arrays import Array
from ctxval.errors import InputError, ShapeError
from facts import refuses


def pendulum_data(count: int = 300, seed: int = 0) -> Transitions:
    """Return transitions of a nonlinear system with two states and an input."""
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(count, 2)), rng.normal(size=(count, 1))
    rate = x[:, 1] + 0.1 * (np.sin(x[:, 0]) + u[:, 0])
    return Transitions(x, u, np.stack([x[:, 0] + 0.1 * rate, rate], axis=1))


@pytest.fixture(scope="module")
def network() -> models.FeedforwardReLU:
    return models.FeedforwardReLU.fit(pendulum_data(), (8, 8), seed=1, restarts=2, iterations=200)


def random_network(rng: np.random.Generator, hidden: tuple[int, ...]) -> models.FeedforwardReLU:
    """Return a network of three states and two inputs with random weights and a random scaling."""
    widths = [5, *hidden, 3]
    weights = [rng.normal(size=shape) for shape in itertools.pairwise(widths)]
    biases = [rng.normal(size=width) for width in widths[1:]]
    scaling = models.IncrementScaling(
        rng.normal(size=5), rng.uniform(0.5, 2, 5), rng.normal(size=3), rng.uniform(0.5, 2, 3)
    )
    return models.FeedforwardReLU(weights, biases, scaling)


def test_it_predicts_what_scikit_learn_predicts() -> None:
    from sklearn.neural_network import MLPRegressor

    data = pendulum_data()
    scaling = models.IncrementScaling.of(data)
    regressor = MLPRegressor(hidden_layer_sizes=(8, 8), solver="lbfgs", max_iter=2000, tol=0.1, random_state=0)
    regressor.fit(scaling.inputs(data.x, data.u), scaling.targets(data))
    network = models.FeedforwardReLU(regressor.coefs_, regressor.intercepts_, scaling)
    other = pendulum_data(seed=1)
    output = regressor.predict(scaling.inputs(other.x, other.u))
    expected = other.x + scaling.shift_out + scaling.scale_out * output
    np.testing.assert_allclose(network.step(other.x, other.u), expected, rtol=0, atol=1e-10)


def test_it_learns_a_nonlinear_system(network: models.FeedforwardReLU) -> None:
    data, other = pendulum_data(), pendulum_data(seed=1)
    error = np.abs(network.step(other.x, other.u) - other.x_next).mean()
    linear = np.abs(models.Linear.fit(data).step(other.x, other.u) - other.x_next).mean()
    assert error < 0.5 * linear
    assert network.data is not None
    assert len(network.data) == 300


def test_more_restarts_never_fit_worse() -> None:
    data = pendulum_data(100)

    def loss(restarts: int) -> float:
        network = models.FeedforwardReLU.fit(data, (4,), seed=3, restarts=restarts, iterations=50)
        residual = (network.step(data.x, data.u) - data.x_next) / network.scaling.scale_out
        return float((residual**2).mean())

    losses = [loss(restarts) for restarts in (1, 2, 5)]
    assert losses == sorted(losses, reverse=True)
    assert losses[2] < losses[0]


def test_the_seed_decides_the_network(network: models.FeedforwardReLU) -> None:
    again = models.FeedforwardReLU.fit(pendulum_data(), (8, 8), seed=1, restarts=2, iterations=200)
    other = models.FeedforwardReLU.fit(pendulum_data(), (8, 8), seed=2, restarts=2, iterations=200)
    x, u = np.ones((5, 2)), np.ones((5, 1))
    np.testing.assert_array_equal(again.step(x, u), network.step(x, u))
    assert not np.allclose(other.step(x, u), network.step(x, u))


@pytest.mark.parametrize("hidden", [(), (6,), (8, 8), (5, 4, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_the_jacobian_is_the_derivative_away_from_kinks(hidden: tuple[int, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    network = random_network(rng, hidden)
    x, u = rng.normal(size=(40, 3)), rng.normal(size=(40, 2))
    A, B = network.jacobian(x, u)
    h = 1e-6
    moved = [network.step(x + h * e, u) - network.step(x - h * e, u) for e in np.eye(3)]
    steered = [network.step(x, u + h * e) - network.step(x, u - h * e) for e in np.eye(2)]
    numeric = np.stack([*moved, *steered], axis=-1) / (2 * h)
    smooth = smallest_activation(network, x, u) > 1e-4
    assert smooth.sum() > 30
    np.testing.assert_allclose(np.concatenate([A, B], axis=-1)[smooth], numeric[smooth], rtol=0, atol=1e-7)


def smallest_activation(network: models.FeedforwardReLU, x: Array, u: Array) -> Array:
    """Return how near the nearest kink is, in the units of the activations, shape ``(N,)``."""
    z, nearest = network.scaling.inputs(x, u), np.full(len(x), np.inf)
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        before = z @ weight + bias
        nearest, z = np.minimum(nearest, np.abs(before).min(axis=1)), np.maximum(before, 0.0)
    return nearest


def test_batches_of_any_shape_are_what_the_loop_gives() -> None:
    rng = np.random.default_rng(0)
    network = random_network(rng, (8, 8))
    x, u = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5, 2))
    steps, (A, B) = network.step(x, u), network.jacobian(x, u)
    assert (A.shape, B.shape) == ((4, 5, 3, 3), (4, 5, 3, 2))
    for i, j in np.ndindex(4, 5):
        np.testing.assert_allclose(steps[i, j], network.step(x[i, j], u[i, j]), rtol=0, atol=1e-12)
        A_one, B_one = network.jacobian(x[i, j], u[i, j])
        np.testing.assert_allclose(A[i, j], A_one, rtol=0, atol=1e-12)
        np.testing.assert_allclose(B[i, j], B_one, rtol=0, atol=1e-12)


def test_it_keeps_the_contract_of_a_model(network: models.FeedforwardReLU) -> None:
    testing.check_model(network, states=2, inputs=1, scale=0.3)


def test_layers_must_fit_together() -> None:
    rng = np.random.default_rng(0)
    whole = random_network(rng, (4,))
    for weights, biases in (
        (whole.weights[::-1], whole.biases[::-1]),
        (whole.weights[:1], whole.biases[:1]),
        ([], []),
    ):
        with refuses(ShapeError, "increments", 5):
            models.FeedforwardReLU(weights, biases, whole.scaling)
    with refuses(InputError, "biases[1]"):
        models.FeedforwardReLU(whole.weights, [whole.biases[0], np.full(3, np.nan)], whole.scaling)


def test_useless_data_are_refused() -> None:
    data = pendulum_data(30)
    with refuses(InputError, "model"):
        models.FeedforwardReLU.fit(Transitions(data.x * np.nan, data.u, data.x_next))
    with refuses(InputError, "restarts", 0):
        models.FeedforwardReLU.fit(data, restarts=0)


def test_without_scikit_learn_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.neural_network", None)
    with refuses(InputError, "ctxval[cases]"):
        models.FeedforwardReLU.fit(pendulum_data(30))


def test_a_column_that_never_varies_is_no_trouble() -> None:
    data = pendulum_data(50)
    still = Transitions(
        np.column_stack([data.x, np.full(50, 7.0)]), data.u, np.column_stack([data.x_next, np.full(50, 7.0)])
    )
    network = models.FeedforwardReLU.fit(still, (4,), restarts=1, iterations=20)
    assert np.isfinite(network.step(still.x, still.u)).all()
    np.testing.assert_array_equal(network.scaling.scale_out[2], 1.0)


def test_one_state_is_learned_without_a_warning() -> None:
    x = np.linspace(-1, 1, 40)[:, None]
    network = models.FeedforwardReLU.fit(Transitions(x, 0 * x, 0.5 * x), (4,), restarts=2, iterations=100)
    assert network.step(x, 0 * x) == pytest.approx(0.5 * x, abs=0.01)
