"""A linear model learned from data."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, single_threaded
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError

_LARGEST_CONDITION = 1e8  # half of the digits of a double; beyond it rounding and noise determine the weights


@part()
class Linear(ShortRepr):
    """The model ``x_next = A x + B u + c``.

    Args:
        A: matrix of the states, shape ``(n, n)``.
        B: matrix of the inputs, shape ``(n, m)``.
        c: constant term, shape ``(n,)``; zero by default.
        data: the transitions that the model was learned from, if any.
    """

    def __init__(self, A: ArrayLike, B: ArrayLike, c: ArrayLike | None = None, data: Transitions | None = None) -> None:
        self.A: Array = as_finite("A", A)
        self.B: Array = as_finite("B", B)
        n = len(self.A) if self.A.ndim else 0
        self.c: Array = np.zeros(n) if c is None else as_finite("c", c)
        self.data = data
        if self.A.shape != (n, n) or self.B.ndim != 2 or len(self.B) != n or self.c.shape != (n,):
            raise ShapeError(
                "a linear model needs A (n, n), B (n, m) and c (n,), "
                f"got {self.A.shape}, {self.B.shape} and {self.c.shape}."
            )
        if data is not None and (data.x.shape[1], data.u.shape[1]) != self.B.shape:
            raise ShapeError(
                f"the model has {n} states and {self.B.shape[1]} inputs, and its data have {data.x.shape[1]} states "
                f"and {data.u.shape[1]} inputs."
            )

    @classmethod
    def fit(cls, data: Transitions, *, intercept: bool = True) -> Linear:
        """Fit A, B and c by least squares on recorded transitions; without an intercept, c is zero."""
        n, m = data.x.shape[1], data.u.shape[1]
        if not all(np.isfinite(array).all() for array in (data.x, data.u, data.x_next)):
            raise InputError("a linear model needs finite transitions, got NaN or infinity.")
        columns = [data.x, data.u, *([np.ones((len(data), 1))] if intercept else [])]
        regressors = np.concatenate(columns, axis=1)
        with single_threaded():
            weights, _, rank, _ = np.linalg.lstsq(regressors, data.x_next)
        if rank < regressors.shape[1]:
            raise InputError(
                f"the data do not determine a linear model: {len(data)} transitions of {n} states and {m} inputs "
                f"have rank {rank}, and {regressors.shape[1]} is needed; excite every state and input."
            )
        _require_identifiable(regressors, n, m)
        return cls(weights[:n].T, weights[n : n + m].T, weights[n + m] if intercept else None, data)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        try:
            return np.asarray(x @ self.A.T + u @ self.B.T + self.c)
        except ValueError as error:
            raise ShapeError(
                f"the model has {len(self.A)} states and {self.B.shape[1]} inputs, got states of shape {np.shape(x)} "
                f"and inputs of shape {np.shape(u)}."
            ) from error

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return A and B, which are the same for all states and inputs."""
        return self.A, self.B


def _require_identifiable(regressors: Array, n: int, m: int) -> None:
    """Check that no regressor is nearly a linear combination of the others, independently of units."""
    scaled = regressors / np.linalg.norm(regressors, axis=0)
    with single_threaded():
        _, sizes, directions = np.linalg.svd(scaled, full_matrices=False)
    if sizes[0] <= _LARGEST_CONDITION * sizes[-1]:
        return
    names = [*(f"x{i}" for i in range(n)), *(f"u{i}" for i in range(m)), "the constant"]
    together = [names[i] for i in np.flatnonzero(np.abs(directions[-1]) > 0.1)]
    raise InputError(
        f"the data hardly determine a linear model: {' and '.join(together)} depend on each other in all transitions "
        f"(condition {sizes[0] / sizes[-1]:.1e}, at most {_LARGEST_CONDITION:.0e}); excite them independently, "
        "for example without feedback."
    )
