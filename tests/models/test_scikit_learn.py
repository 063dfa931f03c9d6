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
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from ctxval import Task, Transitions, controllers, testing
from ctxval._util.describe import describe, first_difference
from ctxval.core.model import linearize
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear, ScikitLearn

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
    A, B = linearize(model, x, u)
    np.testing.assert_allclose(A[0], TRUTH.A, atol=1e-8)
    np.testing.assert_allclose(B[0], TRUTH.B, atol=1e-8)


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
    assert first_difference(describe(model), describe(ScikitLearn(regressor))) is None


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


def test_the_description_tells_fits_apart() -> None:
    first, second = Ridge().fit(np.eye(3), np.eye(3)[:, :2]), Ridge().fit(np.eye(3), np.eye(3)[:, 1:])
    assert first_difference(describe(ScikitLearn(first)), describe(ScikitLearn(second))) is not None


def test_what_cannot_be_used_is_refused() -> None:
    with pytest.raises(InputError, match=r"must be fitted and have predict .* got Ridge\(\)"):
        ScikitLearn(Ridge())
    with pytest.raises(InputError, match="must have fit and predict, got 3"):
        ScikitLearn.fit(3, recorded())
    data = recorded()
    with pytest.raises(InputError, match="finite transitions"):
        ScikitLearn.fit(Ridge(), Transitions(data.x * np.nan, data.u, data.x_next))
    model = ScikitLearn.fit(Ridge(), data)
    with pytest.raises(ShapeError, match="fitted on 3 features, got 2 states and 2 inputs"):
        model.step(np.zeros(2), np.zeros(2))
    with pytest.raises(ShapeError, match=r"must predict as many states as it takes, 1, got shape \(1, 2\)"):
        model.step(np.zeros(1), np.zeros(2))
