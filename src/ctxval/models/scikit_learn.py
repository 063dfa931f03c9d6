"""A scikit-learn regressor as a learned model."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.registry import part
from ctxval._util.representation import call, name_of
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError


@part()
class ScikitLearn:
    """A fitted scikit-learn regressor as a model: a pipeline, a forest, ridge regression, a Gaussian process.

    Its features are the state, then the input. Its Jacobian is taken by central differences, so the regressor must be
    smooth for LQR and iLQR: a forest or nearest neighbours are piecewise constant, and their Jacobian is zero.

    Args:
        regressor: the fitted regressor, whose ``predict`` maps features ``(N, n + m)`` to ``(N, n)``.
        increments: whether the regressor predicts ``x_next - x`` instead of ``x_next``.
        data: the transitions that the regressor was fitted on, if any.

    Raises:
        InputError: if the value is not a regressor, or is not fitted.
    """

    def __init__(self, regressor: Any, *, increments: bool = True, data: Transitions | None = None) -> None:
        self.regressor = regressor
        self.increments = increments
        self.data = data
        features = getattr(regressor, "n_features_in_", None)
        if features is None or not callable(getattr(regressor, "predict", None)):
            raise InputError(f"the regressor must be fitted and have predict and n_features_in_, got {regressor!r}.")
        self.features = int(features)

    @classmethod
    def fit(cls, regressor: Any, data: Transitions, *, increments: bool = True) -> ScikitLearn:
        """Fit a regressor on recorded transitions. The regressor itself is fitted, not a copy.

        Raises:
            InputError: if there are no data, they are not finite, or the value is not a regressor.
        """
        if not len(data) or not all(np.isfinite(part).all() for part in (data.x, data.u, data.x_next)):
            raise InputError("a model needs finite transitions to be learned from, got none, NaN or infinity.")
        if not callable(getattr(regressor, "fit", None)):
            raise InputError(f"the regressor must have fit and predict, got {regressor!r}.")
        targets = data.x_next - data.x if increments else data.x_next
        # scikit-learn expects a single target as a vector, not as a column.
        regressor.fit(np.concatenate([data.x, data.u], axis=1), targets[:, 0] if targets.shape[1] == 1 else targets)
        return cls(regressor, increments=increments, data=data)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``.

        Raises:
            ShapeError: if the regressor was fitted on other numbers of states and inputs.
        """
        n, width = x.shape[-1], x.shape[-1] + u.shape[-1]
        if width != self.features:
            raise ShapeError(
                f"the regressor was fitted on {self.features} features, got {n} states and {width - n} inputs."
            )
        batch = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        pairs = np.empty((*batch, width))
        pairs[..., :n], pairs[..., n:] = x, u
        output = np.asarray(self.regressor.predict(pairs.reshape(-1, width)), dtype=np.float64)
        if output.shape not in ((int(np.prod(batch)), n), *([(int(np.prod(batch)),)] if n == 1 else [])):
            raise ShapeError(f"the regressor must predict as many states as it takes, {n}, got shape {output.shape}.")
        output = output.reshape(*batch, n)
        return x + output if self.increments else output

    def describe(self) -> dict[str, Any]:
        """Return what identifies this model in a store: its kind and its predictions at some points."""
        probes = np.random.default_rng(0).normal(size=(3, self.features))
        return {
            "regressor": type(self.regressor).__qualname__,
            "features": self.features,
            "increments": self.increments,
            "predictions": np.asarray(self.regressor.predict(probes), dtype=np.float64),
        }

    def __repr__(self) -> str:
        learned = None if self.data is None else len(self.data)
        regressor = name_of(type(self.regressor))
        return call(self, regressor, features=self.features, increments=self.increments, transitions=learned)
