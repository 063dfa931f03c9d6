"""A model with named parameters: a user's own function of state, input and parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ctxval._util.arrays import Array, as_finite
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Function
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError

ParametricStep = Callable[[Array, Array, Array], Array]


@part(functions={"step": "(x, u, theta) -> x_next"})
class Parametric(ShortRepr):
    """A function ``(x, u, theta) -> x_next`` with the values of its parameters theta as a model.

    Args:
        step: a function of one state ``(n,)``, one input ``(m,)`` and the parameters ``(p,)``.
        theta: the values of the parameters by name, in the order of theta.
        vectorized: True if ``step`` takes whole batches ``(..., n)`` and ``(..., m)``.
        dt: length of a step in seconds, if it is known.
        data: the transitions that the parameters were learned from, if any.
    """

    def __init__(
        self,
        step: ParametricStep,
        theta: Mapping[str, float],
        *,
        vectorized: bool = False,
        dt: float | None = None,
        data: Transitions | None = None,
    ) -> None:
        if not theta:
            raise InputError(f"theta must be a table of parameters by name, got {theta!r}.")
        self.function = step
        self.theta = {str(name): float(as_finite(f"theta[{name}]", value)) for name, value in theta.items()}
        self.vectorized = vectorized
        self.dt = dt
        self.data = data
        values = np.array(list(self.theta.values()))
        self._step = Function(lambda x, u: step(x, u, values), vectorized=vectorized)

    def step(self, x: Array, u: Array) -> Array:
        return self._step.step(x, u)
