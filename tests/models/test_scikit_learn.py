"""Regressors of scikit-learn as models."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from sklearn.compose import TransformedTargetRegressor
from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    RBF,
    ConstantKernel,
    DotProduct,
    ExpSineSquared,
    Matern,
    RationalQuadratic,
    WhiteKernel,
)
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression, PoissonRegressor, Ridge
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import (
    FunctionTransformer,
    PolynomialFeatures,
    SplineTransformer,
    StandardScaler,
)

from ctxval import Task, Transitions, controllers, testing
from ctxval.core.model import linearize
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear, ScikitLearn
from ctxval.models.scikit_learn import smooth_map
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
def test_the_exact_jacobian_agrees_with_differences_of_predictions(increments: bool, shape: tuple[int, ...]) -> None:
    regressor = make_pipeline(StandardScaler(), PolynomialFeatures(3), Ridge(1e-3))
    model = ScikitLearn.fit(regressor, recorded(), increments=increments)
    rng = np.random.default_rng(3)
    x, u = rng.normal(size=(*shape, 2)), rng.normal(size=(*shape, 1))
    plain = ScikitLearn(Counted(regressor), increments=increments)
    for found, expected in zip(linearize(model, x, u), linearize(plain, x, u), strict=True):
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(model.step(x, u), plain.step(x, u), rtol=0, atol=1e-12)


def test_differences_over_a_horizon_and_a_batch_take_one_prediction_and_one_of_the_precision() -> None:
    counted = Counted(Ridge().fit(np.eye(3), np.eye(3)[:, :2]))
    linearize(ScikitLearn(counted), np.zeros((40, 8, 2)), np.zeros((40, 8, 1)))
    assert counted.calls == 2


def test_many_rows_are_differentiated_in_blocks_with_the_same_result() -> None:
    model = ScikitLearn.fit(GaussianProcessRegressor(optimizer=None, alpha=1e-3), recorded())
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(2500, 2)), rng.normal(size=(2500, 1))
    A, B = model.jacobian(x, u)
    for k in (0, 1023, 1024, 2499):
        alone = model.jacobian(x[k], u[k])
        np.testing.assert_allclose(A[k], alone[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(B[k], alone[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("increments", [True, False])
@pytest.mark.parametrize("regressor", [RandomForestRegressor(2, random_state=0), GaussianProcessRegressor(alpha=1e-3)])
def test_a_loop_that_diverges_does_not_stop_the_others(regressor: Any, increments: bool) -> None:
    model = ScikitLearn.fit(regressor, recorded(), increments=increments)
    x, u = np.array([[np.nan, 0.0], [0.1, 0.2], [np.inf, 0.0]]), np.full((3, 1), 0.3)
    with np.errstate(all="ignore"):
        found = model.step(x, u)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=-1), [False, True, False])
    np.testing.assert_allclose(found[1], model.step(x[1], u[1]), rtol=0, atol=1e-10)


class Refitted(Ridge):
    """A class of scikit-learn in name, whose numbers mean something else."""

    __module__ = "sklearn.linear_model._ridge"

    def predict(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(super().predict(rows) + 1.0)


def test_a_formula_that_does_not_predict_the_same_is_not_used() -> None:
    Refitted.__name__ = "Ridge"
    data = recorded()
    model = ScikitLearn.fit(Refitted(), data)
    expected = model.regressor.predict(np.concatenate([data.x, data.u], axis=1))
    np.testing.assert_allclose(model.step(data.x, data.u), data.x + expected, rtol=0, atol=1e-12)
    assert model.jacobian(data.x, data.u)[0].shape == (60, 2, 2)


def test_a_regressor_that_is_fitted_again_has_its_new_jacobian() -> None:
    regressor = Ridge(1e-9)
    model = ScikitLearn.fit(regressor, recorded())
    ScikitLearn.fit(regressor, recorded(Linear(0.5 * TRUTH.A, 2 * TRUTH.B)))
    A, B = model.jacobian(np.zeros(2), np.zeros(1))
    np.testing.assert_allclose(A, 0.5 * TRUTH.A, atol=1e-6)
    np.testing.assert_allclose(B, 2 * TRUTH.B, atol=1e-6)


# Formulas of regressors against what scikit-learn predicts, and their derivatives against differences of it


RNG = np.random.default_rng(0)
X = RNG.normal(size=(60, 3)) * [1.0, 3.0, 0.5] + [0.0, 1.0, -2.0]
Y = np.stack([np.sin(X[:, 0]) + X[:, 1], X[:, 0] * X[:, 2]], axis=1)
ROWS = X[:6] + 0.1


def network(activation: str, **options: Any) -> MLPRegressor:
    return MLPRegressor(
        hidden_layer_sizes=(8, 7), activation=activation, solver="lbfgs", max_iter=40, random_state=0, **options
    )


def process(kernel: object, **options: Any) -> GaussianProcessRegressor:
    return GaussianProcessRegressor(kernel, optimizer=None, alpha=1e-2, **options)


KNOWN = [
    *(network(activation) for activation in ("relu", "tanh", "logistic", "identity")),
    process(None),
    process(ConstantKernel(2.0) * RBF([1.0, 3.0, 0.5]) + WhiteKernel(0.1), normalize_y=True),
    process(Matern(2.0, nu=2.5) + ConstantKernel(0.5) * RBF(), normalize_y=True),
    *(process(kernel) for kernel in (Matern(2.0, nu=0.5), Matern(2.0, nu=1.5), Matern(2.0, nu=np.inf))),
    process(RBF([1.0, 2.0, 0.7]) * (Matern(0.8, nu=1.5) + RBF(3.0))),
    LinearRegression(),
    Ridge(fit_intercept=False),
    make_pipeline(StandardScaler(), PolynomialFeatures(3), Ridge(0.1)),
    make_pipeline(StandardScaler(with_mean=False), "passthrough", FunctionTransformer(), Ridge()),
    TransformedTargetRegressor(make_pipeline(StandardScaler(), network("tanh")), transformer=StandardScaler()),
    TransformedTargetRegressor(Ridge()),
]


def fitted(regressor: Any, targets: np.ndarray = Y) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # trainings stop at their limit
        return regressor.fit(X, targets)


def name(regressor: Any) -> str:
    return " ".join(repr(regressor).split())[:80]


@pytest.mark.parametrize("regressor", KNOWN, ids=name)
def test_a_formula_predicts_as_its_regressor_with_its_derivatives(regressor: Any) -> None:
    smooth = smooth_map(fitted(regressor))
    assert smooth is not None
    np.testing.assert_allclose(smooth.value(ROWS), regressor.predict(ROWS), rtol=1e-9, atol=1e-11)
    h = 1e-5
    moves = h * np.eye(3)
    differences = [(regressor.predict(ROWS + move) - regressor.predict(ROWS - move)) / (2 * h) for move in moves]
    np.testing.assert_allclose(smooth.expanded(ROWS)[1], np.stack(differences, axis=-1), rtol=1e-6, atol=1e-6)


def test_at_a_centre_the_derivatives_are_finite() -> None:
    for nu in (0.5, 1.5, np.inf):
        smooth = smooth_map(fitted(process(Matern(1.0, nu=nu))))
        assert smooth is not None
        assert np.isfinite(smooth.expanded(X)[1]).all()


def test_a_single_target_is_one_column() -> None:
    for regressor in (LinearRegression(), network("tanh"), process(RBF())):
        smooth = smooth_map(fitted(regressor, Y[:, 0]))
        assert smooth is not None
        np.testing.assert_allclose(smooth.value(ROWS), regressor.predict(ROWS)[:, None], rtol=1e-9)
        assert smooth.expanded(ROWS)[1].shape == (6, 1, 3)


class Doubled(Ridge):
    """A user's own regressor, which predicts otherwise than its base class."""

    def predict(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(2 * super().predict(rows))


@pytest.mark.parametrize(
    "regressor",
    [
        RandomForestRegressor(2, random_state=0),
        Doubled(),
        KernelRidge(kernel="rbf"),
        process(RationalQuadratic()),
        process(ConstantKernel(1e-4) * DotProduct(0.5) ** 3),
        process(Matern(nu=3.2)),
        GaussianProcessRegressor(ExpSineSquared(), optimizer=None, alpha=100.0),
        make_pipeline(SplineTransformer(), Ridge()),
        TransformedTargetRegressor(Ridge(), func=np.arcsinh, inverse_func=np.sinh),
    ],
    ids=name,
)
def test_what_has_no_known_formula_has_none(regressor: Any) -> None:
    assert smooth_map(fitted(regressor)) is None


def test_a_regressor_with_a_link_function_is_not_linear() -> None:
    assert smooth_map(fitted(PoissonRegressor(), np.abs(Y[:, 0]))) is None


def test_what_is_not_fitted_as_a_process_has_no_formula() -> None:
    assert smooth_map(GaussianProcessRegressor()) is None


def test_a_formula_follows_a_regressor_that_is_fitted_again() -> None:
    regressor = fitted(network("tanh"))
    fitted(regressor, 3 * Y)
    smooth = smooth_map(regressor)
    assert smooth is not None
    np.testing.assert_allclose(smooth.value(ROWS), regressor.predict(ROWS), rtol=1e-9)
