"""A scikit-learn regressor as a learned model."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, rows_of
from ctxval._util.registry import part
from ctxval.core.model import central_differences, paired
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError
from ctxval.models import smooth_maps as maps
from ctxval.models.increments import require_finite
from ctxval.models.smooth_maps import Kernel, Slope, Slopes, SmoothMap


@part()
class ScikitLearn:
    """A fitted scikit-learn regressor as a model: a pipeline, a forest, ridge regression, a Gaussian process.

    Its features are the state, then the input. Networks, Gaussian processes, linear models, and pipelines of these with
    standard scalers and polynomial features, have an exact Jacobian from their formula; all others are differentiated
    by central differences. A forest or nearest neighbours are piecewise constant: their Jacobian is
    zero, with which LQR and iLQR cannot design.

    Args:
        regressor: the fitted regressor, whose ``predict`` maps features ``(N, n + m)`` to ``(N, n)``.
        increments: whether the regressor predicts ``x_next - x`` instead of ``x_next``.
        data: the transitions that the regressor was fitted on, if any.
    """

    def __init__(self, regressor: Any, *, increments: bool = True, data: Transitions | None = None) -> None:
        self.regressor, self.increments, self.data = regressor, increments, data
        features = getattr(regressor, "n_features_in_", None)
        if features is None or not callable(getattr(regressor, "predict", None)):
            raise InputError(f"the regressor must be fitted and have predict and n_features_in_, got {regressor!r}.")
        self.features = int(features)
        # Whether the formula gives what the regressor predicts, at some points: another release of scikit-learn may
        # give the numbers another meaning.
        self._known = False
        if (formula := smooth_map(regressor)) is not None:
            rows = np.random.default_rng(0).normal(size=(8, self.features))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of feature names
                predicted = _as_columns(regressor.predict(rows))
            values, largest = formula.value(rows), float(np.abs(predicted).max())
            same = values.shape == predicted.shape
            self._known = same and np.allclose(values, predicted, rtol=1e-4, atol=1e-4 * largest)

    @classmethod
    def fit(cls, regressor: Any, data: Transitions, *, increments: bool = True) -> ScikitLearn:
        """Fit a regressor on recorded transitions. The regressor itself is fitted, not a copy."""
        require_finite(data)
        if not callable(getattr(regressor, "fit", None)):
            raise InputError(f"the regressor must have fit and predict, got {regressor!r}.")
        targets = data.x_next - data.x if increments else data.x_next
        # scikit-learn expects a single target as a vector, not as a column.
        regressor.fit(np.concatenate([data.x, data.u], axis=1), targets[:, 0] if targets.shape[1] == 1 else targets)
        return cls(regressor, increments=increments, data=data)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states ``(..., n)``, NaN for a pair that is not finite."""
        rows, batch = self._rows(x, u)
        finite: Mask = np.asarray(np.isfinite(rows).all(axis=-1, keepdims=True))
        complete = rows if finite.all() else np.where(finite, rows, 0.0)
        formula = self._formula()  # it gives what ``predict`` gives, without its checks, which take longer on few rows
        outputs = formula.value(complete) if formula else _as_columns(self.regressor.predict(complete))
        _require_states(outputs, x.shape[-1])
        outputs = (outputs if finite.all() else np.where(finite, outputs, np.nan)).reshape(*batch, -1)
        return x + outputs if self.increments else outputs

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return A ``(..., n, n)`` and B ``(..., n, m)``, without batch axes if the model is linear."""
        rows, batch = self._rows(x, u)
        formula, n = self._formula(), x.shape[-1]
        if formula is None:
            return central_differences(self.step, x, u)
        if formula.constant:
            rows, batch = np.zeros((1, self.features)), ()
        whole = formula.expanded(rows)[1]
        _require_states(whole, n)
        whole = whole.reshape(*batch, *whole.shape[1:])
        A, B = whole[..., :n], whole[..., n:]
        return (A + np.eye(n) if self.increments else A), B

    def _rows(self, x: Array, u: Array) -> tuple[Array, tuple[int, ...]]:
        n, m = x.shape[-1], u.shape[-1]
        if n + m != self.features:
            raise ShapeError(f"the regressor was fitted on {self.features} features, got {n} states and {m} inputs.")
        pairs = np.concatenate(paired(x, u), axis=-1)
        return rows_of(pairs), pairs.shape[:-1]

    def _formula(self) -> SmoothMap | None:
        # It is read again each time, because a regressor may be fitted again.
        return smooth_map(self.regressor) if self._known else None


def _require_states(outputs: Array, n: int) -> None:
    if outputs.shape[1] != n:
        raise ShapeError(f"the regressor must predict as many states as it takes, {n}, got shape {outputs.shape}.")


def _as_columns(output: Any) -> Array:
    values = np.asarray(output, dtype=np.float64)
    return values[:, None] if values.ndim == 1 else values


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
    match _name(regressor):
        case name if name in _LINEAR:
            coefficients = np.asarray(regressor.coef_, dtype=np.float64)
            constants = np.atleast_1d(np.asarray(regressor.intercept_, dtype=np.float64))
            return maps.affine(np.atleast_2d(coefficients).T, constants)
        case "MLPRegressor":
            if regressor.activation not in maps.ACTIVATIONS or regressor.out_activation_ != "identity":
                return None
            return maps.network(regressor.coefs_, regressor.intercepts_, regressor.activation)
        case "GaussianProcessRegressor":
            centres = getattr(regressor, "X_train_", None)
            kernel = None if centres is None else _covariance(regressor.kernel_)
            if kernel is None or not isinstance(centres, np.ndarray) or centres.ndim != 2:
                return None
            process = maps.kernel_sum(kernel, centres, _as_columns(regressor.alpha_))
            return maps.chain([process, maps.scaled(regressor._y_train_std, regressor._y_train_mean)])
        case "Pipeline":
            *before, (_, last) = regressor.steps
            used = [part for _, part in before if part is not None and part != "passthrough"]
            return _chained([*map(_transformer, used), smooth_map(last)])
        case "TransformedTargetRegressor":
            forward = _scaler(regressor.transformer_)
            inverse = None if forward is None else maps.scaled(1.0 / forward[0], -forward[1] / forward[0])
            return _chained([smooth_map(regressor.regressor_), inverse])
    return None


def _name(part: Any) -> str:
    """Return the name of a class of scikit-learn; nothing for all other classes."""
    kind = type(part)
    return kind.__name__ if kind.__module__.startswith("sklearn.") else ""


def _chained(parts: Sequence[SmoothMap | None]) -> SmoothMap | None:
    known = [part for part in parts if part is not None]
    return maps.chain(known) if len(known) == len(parts) else None


# Transformers of features and targets


def _transformer(part: Any) -> SmoothMap | None:
    if _name(part) == "PolynomialFeatures":
        return maps.monomials(part.powers_)
    scaler = _scaler(part)
    return None if scaler is None else maps.scaled(*scaler)


def _scaler(part: Any) -> tuple[Array | float, Array | float] | None:
    """Return the scale and the shift by which a scaler transforms columns; None if it is not known."""
    match _name(part):
        case "StandardScaler":
            factor = 1.0 if part.scale_ is None else 1.0 / part.scale_
            return factor, -part.mean_ * factor if part.with_mean else 0.0
        case "FunctionTransformer" if part.func is None and part.inverse_func is None:
            return 1.0, 0.0
    return None


# Kernels between new points and known ones


def _covariance(kernel: Any) -> Kernel | None:
    match _name(kernel):
        case "ConstantKernel":
            value = float(kernel.constant_value)
            return lambda Z, X: (value, list)
        case "WhiteKernel":
            return lambda Z, X: (0.0, list)  # its noise is not shared with a new point
        case "RBF":
            return maps.matern(kernel.length_scale, np.inf)
        case "Matern" if kernel.nu in (0.5, 1.5, 2.5, np.inf):
            return maps.matern(kernel.length_scale, kernel.nu)
        case "Sum" | "Product" as name:
            first, second = _covariance(kernel.k1), _covariance(kernel.k2)
            return first and second and _joined(first, second, is_sum=name == "Sum")
    return None


def _times(slopes: list[Slope], other: Array | float) -> list[Slope]:
    return [(factor * other, pull, weight) for factor, pull, weight in slopes]


def _joined(first: Kernel, second: Kernel, *, is_sum: bool) -> Kernel:
    def kernel(Z: Array, X: Array) -> tuple[Array | float, Slopes]:
        (K, slopes), (L, other_slopes) = first(Z, X), second(Z, X)
        if is_sum:
            return K + L, lambda: [*slopes(), *other_slopes()]
        return K * L, lambda: [*_times(slopes(), L), *_times(other_slopes(), K)]

    return kernel
