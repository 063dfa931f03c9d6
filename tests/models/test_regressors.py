"""Formulas of regressors against what scikit-learn predicts, and their derivatives against differences of it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from sklearn.compose import TransformedTargetRegressor
from sklearn.decomposition import PCA
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
from sklearn.linear_model import BayesianRidge, LinearRegression, PoissonRegressor, Ridge
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import (
    FunctionTransformer,
    MaxAbsScaler,
    MinMaxScaler,
    PolynomialFeatures,
    RobustScaler,
    SplineTransformer,
    StandardScaler,
)

from ctxval.models.scikit_learn import smooth_map

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
    process(Matern(2.0, nu=2.5) + ConstantKernel(0.5) * DotProduct(), normalize_y=True),
    *(process(kernel) for kernel in (Matern(2.0, nu=0.5), Matern(2.0, nu=1.5), Matern(2.0, nu=np.inf))),
    process(RBF([1.0, 2.0, 0.7]) * (Matern(0.8, nu=1.5) + DotProduct())),
    *(KernelRidge(alpha=0.1, kernel=kernel, gamma=0.3) for kernel in ("rbf", "linear", "poly", "polynomial")),
    KernelRidge(kernel="rbf"),
    LinearRegression(),
    Ridge(fit_intercept=False),
    make_pipeline(StandardScaler(), PolynomialFeatures(3), Ridge(0.1)),
    make_pipeline(MinMaxScaler(), RobustScaler(), MaxAbsScaler(), "passthrough", PCA(2), KernelRidge(kernel="rbf")),
    make_pipeline(StandardScaler(with_mean=False), RobustScaler(with_scaling=False), FunctionTransformer(), Ridge()),
    TransformedTargetRegressor(make_pipeline(StandardScaler(), network("tanh")), transformer=StandardScaler()),
    TransformedTargetRegressor(Ridge(), transformer=MinMaxScaler((-1, 1))),
    TransformedTargetRegressor(Ridge()),
    MultiOutputRegressor(process(RBF())),
    MultiOutputRegressor(BayesianRidge()),
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
    for regressor in (LinearRegression(), network("tanh"), process(RBF()), KernelRidge(kernel="rbf")):
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
        KernelRidge(kernel="laplacian"),
        process(RationalQuadratic()),
        process(ConstantKernel(1e-4) * DotProduct(0.5) ** 3),
        process(Matern(nu=3.2)),
        GaussianProcessRegressor(ExpSineSquared(), optimizer=None, alpha=100.0),
        make_pipeline(SplineTransformer(), Ridge()),
        make_pipeline(MinMaxScaler(clip=True), Ridge()),
        make_pipeline(PCA(2, whiten=True), Ridge()),
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
