"""Users' own functions as models: with named parameters, and with noise of which the expectation is taken."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ctxval._util.arrays import Array, as_finite
from ctxval._util.checked import PositiveInt
from ctxval._util.registry import part
from ctxval.core.model import Function
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ModelError

ParametricStep = Callable[[Array, Array, Array], Array]


@part(functions={"step": "(x, u, theta) -> x_next"})
class Parametric:
    """A function ``(x, u, theta) -> x_next`` with the values of its parameters theta as a model.

    Args:
        step: a function of one state ``(n,)``, one input ``(m,)`` and the parameters ``(p,)``.
        theta: the values of the parameters by name, in the order of theta.
        vectorized: True if ``step`` takes whole batches ``(..., n)`` and ``(..., m)``.
        dt: length of a step in seconds, if it is known.
        states, inputs: the names of the states and inputs with their units, if they are known.
        data: the transitions that the parameters were learned from, if any.
    """

    def __init__(
        self,
        step: ParametricStep,
        theta: Mapping[str, float],
        *,
        vectorized: bool = False,
        dt: float | None = None,
        states: Mapping[str, str] | None = None,
        inputs: Mapping[str, str] | None = None,
        data: Transitions | None = None,
    ) -> None:
        if not theta:
            raise InputError(f"theta must be a table of parameters by name, got {theta!r}.")
        self.function = step
        self.theta = {str(name): float(as_finite(f"theta[{name}]", value)) for name, value in theta.items()}
        self.vectorized, self.dt, self.data = vectorized, dt, data
        self.states, self.inputs = states or {}, inputs or {}
        values = np.array(list(self.theta.values()))
        self._step = Function(lambda x, u: step(x, u, values), vectorized=vectorized)

    def step(self, x: Array, u: Array) -> Array:
        return self._step.step(x, u)


@part(functions={"step": "(x, u, w) -> x_next"})
class Expected:
    """The expected step of a model with noise, such as an ensemble or a network that returns a distribution.

    The expectation is an average over fixed draws w of standard normal noise and their opposites, the same in every
    step, so noise that enters linearly averages out exactly. A closed loop on it is not the expected closed loop of a
    nonlinear model.

    Attributes:
        draws: w, shape ``(draws, noise)``.

    Args:
        step: function of states ``(..., n)``, inputs ``(..., m)`` and standard normal noise ``(..., noise)`` of the
            same batch axes, which returns the next states.
        noise: the number of independent noises of one step.
        draws: the number of draws, which is rounded up to an even one.
    """

    def __init__(
        self,
        step: Callable[[Array, Array, Array], Array],
        *,
        noise: PositiveInt,
        draws: PositiveInt = 64,
        seed: int = 0,
    ) -> None:
        self.function = step
        half = np.random.default_rng(seed).standard_normal((-(-draws // 2), noise))
        self.draws = np.concatenate([half, -half])

    def step(self, x: Array, u: Array) -> Array:
        """Return the expected next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        batch = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        count, noise = self.draws.shape
        states, inputs = (np.broadcast_to(each, (count, *batch, each.shape[-1])) for each in (x, u))
        draws = np.broadcast_to(self.draws.reshape(count, *[1] * len(batch), noise), (count, *batch, noise))
        drawn = np.asarray(self.function(states, inputs, draws), dtype=np.float64)
        if drawn.shape != states.shape:
            wanted = f"next states of shape {states.shape}"
            raise ModelError(f"the step of a model with noise must return {wanted}, got {drawn.shape}.")
        return np.asarray(drawn.mean(axis=0))
