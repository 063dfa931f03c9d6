"""Tubes of linear models under affine feedback, and limits that leave room for them.

If ``x' = A x + B u + w`` with w in a box W and ``u = v_t + K_t (x - z_t)``, the error ``e = x - z`` to the closed loop
z of the model follows ``e' = (A + B K_t) e + w``, so that it lies in a sum of images of W. The support function of a
box with half-widths w in direction c is ``|c| w``, and those of the images add up exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite
from ctxval._util.checked import checked
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import AffineFeedback, Limits, LimitsLike
from ctxval.core.model import linearize
from ctxval.core.plan import Plan
from ctxval.core.validation import Validation
from ctxval.errors import InputError, ShapeError
from ctxval.studies.safety.disturbance import Disturbance


@dataclass(frozen=True, eq=False)
class Tube(ShortRepr):
    """How far states and inputs of S are from those of M at most, if every disturbance lies in a box."""

    states: Array  #: half-widths of the states at each time, ``(H + 1, n)``
    inputs: Array  #: half-widths of the inputs at each step, ``(H, m)``
    loops: Array  #: the matrices ``A + B K_t`` of the closed loop, ``(H, n, n)``
    half_widths: Array  #: the box of disturbances, ``(n,)``

    def support(self, direction: ArrayLike) -> Array:
        """Return the largest error in a direction ``(n,)`` at each time, ``(H + 1,)``."""
        c = as_finite("direction", direction)
        if c.shape != self.half_widths.shape:
            raise ShapeError(f"direction must have shape {self.half_widths.shape}, got {c.shape}.")
        return np.array([float((np.abs(c @ each) @ self.half_widths).sum()) for each in _transitions(self.loops)])

    def tightened(self, limits: LimitsLike, of: str = "states") -> Limits:
        """Return limits of the ``states`` or ``inputs`` of M that keep those of S within given limits.

        An InputError says that nothing is left between them.
        """
        if of not in ("states", "inputs"):
            raise InputError(f"of must be 'states' or 'inputs', got {of!r}.")
        widths = (self.states if of == "states" else self.inputs).max(axis=0, initial=0.0)
        given = Limits.of(limits, len(widths))
        low, high = given.low + widths, given.high - widths
        if not (low < high).all():
            i = int(np.argmin(high - low))
            raise InputError(
                f"nothing is left between the limits {given.low[i]:g} and {given.high[i]:g} of {of[:-1]} {i}: the tube "
                f"needs {widths[i]:.4g} on each side."
            )
        return Limits(low, high)


@checked
def tube(A: Any, B: Any, gains: Any, half_widths: Any) -> Tube:
    """Return the tube of ``x' = A x + B u + w`` for gains K ``(H, m, n)`` and ``|w| <= half_widths`` ``(n,)``."""
    A, B, K, w = (
        as_finite(name, value) for name, value in (("A", A), ("B", B), ("gains", gains), ("half_widths", half_widths))
    )
    n, m = len(w), B.shape[-1]
    if A.shape != (n, n) or B.shape != (n, m) or K.ndim != 3 or K.shape[1:] != (m, n) or (w < 0).any():
        got = f"{A.shape}, {B.shape}, {K.shape} and {w.tolist()}"
        raise ShapeError(f"a tube needs A (n, n), B (n, m), gains (H, m, n) and half_widths >= 0 (n,), got {got}.")
    loops = A + B @ K
    states, inputs = [], []
    for t, each in enumerate(_transitions(loops)):
        states.append((np.abs(each) @ w).sum(axis=0))
        if t < len(K):
            inputs.append((np.abs(K[t] @ each) @ w).sum(axis=0))
    return Tube(np.array(states), np.array(inputs), loops, w)


def _transitions(loops: Array) -> Iterator[Array]:
    """Yield, for each time t of 0 to H, the products of the matrices from each earlier step to t, ``(t, n, n)``."""
    n = loops.shape[-1]
    known = np.zeros((0, n, n))
    yield known
    for loop in loops:
        known = np.concatenate([loop @ known, np.eye(n)[None]])
        yield known


@checked
def tube_of(validation: Validation, plan: Plan, disturbance: Disturbance) -> Tube:
    """Return the tube around the closed loop of M in a plan, for a linear model and affine feedback.

    Input limits that are reached are not linear; the tube then does not hold.
    """
    controller, model = plan.controller, validation.model
    if not isinstance(controller, AffineFeedback) or controller.gains.ndim != 3:
        raise InputError("a tube needs the affine feedback of one task, as LQR and iLQR design it.")
    A, B = linearize(model, plan.model_trajectory.states[:-1], plan.model_trajectory.inputs)
    if A.ndim > 2 or B.ndim > 2:
        raise InputError("a tube needs a linear model, whose Jacobian is the same everywhere.")
    return tube(A, B, controller.gains, disturbance.half_widths)
