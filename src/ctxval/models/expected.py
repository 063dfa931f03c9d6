"""Models with noise of their own, replaced by the expectation of their step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import PositiveInt, checked
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.errors import ModelError


@part(functions={"step": "(x, u, w) -> x_next"})
class Expected(ShortRepr):
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

    Raises:
        ModelError: if ``step`` does not return one next state for each draw.
    """

    @checked
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
            raise ModelError(
                f"the step of a model with noise must return next states of shape {states.shape}, got {drawn.shape}."
            )
        return np.asarray(drawn.mean(axis=0))
