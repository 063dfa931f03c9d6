"""Regressors of scikit-learn as models."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import (
    PolynomialFeatures,
    StandardScaler,
)

from ctxval import Task, Transitions, controllers, testing
from ctxval.core.model import linearize
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear, ScikitLearn
from facts import refuses

TRUTH = Linear([[1.0, 0.1], [-0.2, 0.9]], [[0.0], [0.1]], [0.01, 0.0])


def recorded(model: Linear = TRUTH, count: int = 60) -> Transitions:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(count, len(model.A))), rng.normal(size=(count, model.B.shape[1]))
    return Transitions(x, u, model.step(x, u))


@pytest.mark.parametrize("increments", [True, False])
def test_linear_regression_finds_the_linear_model(increments: bool) -> None:
    model = ScikitLearn.fit(LinearRegression(), recorded(), increments=increments)
    x, u = np.random.default_rng(1).normal(size=(5, 2)), np.random.default_rng(2).normal(size=(5, 1))
    np.testing.assert_allclose(model.step(x, u), TRUTH.step(x, u), atol=1e-12)
    A, B = linearize(model, x, u)  # without batch axes, so that gains are computed once
    np.testing.assert_allclose(A, TRUTH.A, atol=1e-12)
    np.testing.assert_allclose(B, TRUTH.B, atol=1e-12)


@pytest.mark.parametrize(
    "regressor",
    [
        Ridge(),
        make_pipeline(PolynomialFeatures(2), Ridge(1e-3)),
        make_pipeline(
            StandardScaler(),
            MLPRegressor(hidden_layer_sizes=(6,), solver="lbfgs", max_iter=30, tol=1.0, random_state=0),
        ),
        RandomForestRegressor(3, random_state=0),
        GaussianProcessRegressor(optimizer=None, alpha=1e-6),
    ],
    ids=lambda regressor: type(getattr(regressor, "_final_estimator", regressor)).__name__,
)
def test_every_regressor_keeps_the_contract_of_a_model(regressor: Any) -> None:
    model = ScikitLearn.fit(regressor, recorded())
    testing.check_model(model, states=2, inputs=1)


def test_a_single_state_needs_no_second_axis() -> None:
    truth = Linear([[0.9]], [[0.5]])
    model = ScikitLearn.fit(LinearRegression(), recorded(truth))
    testing.check_model(model, states=1, inputs=1)
    np.testing.assert_allclose(model.step(np.array([1.0]), np.array([2.0])), [1.9])


def test_controllers_are_designed_on_it() -> None:
    model, task = ScikitLearn.fit(Ridge(1e-6), recorded()), Task([1.0, 0.0], goal=[0.2, 0.0], horizon=15, dt=0.1)
    for synthesizer in (controllers.LQR([1.0, 0.1], [0.1]), controllers.ILQR([1.0, 0.1], [0.1])):
        found = rollout(model.step, synthesizer.design(task, model), task).states
        expected = rollout(TRUTH.step, synthesizer.design(task, TRUTH), task).states
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_what_cannot_be_used_is_refused() -> None:
    with refuses(InputError, "Ridge", "regressor"):
        ScikitLearn(Ridge())
    with refuses(InputError, 3, "regressor"):
        ScikitLearn.fit(3, recorded())
    data = recorded()
    with refuses(InputError, "model"):
        ScikitLearn.fit(Ridge(), Transitions(data.x * np.nan, data.u, data.x_next))
    model = ScikitLearn.fit(Ridge(), data)
    for method in (model.step, model.jacobian):
        with refuses(ShapeError, 3, 2):
            method(np.zeros(2), np.zeros(2))
        with refuses(ShapeError, 1, 2):
            method(np.zeros(1), np.zeros(2))


class Counted:
    """A regressor that counts its predictions; its class is not known, so it has no formula."""

    def __init__(self, inner: Any) -> None:
        self.inner, self.n_features_in_, self.calls = inner, inner.n_features_in_, 0

    def predict(self, rows: np.ndarray) -> np.ndarray:
        self.calls += 1
        return np.asarray(self.inner.predict(rows))


@pytest.mark.parametrize("increments", [True, False])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_the_jacobian_of_a_linear_model_is_exact_and_that_of_a_pipeline_agrees(
    increments: bool, shape: tuple[int, ...]
) -> None:
    exact = ScikitLearn.fit(Ridge(1e-9), recorded(), increments=increments)
    piped = ScikitLearn.fit(make_pipeline(StandardScaler(), Ridge(1e-9)), recorded(), increments=increments)
    x, u = np.full((*shape, 2), 0.3), np.full((*shape, 1), 0.1)
    for found, differenced, true in zip(exact.jacobian(x, u), piped.jacobian(x, u), (TRUTH.A, TRUTH.B), strict=True):
        assert found.shape == true.shape
        assert differenced.shape == (*shape, *true.shape)
        np.testing.assert_allclose(found, true, rtol=0, atol=1e-8)
        np.testing.assert_allclose(differenced, np.broadcast_to(found, differenced.shape), rtol=0, atol=1e-7)


def test_differences_over_a_horizon_and_a_batch_take_one_prediction_and_one_of_the_precision() -> None:
    counted = Counted(Ridge().fit(np.eye(3), np.eye(3)[:, :2]))
    linearize(ScikitLearn(counted), np.zeros((40, 8, 2)), np.zeros((40, 8, 1)))
    assert counted.calls == 2


@pytest.mark.parametrize("increments", [True, False])
@pytest.mark.parametrize("regressor", [RandomForestRegressor(2, random_state=0), GaussianProcessRegressor(alpha=1e-3)])
def test_a_loop_that_diverges_does_not_stop_the_others(regressor: Any, increments: bool) -> None:
    model = ScikitLearn.fit(regressor, recorded(), increments=increments)
    x, u = np.array([[np.nan, 0.0], [0.1, 0.2], [np.inf, 0.0]]), np.full((3, 1), 0.3)
    with np.errstate(all="ignore"):
        found = model.step(x, u)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=-1), [False, True, False])
    np.testing.assert_allclose(found[1], model.step(x[1], u[1]), rtol=0, atol=1e-10)


def test_a_regressor_that_is_fitted_again_has_its_new_jacobian() -> None:
    regressor = Ridge(1e-9)
    model = ScikitLearn.fit(regressor, recorded())
    ScikitLearn.fit(regressor, recorded(Linear(0.5 * TRUTH.A, 2 * TRUTH.B)))
    A, B = model.jacobian(np.zeros(2), np.zeros(1))
    np.testing.assert_allclose(A, 0.5 * TRUTH.A, atol=1e-6)
    np.testing.assert_allclose(B, 2 * TRUTH.B, atol=1e-6)


class Doubled(Ridge):
    """A user's own regressor, which predicts otherwise than its base class."""

    def predict(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(2 * super().predict(rows))


def test_the_coefficients_of_a_users_own_class_are_not_taken_for_its_jacobian() -> None:
    data = recorded()
    A, _ = ScikitLearn.fit(Doubled(1e-9), data, increments=False).jacobian(data.x, data.u)
    np.testing.assert_allclose(A, np.broadcast_to(2 * TRUTH.A, A.shape), rtol=0, atol=1e-7)
