"""Users' own functions as models: with named parameters, and with noise of which the expectation is taken."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, as_finite
from ctxval._util.checked import PositiveInt
from ctxval._util.registry import part
from ctxval.core.model import Function, Model
from ctxval.core.trajectory import Transitions
from ctxval.core.uncertain import UncertainParameter, priors_of
from ctxval.errors import InputError, ModelError

ParametricStep = Callable[[Array, Array, Array], Array]


@part(functions={"step": "(x, u, theta) -> x_next"})
class Parametric:
    """A function ``(x, u, theta) -> x_next`` with the values of its parameters theta as a model.

    Args:
        step: a function of one state ``(n,)``, one input ``(m,)`` and the parameters ``(p,)``.
        theta: the values of the parameters by name, in the order of theta.
        uncertain: standard deviations of the parameters that are not known exactly, by name: a number in the
            parameter's own unit, or a share of its value as ``"20 %"``. Executions tell more of them.
        vectorized: True if ``step`` takes whole batches ``(..., n)`` and ``(..., m)``.
        dt: length of a step in seconds, if it is known.
        states, inputs: the names of the states and inputs with their units, if they are known.
        data: the transitions that the parameters were learned from, if any.

    Raises:
        InputError: if theta is no table of parameters.
    """

    uncertain: tuple[UncertainParameter, ...] = ()

    def __init__(
        self,
        step: ParametricStep,
        theta: Mapping[str, float],
        *,
        uncertain: Mapping[str, float | str] | None = None,
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
        if uncertain:
            self.uncertain = priors_of(self.theta, uncertain)
        self._together: bool | None = None

    def step(self, x: Array, u: Array) -> Array:
        return self._with(np.array(list(self.theta.values()))).step(x, u)

    def drawn(self, z: Array) -> Model:
        """Return S models with standardised uncertain parameters ``(S, K)``; a draw is the first axis of states."""
        values = np.repeat(np.array(list(self.theta.values()))[None], len(z), axis=0)
        names = list(self.theta)
        for k, each in enumerate(self.uncertain):
            values[:, names.index(each.name)] = each.at(z[:, k])
        return _Drawn(self, values)

    def _with(self, values: Array) -> Function:
        return Function(lambda x, u: self.function(x, u, values), vectorized=self.vectorized)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A parametric model with S values of its parameters ``(S, p)``."""

    model: Parametric
    values: Array

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states ``(S, ..., n)`` for states ``(S, ..., n)`` and inputs ``(S, ..., m)``."""
        if not x.size or self._takes_together(x, u):
            return self._together(x, u, self.values) if x.size else x
        return np.stack([self.model._with(theta).step(*pair) for theta, *pair in zip(self.values, x, u, strict=True)])

    def _together(self, x: Array, u: Array, values: Array) -> Array:
        theta = values.T.reshape(values.shape[1], len(values), *[1] * (x.ndim - 2))
        return np.asarray(self.model.function(x, u, theta), dtype=np.float64)

    def _takes_together(self, x: Array, u: Array) -> bool:
        """Return whether the function takes parameters ``(p, S, 1, ...)`` as it takes those of each draw alone."""
        model = self.model
        if model._together is None:
            model._together = False
            if model.vectorized:
                # Three draws of two states, so that no axis fits another one by chance.
                some = np.repeat(x.reshape(-1, x.shape[-1])[:1], 6, axis=0).reshape(3, 2, -1)
                inputs = np.repeat(u.reshape(-1, u.shape[-1])[:1], 6, axis=0).reshape(3, 2, -1)
                values = self.values[np.arange(3) % len(self.values)] * np.array([[1.0], [1.01], [1.02]])
                with suppress(Exception), np.errstate(all="ignore"):
                    alone = [model._with(theta).step(*pair) for theta, *pair in zip(values, some, inputs, strict=True)]
                    together, size = self._together(some, inputs, values), 1e-12 * np.abs(alone).max()
                    alike = together.shape == some.shape and np.abs(together - alone).max() <= size
                    model._together = bool(alike)
        return bool(model._together)


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
        """Return the expected next state; shapes ``(..., n), (..., m) -> (..., n)``.

        Raises:
            ModelError: if the draws have another shape.
        """
        batch = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        count, noise = self.draws.shape
        states, inputs = (np.broadcast_to(each, (count, *batch, each.shape[-1])) for each in (x, u))
        draws = np.broadcast_to(self.draws.reshape(count, *[1] * len(batch), noise), (count, *batch, noise))
        drawn = np.asarray(self.function(states, inputs, draws), dtype=np.float64)
        if drawn.shape != states.shape:
            wanted = f"next states of shape {states.shape}"
            raise ModelError(f"the step of a model with noise must return {wanted}, got {drawn.shape}.")
        return np.asarray(drawn.mean(axis=0))
