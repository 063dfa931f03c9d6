"""Models that were refined: a model with a correction, and any model that was learned again from executions."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model, linearize
from ctxval.core.trajectory import Transitions
from ctxval.models.correction import Correction

Linearised = Literal["corrected", "model"]
"""Whose Jacobian controllers are designed with."""


class Corrected(ShortRepr):
    """The model ``M'(x, u) = M(x, u) + r(x, u)`` of a model M and a correction r.

    Args:
        linearised: ``"corrected"`` for the Jacobian of M', or ``"model"`` for that of M. With the second one, a
            synthesizer that linearises once, such as LQR, designs nearly the controllers that it designed on M: the
            Jacobian of M' at one point may say less of the tasks than a linear model that was fitted to all of them.
        data: the transitions that the correction was learned from, if any.
    """

    def __init__(
        self,
        model: Model,
        correction: Correction,
        *,
        linearised: Linearised = "corrected",
        data: Transitions | None = None,
    ) -> None:
        self.model = model
        self.correction = correction
        self.linearised = linearised
        self.data = data

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return np.asarray(self.model.step(x, u) + self.correction(x, u))

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return A ``(..., n, n)`` and B ``(..., n, m)``, without batch axes if they are those of a linear model M."""
        A, B = linearize(self.model, x, u)
        if self.linearised == "model":
            return A, B
        own = self.correction.jacobian(x, u)
        n = x.shape[-1]
        return A + own[..., :n], B + own[..., n:]


class Refined(ShortRepr):
    """A model that was learned again from executions, with all transitions that are known, and the model before.

    The transitions are coverage for what is learned next. A residual of the refined model itself would be misleadingly
    small at them. What learns from executions therefore takes the residual of the model before.

    Args:
        data: all transitions that are known, those of the executions of earlier models included.
        before: the model that was refined; of a model that was refined before, the first one.
    """

    def __init__(self, model: Model, data: Transitions, before: Model) -> None:
        self.model = model
        self.data = data
        self.before = before_refinement(before)

    def __getattr__(self, name: str) -> Any:
        # A model without a Jacobian must not seem to have one.
        if name == "jacobian" and "model" in self.__dict__:
            return getattr(self.model, name)
        raise AttributeError(name)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return self.model.step(x, u)


def before_refinement(model: Model) -> Model:
    """Return the model whose residual is learned from executions: that before a refinement, or the model itself.

    A refined model explains its own data better than it explains the system elsewhere.
    """
    if isinstance(model, Refined):
        return model.before
    return model.model if isinstance(model, Corrected) else model
