"""A scikit-learn regressor as a learned model."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask, rows_of
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.model import central_differences, paired
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError
from ctxval.models.regressors import smooth_map
from ctxval.models.scaling import require_finite
from ctxval.models.smooth_maps import SmoothMap


@part()
class ScikitLearn(ShortRepr):
    """A fitted scikit-learn regressor as a model: a pipeline, a forest, ridge regression, a Gaussian process.

    Its features are the state, then the input. Networks, Gaussian processes, kernel ridge regression, linear models,
    and pipelines of these with scalers and polynomial features, have an exact Jacobian from their formula; all others
    are differentiated by central differences. A forest or nearest neighbours are piecewise constant: their Jacobian is
    zero, with which LQR and iLQR cannot design.

    Args:
        regressor: the fitted regressor, whose ``predict`` maps features ``(N, n + m)`` to ``(N, n)``.
        increments: whether the regressor predicts ``x_next - x`` instead of ``x_next``.
        data: the transitions that the regressor was fitted on, if any.
    """

    def __init__(self, regressor: Any, *, increments: bool = True, data: Transitions | None = None) -> None:
        self.regressor = regressor
        self.increments = increments
        self.data = data
        features = getattr(regressor, "n_features_in_", None)
        if features is None or not callable(getattr(regressor, "predict", None)):
            raise InputError(f"the regressor must be fitted and have predict and n_features_in_, got {regressor!r}.")
        self.features = int(features)
        self._known = _predicts_the_same(regressor, smooth_map(regressor), self.features)

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
        """Return the next states ``(..., n)``, NaN for a pair that is not finite.

        The formula gives what ``predict`` gives, without its checks, which take longer than the formula on few rows.
        """
        rows, batch = self._rows(x, u)
        finite: Mask = np.asarray(np.isfinite(rows).all(axis=-1, keepdims=True))
        complete = rows if finite.all() else np.where(finite, rows, 0.0)
        formula = self._formula()
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


def _predicts_the_same(regressor: Any, formula: SmoothMap | None, features: int) -> bool:
    """Return whether a formula gives what the regressor predicts, at some points.

    It guards against releases of scikit-learn with another meaning of the numbers.
    """
    if formula is None:
        return False
    rows = np.random.default_rng(0).normal(size=(8, features))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of feature names
        predicted = _as_columns(regressor.predict(rows))
    values = formula.value(rows)
    scale = float(np.abs(predicted).max())
    return values.shape == predicted.shape and np.allclose(values, predicted, rtol=1e-4, atol=1e-4 * scale)
