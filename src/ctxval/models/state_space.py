"""State-space models of python-control or scipy as learned models."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval._util.arrays import as_finite
from ctxval._util.checked import Seconds
from ctxval._util.registry import part
from ctxval.errors import InputError, ShapeError
from ctxval.models.linear import Linear


@part()
def state_space(system: Any, dt: Seconds) -> Linear:
    """Return a ``StateSpace`` of python-control or of scipy as a linear model with its Jacobian.

    The model has the state of the system; C and D are not used. A continuous system is discretised exactly for inputs
    that are held over a step.

    Args:
        system: the system, with A, B and its own dt: 0 or None for a continuous system, True for a discrete system
            with any time step.
    """
    if not all(hasattr(system, name) for name in ("A", "B")):
        raise InputError(f"a state-space model must have A and B, got {system!r}.")
    A, B = as_finite("A", system.A), as_finite("B", system.B)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or B.ndim != 2 or len(B) != len(A):
        raise ShapeError(f"a state-space model needs A (n, n) and B (n, m), got {A.shape} and {B.shape}.")
    own = getattr(system, "dt", None)
    if not own:
        from scipy.linalg import expm

        # For an input that is held over dt: the exponential of [[A, B], [0, 0]] dt.
        n, m = B.shape
        whole = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)
        return Linear(whole[:n, :n], whole[:n, n:])
    if own is not True and not np.isclose(own, dt, rtol=1e-9, atol=0):
        raise InputError(f"dt must be that of the discrete system, {own:g} s, got {dt:g} s.")
    return Linear(A, B)
