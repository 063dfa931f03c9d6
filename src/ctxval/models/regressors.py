"""The formulas of fitted scikit-learn regressors, as maps whose derivatives are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval.models import kernel_maps as kernels
from ctxval.models.kernel_maps import Kernel, KernelSum
from ctxval.models.smooth_maps import ACTIVATIONS, Affine, Chain, Monomials, Network, Scaled, SideBySide, SmoothMap

_LINEAR = {
    *("ARDRegression", "BayesianRidge", "ElasticNet", "ElasticNetCV", "HuberRegressor", "Lars", "LarsCV", "Lasso"),
    *("LassoCV", "LassoLars", "LassoLarsCV", "LassoLarsIC", "LinearRegression", "LinearSVR", "MultiTaskElasticNet"),
    *("MultiTaskElasticNetCV", "MultiTaskLasso", "MultiTaskLassoCV", "OrthogonalMatchingPursuit"),
    *("OrthogonalMatchingPursuitCV", "QuantileRegressor", "Ridge", "RidgeCV", "SGDRegressor", "TheilSenRegressor"),
}
"""The regressors whose prediction is ``z coef_ + intercept_``."""


def smooth_map(regressor: Any) -> SmoothMap | None:
    """Return the formula of a fitted regressor; None if it is not known, or not differentiable.

    The formula refers to the numbers of the regressor and does not copy them. Classes that users derive from those of
    scikit-learn may predict otherwise, so only the classes themselves are known.
    """
    name = _name(regressor)
    read = _regressor_linear if name in _LINEAR else _REGRESSORS.get(name)
    return None if read is None else read(regressor)


def _name(part: Any) -> str:
    """Return the name of a class of scikit-learn; nothing for all other classes."""
    kind = type(part)
    return kind.__name__ if kind.__module__.startswith("sklearn.") else ""


def _composed(kind: type[Chain | SideBySide], *parts: SmoothMap | None) -> SmoothMap | None:
    known = [part for part in parts if part is not None]
    return kind(known) if len(known) == len(parts) else None


# Regressors


def _regressor_linear(regressor: Any) -> SmoothMap:
    coefficients = np.asarray(regressor.coef_, dtype=np.float64)
    return Affine(np.atleast_2d(coefficients).T, np.atleast_1d(np.asarray(regressor.intercept_, dtype=np.float64)))


def _network(regressor: Any) -> SmoothMap | None:
    if regressor.activation not in ACTIVATIONS or regressor.out_activation_ != "identity":
        return None
    return Network(regressor.coefs_, regressor.intercepts_, regressor.activation)


def _gaussian_process(regressor: Any) -> SmoothMap | None:
    centres = getattr(regressor, "X_train_", None)
    kernel = None if centres is None else _covariance(regressor.kernel_)
    if kernel is None or not isinstance(centres, np.ndarray) or centres.ndim != 2:
        return None
    output = Scaled(regressor._y_train_std, regressor._y_train_mean)
    return Chain([KernelSum(kernel, centres, _columns(regressor.alpha_)), output])


def _kernel_ridge(regressor: Any) -> SmoothMap | None:
    centres = regressor.X_fit_
    kernel = _ridge_kernel(regressor, centres.shape[1]) if isinstance(centres, np.ndarray) else None
    return None if kernel is None else KernelSum(kernel, centres, _columns(regressor.dual_coef_))


def _ridge_kernel(regressor: Any, features: int) -> Kernel | None:
    gamma = 1.0 / features if regressor.gamma is None else float(regressor.gamma)
    shift, degree = regressor.coef0, regressor.degree
    match regressor.kernel:
        case "rbf":
            return kernels.squared_exponential(float((2 * gamma) ** -0.5))
        case "linear":
            return kernels.of_products(lambda p: p, lambda p: 1.0)
        case "poly" | "polynomial":
            return kernels.of_products(
                lambda p: (gamma * p + shift) ** degree, lambda p: gamma * degree * (gamma * p + shift) ** (degree - 1)
            )
        case "sigmoid":
            return kernels.of_products(
                lambda p: np.tanh(gamma * p + shift), lambda p: gamma / np.cosh(gamma * p + shift) ** 2
            )
    return None


def _several_outputs(regressor: Any) -> SmoothMap | None:
    return _composed(SideBySide, *map(smooth_map, regressor.estimators_))


def _pipeline(regressor: Any) -> SmoothMap | None:
    *before, (_, last) = regressor.steps
    used = [part for _, part in before if part is not None and part != "passthrough"]
    return _composed(Chain, *map(_transformer, used), smooth_map(last))


def _transformed_target(regressor: Any) -> SmoothMap | None:
    forward = _scaler(regressor.transformer_)
    inverse = None if forward is None else Scaled(1.0 / forward.scale, -forward.shift / forward.scale)
    return _composed(Chain, smooth_map(regressor.regressor_), inverse)


def _columns(weights: Array) -> Array:
    return weights[:, None] if weights.ndim == 1 else weights


_REGRESSORS: dict[str, Callable[[Any], SmoothMap | None]] = {
    "MLPRegressor": _network,
    "GaussianProcessRegressor": _gaussian_process,
    "KernelRidge": _kernel_ridge,
    "MultiOutputRegressor": _several_outputs,
    "Pipeline": _pipeline,
    "TransformedTargetRegressor": _transformed_target,
}


# Transformers of features and targets


def _transformer(part: Any) -> SmoothMap | None:
    """Return a transformer of features as a map; None if it is not known."""
    if _name(part) == "PolynomialFeatures":
        return Monomials(part.powers_)
    if _name(part) == "PCA" and not part.whiten:
        return Affine(part.components_.T, -part.mean_ @ part.components_.T)
    return _scaler(part)


def _scaler(part: Any) -> Scaled | None:
    """Return a scaler of columns as a map; None if it is not known."""
    match _name(part):
        case "MinMaxScaler" if not part.clip:
            return Scaled(part.scale_, part.min_)
        case "StandardScaler":
            return _centred(part.mean_ if part.with_mean else None, part.scale_)
        case "RobustScaler":
            centre, scale = part.with_centering, part.with_scaling
            return _centred(part.center_ if centre else None, part.scale_ if scale else None)
        case "MaxAbsScaler" if not getattr(part, "clip", False):
            return _centred(None, part.scale_)
        case "FunctionTransformer" if part.func is None and part.inverse_func is None:
            return Scaled(1.0, 0.0)
    return None


def _centred(centre: Array | None, scale: Array | None) -> Scaled:
    factor = 1.0 if scale is None else 1.0 / scale
    return Scaled(factor, 0.0 if centre is None else -centre * factor)


# Kernels of Gaussian processes


def _covariance(kernel: Any) -> Kernel | None:
    """Return a kernel of ``sklearn.gaussian_process`` between new points and known ones; None if it is not known."""
    match _name(kernel):
        case "ConstantKernel":
            return kernels.constant(float(kernel.constant_value))
        case "WhiteKernel":
            return kernels.constant(0.0)  # its noise is not shared with a new point
        case "RBF":
            return kernels.squared_exponential(kernel.length_scale)
        case "Matern":
            return kernels.matern(kernel.length_scale, kernel.nu)
        case "RationalQuadratic":
            return kernels.rational_quadratic(kernel.length_scale, kernel.alpha)
        case "DotProduct":
            offset = float(kernel.sigma_0) ** 2
            return kernels.of_products(lambda p: p + offset, lambda p: 1.0)
        case "Sum" | "Product" as name:
            first, second = _covariance(kernel.k1), _covariance(kernel.k2)
            if first is None or second is None:
                return None
            return (kernels.total if name == "Sum" else kernels.product)(first, second)
        case "Exponentiation":
            base = _covariance(kernel.kernel)
            return None if base is None else kernels.power(base, kernel.exponent)
    return None
