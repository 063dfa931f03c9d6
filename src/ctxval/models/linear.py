"""Linear models: learned from data, or state-space models of python-control and of scipy."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, single_threaded
from ctxval._util.checked import Seconds, require
from ctxval._util.registry import part
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ShapeError


@part()
class Linear:
    """The model ``x_next = A x + B u + c``.

    Args:
        A: matrix of the states, shape ``(n, n)``.
        B: matrix of the inputs, shape ``(n, m)``.
        c: constant term, shape ``(n,)``; zero by default.
        data: the transitions that the model was learned from, if any.

    Raises:
        ShapeError: if the matrices, or the data, do not fit together.
    """

    def __init__(self, A: ArrayLike, B: ArrayLike, c: ArrayLike | None = None, data: Transitions | None = None) -> None:
        self.A: Array = as_finite("A", A)
        self.B: Array = as_finite("B", B)
        n = len(self.A) if self.A.ndim else 0
        self.c: Array = np.zeros(n) if c is None else as_finite("c", c)
        self.data = data
        if self.A.shape != (n, n) or self.B.ndim != 2 or len(self.B) != n or self.c.shape != (n,):
            got = f"{self.A.shape}, {self.B.shape} and {self.c.shape}"
            raise ShapeError(f"a linear model needs A (n, n), B (n, m) and c (n,), got {got}.")
        if data is not None and (data.x.shape[1], data.u.shape[1]) != self.B.shape:
            got = f"{data.x.shape[1]} states and {data.u.shape[1]} inputs"
            raise ShapeError(f"the model has {n} states and {self.B.shape[1]} inputs, and its data have {got}.")

    @classmethod
    def fit(cls, data: Transitions, *, intercept: bool = True) -> Linear:
        """Fit A, B and c by least squares on recorded transitions; without an intercept, c is zero.

        Raises:
            InputError: if the data are not finite, or determine no model.
        """
        require("data", Transitions, data)
        n, m = data.x.shape[1], data.u.shape[1]
        if not all(np.isfinite(array).all() for array in (data.x, data.u, data.x_next)):
            raise InputError("a linear model needs finite transitions, got NaN or infinity.")
        columns = [data.x, data.u, *([np.ones((len(data), 1))] if intercept else [])]
        regressors = np.concatenate(columns, axis=1)
        with single_threaded(scipy=False):
            weights, _, rank, _ = np.linalg.lstsq(regressors, data.x_next)
        if rank < regressors.shape[1]:
            have = f"{len(data)} transitions of {n} states and {m} inputs have rank {rank}"
            needed = f"{regressors.shape[1]} is needed; excite every state and input"
            raise InputError(f"the data do not determine a linear model: {have}, and {needed}.")
        # No regressor may nearly be a linear combination of the others, independently of units.
        with single_threaded(scipy=False):
            _, sizes, directions = np.linalg.svd(regressors / np.linalg.norm(regressors, axis=0), full_matrices=False)
        if sizes[0] > 1e8 * sizes[-1]:  # half of the digits; beyond it rounding and noise determine the weights
            names = [*(f"x{i}" for i in range(n)), *(f"u{i}" for i in range(m)), "the constant"]
            together = [names[i] for i in np.flatnonzero(np.abs(directions[-1]) > 0.1)]
            raise InputError(
                f"the data hardly determine a linear model: {' and '.join(together)} depend on each other in all "
                f"transitions (condition {sizes[0] / sizes[-1]:.1e}, at most 1e+08); excite them independently."
            )
        return cls(weights[:n].T, weights[n : n + m].T, weights[n + m] if intercept else None, data)

    def step(self, x: Array, u: Array) -> Array:
        try:
            return np.asarray(x @ self.A.T + u @ self.B.T + self.c)
        except ValueError as error:
            got = f"states of shape {np.shape(x)} and inputs of shape {np.shape(u)}"
            raise ShapeError(f"the model has {len(self.A)} states and {self.B.shape[1]} inputs, got {got}.") from error

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        return self.A, self.B


@part()
def state_space(system: Any, dt: Seconds) -> Linear:
    """Return a ``StateSpace`` of python-control or of scipy as a linear model with its Jacobian.

    The model has the state of the system, so C must be the identity and D must be 0, if there are any. A continuous
    system, whose own dt is 0 or None, is discretised exactly for inputs that are held over a step. A discrete system
    whose dt is True has any time step.

    Raises:
        InputError: if C, D or dt are not those of a model.
        ShapeError: if A and B do not fit together.
    """
    if not all(hasattr(system, name) for name in ("A", "B")):
        raise InputError(f"a state-space model must have A and B, got {system!r}.")
    A, B = as_finite("A", system.A), as_finite("B", system.B)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or B.ndim != 2 or len(B) != len(A):
        raise ShapeError(f"a state-space model needs A (n, n) and B (n, m), got {A.shape} and {B.shape}.")
    n, m = B.shape
    C, D = (as_finite(name, getattr(system, name, default)) for name, default in (("C", np.eye(n)), ("D", 0.0)))
    if not np.array_equal(C, np.eye(n)) or D.any():
        got = f"C = {C.tolist()} and D = {D.tolist()}"
        raise InputError(
            f"C must be the identity and D must be 0, because a model returns states of the system, got {got}: make "
            "the system of A and B alone, and give outputs=lambda x: x @ C.T to the validation if S records C x."
        )
    step = getattr(system, "dt", None)
    if not step:
        from scipy.linalg import expm

        # For an input that is held over dt: the exponential of [[A, B], [0, 0]] dt.
        whole = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)
        return Linear(whole[:n, :n], whole[:n, n:])
    if step is not True and not np.isclose(step, dt, rtol=1e-9, atol=0):
        raise InputError(f"dt must be that of the discrete system, {step:g} s, got {dt:g} s.")
    return Linear(A, B)
