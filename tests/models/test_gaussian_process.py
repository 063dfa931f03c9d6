"""The Gaussian-process model: scikit-learn's own prediction, gradients against differences, batches against loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval import Task, Transitions, controllers, models, testing
from ctxval.errors import InputError, ShapeError
from ctxval.models import increments
from facts import refuses

LENGTH_SCALES = np.array([1.2, 3.0, 2.0])


def oscillator_data(count: int = 120, seed: int = 0) -> Transitions:
    """Return transitions of a nonlinear system with two states and an input."""
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(count, 2)), rng.normal(size=(count, 1))
    rate = x[:, 1] + 0.1 * (np.sin(2 * x[:, 0]) + u[:, 0] * np.cos(x[:, 0]))
    return Transitions(x, u, np.stack([x[:, 0] + 0.1 * rate, rate], axis=1))


@pytest.fixture(scope="module")
def model() -> models.GaussianProcessModel:
    return models.GaussianProcessModel.fit(oscillator_data(), 80, seed=1)


def conditioned(noise: float = 1e-3) -> models.GaussianProcessModel:
    data = oscillator_data()
    scaling = models.IncrementScaling.of(data)
    covariance = models.SquaredExponential(2.0, LENGTH_SCALES)
    return models.GaussianProcessModel.conditioned(
        covariance, noise, scaling.inputs(data.x, data.u), scaling.targets(data), scaling, data
    )


def test_it_predicts_what_scikit_learn_predicts() -> None:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    own = conditioned()
    kernel = ConstantKernel(2.0) * RBF(LENGTH_SCALES)
    oracle = GaussianProcessRegressor(kernel, alpha=1e-3, optimizer=None)
    data, other = oscillator_data(), oscillator_data(seed=1)
    oracle.fit(own.scaling.inputs(data.x, data.u), own.scaling.targets(data))
    output = oracle.predict(own.scaling.inputs(other.x, other.u))
    expected = other.x + own.scaling.shift_out + own.scaling.scale_out * output
    np.testing.assert_allclose(own.step(other.x, other.u), expected, rtol=0, atol=1e-10)


def test_the_likelihood_is_scikit_learns_and_its_gradient_is_right() -> None:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    data = oscillator_data(40)
    scaling = models.IncrementScaling.of(data)
    Z, Y = scaling.inputs(data.x, data.u), scaling.targets(data)
    theta = np.log([2.0, 1e-2, *LENGTH_SCALES])
    value, gradient = increments.log_likelihood(theta, Z, Y)
    kernel = ConstantKernel(2.0) * RBF(LENGTH_SCALES)
    oracle = GaussianProcessRegressor(kernel, alpha=1e-2, optimizer=None).fit(Z, Y)
    constant = -0.5 * Y.size * np.log(2 * np.pi)
    assert value + constant == pytest.approx(oracle.log_marginal_likelihood_value_, abs=1e-8)
    h = 1e-6
    likelihood = lambda moved: increments.log_likelihood(moved, Z, Y)[0]  # noqa: E731
    numeric = [(likelihood(theta + h * e) - likelihood(theta - h * e)) / (2 * h) for e in np.eye(len(theta))]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5)


def test_it_learns_a_nonlinear_system(model: models.GaussianProcessModel) -> None:
    other = oscillator_data(seed=1)
    inside = np.abs(np.column_stack([other.x, other.u])).max(axis=1) < 1.5
    error = np.abs(model.step(other.x, other.u) - other.x_next)[inside]
    linear = np.abs(models.Linear.fit(oscillator_data()).step(other.x, other.u) - other.x_next)[inside]
    assert error.mean() < 0.1 * linear.mean()
    assert len(model.centres) == 80
    assert model.data is not None
    assert len(model.data) == 120


def test_the_fit_makes_its_data_more_likely_than_where_it_started(model: models.GaussianProcessModel) -> None:
    Y = model.scaling.targets(oscillator_data())[np.random.default_rng(1).permutation(120)[:80]]
    found = model.covariance
    noise = 1e-6  # the data have none
    theta = np.log([found.variance, noise, *found.length_scales])
    start = np.log([1.0, 1e-3, 3.0, 3.0, 3.0])
    likelihood = [increments.log_likelihood(point, model.centres, Y)[0] for point in (theta, start)]
    assert likelihood[0] > likelihood[1] + 100


@pytest.mark.parametrize("seed", range(3))
def test_the_jacobian_is_the_derivative(seed: int) -> None:
    rng = np.random.default_rng(seed)
    own = conditioned()
    x, u = rng.normal(size=(30, 2)), rng.normal(size=(30, 1))
    A, B = own.jacobian(x, u)
    h = 1e-5
    moved = [own.step(x + h * e, u) - own.step(x - h * e, u) for e in np.eye(2)]
    numeric = np.stack([*moved, own.step(x, u + h) - own.step(x, u - h)], axis=-1) / (2 * h)
    np.testing.assert_allclose(np.concatenate([A, B], axis=-1), numeric, rtol=0, atol=1e-8)


def test_batches_of_any_shape_are_what_the_loop_gives(
    model: models.GaussianProcessModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(4, 5, 2)), rng.normal(size=(4, 5, 1))
    monkeypatch.setitem(
        vars(model), "_map", replace(model._map, block=7)
    )  # so that there are several blocks, the last not full
    steps, (A, B) = model.step(x, u), model.jacobian(x, u)
    assert (A.shape, B.shape) == ((4, 5, 2, 2), (4, 5, 2, 1))
    for i, j in np.ndindex(4, 5):
        np.testing.assert_allclose(steps[i, j], model.step(x[i, j], u[i, j]), rtol=0, atol=1e-9)
        A_one, B_one = model.jacobian(x[i, j], u[i, j])
        np.testing.assert_allclose(A[i, j], A_one, rtol=0, atol=1e-9)
        np.testing.assert_allclose(B[i, j], B_one, rtol=0, atol=1e-9)
    assert model.step(x[:0], u[:0]).shape == (0, 5, 2)


def test_it_keeps_the_contract_of_a_model() -> None:
    testing.check_model(conditioned(), states=2, inputs=1)


def test_ilqr_reaches_goals_with_it(model: models.GaussianProcessModel) -> None:
    goals = np.linspace(-0.8, 0.8, 5)
    task = Task([0.0, 0.0], goal=[goals, 0.0], horizon=40, dt=0.1)
    solution = controllers.ILQR([1.0, 0.1], [1e-3], [100.0, 1.0]).solve(task, model)
    states = controllers_rollout(model, solution, task)
    assert solution.converged.all()
    np.testing.assert_allclose(states[:, -1, 0], goals, rtol=0, atol=0.02)


def controllers_rollout(
    model: models.GaussianProcessModel, solution: controllers.ILQRSolution, task: Task
) -> np.ndarray:
    from ctxval.systems import Simulated

    return Simulated(model).execute(solution.controller, task).states


def test_what_cannot_be_used_is_refused() -> None:
    data = oscillator_data(30)
    own = conditioned()
    with refuses(InputError, "model"):
        models.GaussianProcessModel.fit(Transitions(data.x, data.u, data.x_next * np.inf))
    with refuses(InputError, "points", 0):
        models.GaussianProcessModel.fit(data, 0)
    Z = np.zeros((3, 3))
    with refuses(InputError, 3):
        models.GaussianProcessModel.conditioned(own.covariance, 0.0, Z, np.zeros((3, 2)), own.scaling)
    with refuses(ShapeError, 2, "states"):
        models.GaussianProcessModel(own.covariance, own.centres[:, :2], own.weights, own.scaling)
    with refuses(InputError, "weights"):
        models.GaussianProcessModel(own.covariance, own.centres, own.weights * np.nan, own.scaling)
