"""A scikit-learn regressor as a learned model."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, rows_of
from ctxval._util.registry import part
from ctxval.core.model import central_differences, paired
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError
from ctxval.models.increments import require_finite


@part()
class ScikitLearn:
    """A fitted scikit-learn regressor as a model: a pipeline, a forest, ridge regression, a Gaussian process.

    Its features are the state, then the input. Linear models have an exact Jacobian; all others are differentiated by
    central differences. A forest or nearest neighbours are piecewise constant: their Jacobian is zero, with which LQR
    and iLQR cannot design.

    Args:
        regressor: the fitted regressor, whose ``predict`` maps features ``(N, n + m)`` to ``(N, n)``.
        increments: whether the regressor predicts ``x_next - x`` instead of ``x_next``.
        data: the transitions that the regressor was fitted on, if any.

    Raises:
        InputError: if the regressor is not fitted.
    """

    def __init__(self, regressor: Any, *, increments: bool = True, data: Transitions | None = None) -> None:
        self.regressor, self.increments, self.data = regressor, increments, data
        features = getattr(regressor, "n_features_in_", None)
        if features is None or not callable(getattr(regressor, "predict", None)):
            raise InputError(f"the regressor must be fitted and have predict and n_features_in_, got {regressor!r}.")
        self.features = int(features)

    @classmethod
    def fit(cls, regressor: Any, data: Transitions, *, increments: bool = True) -> ScikitLearn:
        """Fit a regressor on recorded transitions. The regressor itself is fitted, not a copy.

        Raises:
            InputError: if the regressor has no ``fit``.
        """
        require_finite(data)
        if not callable(getattr(regressor, "fit", None)):
            raise InputError(f"the regressor must have fit and predict, got {regressor!r}.")
        targets = data.x_next - data.x if increments else data.x_next
        # scikit-learn expects a single target as a vector, not as a column.
        regressor.fit(np.concatenate([data.x, data.u], axis=1), targets[:, 0] if targets.shape[1] == 1 else targets)
        return cls(regressor, increments=increments, data=data)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states ``(..., n)``, NaN for a pair that is not finite.

        Raises:
            ShapeError: if the regressor predicts another number of states.
        """
        rows, batch = self._rows(x, u)
        finite: Mask = np.asarray(np.isfinite(rows).all(axis=-1, keepdims=True))
        complete = rows if finite.all() else np.where(finite, rows, 0.0)
        outputs = np.asarray(self.regressor.predict(complete), dtype=np.float64).reshape(len(complete), -1)
        if outputs.shape[1] != x.shape[-1]:
            wanted = f"as many states as it takes, {x.shape[-1]}"
            raise ShapeError(f"the regressor must predict {wanted}, got shape {outputs.shape}.")
        outputs = (outputs if finite.all() else np.where(finite, outputs, np.nan)).reshape(*batch, -1)
        return x + outputs if self.increments else outputs

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return A ``(..., n, n)`` and B ``(..., n, m)``, without batch axes if the model is linear."""
        kind, n = type(self.regressor), x.shape[-1]
        if not (kind.__module__.startswith("sklearn.") and kind.__name__ in _LINEAR):
            return central_differences(self.step, x, u)
        self.step(x, u)  # which refuses other numbers of states and inputs
        whole = np.atleast_2d(np.asarray(self.regressor.coef_, dtype=np.float64))
        return (whole[:, :n] + np.eye(n) if self.increments else whole[:, :n]), whole[:, n:]

    def _rows(self, x: Array, u: Array) -> tuple[Array, tuple[int, ...]]:
        n, m = x.shape[-1], u.shape[-1]
        if n + m != self.features:
            raise ShapeError(f"the regressor was fitted on {self.features} features, got {n} states and {m} inputs.")
        pairs = np.concatenate(paired(x, u), axis=-1)
        return rows_of(pairs), pairs.shape[:-1]


_LINEAR = {
    *("ARDRegression", "BayesianRidge", "ElasticNet", "ElasticNetCV", "HuberRegressor", "Lars", "LarsCV", "Lasso"),
    *("LassoCV", "LassoLars", "LassoLarsCV", "LassoLarsIC", "LinearRegression", "LinearSVR", "MultiTaskElasticNet"),
    *("MultiTaskElasticNetCV", "MultiTaskLasso", "MultiTaskLassoCV", "OrthogonalMatchingPursuit"),
    *("OrthogonalMatchingPursuitCV", "QuantileRegressor", "Ridge", "RidgeCV", "SGDRegressor", "TheilSenRegressor"),
}
"""The regressors whose prediction is ``z coef_ + intercept_``."""
