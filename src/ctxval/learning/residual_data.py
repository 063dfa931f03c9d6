"""Residuals of recorded transitions, standardised for regression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.core.model import Model
from ctxval.core.trajectory import Transitions
from ctxval.models.scaling import standard_deviations, standardised_pairs

NEGLIGIBLE = 1e-7
"""A residual below this share of the state's typical change is rounding."""


@dataclass(frozen=True, eq=False)
class ResidualData:
    """Residuals ``x' - M(x, u)`` of N transitions in units in which they are about 1.

    Attributes:
        pairs: standardised state-input pairs, shape ``(N, n + m)``.
        outputs: standardised residuals, shape ``(N, n)``; 0 if the residual of a state is negligible.
        sources: the execution of each transition; -1 for data that the model was made from, shape ``(N,)``.
        shift, scale: constants that standardise a state-input pair, shapes ``(n + m,)``.
        sizes: root mean square of the residual of each state, shape ``(n,)``.
        steps: standard deviation of the change of each state in one step, shape ``(n,)``.
    """

    pairs: Array
    outputs: Array
    sources: Rows
    shift: Array
    scale: Array
    sizes: Array
    steps: Array
    transitions: Transitions

    @property
    def learned(self) -> Mask:
        """Which states have a residual that is not negligible, shape ``(n,)``."""
        return np.asarray(self.sizes > NEGLIGIBLE * self.steps)

    @property
    def inputs(self) -> int:
        """The number m of inputs of the system."""
        return len(self.shift) - len(self.sizes)

    @property
    def units(self) -> Array:
        """The unit of each standardised residual, shape ``(n,)``; 0 if it is negligible."""
        return np.where(self.learned, self.sizes, 0.0)

    def standardised(self, x: Array, u: Array) -> Array:
        """Return standardised pairs ``(..., n + m)`` of states and the first m inputs, which act."""
        return standardised_pairs(x, u[..., : self.inputs], self.shift, self.scale)


def residual_data(model: Model, transitions: Transitions, sources: Rows) -> ResidualData | None:
    """Return the residuals of a model; None if fewer than two transitions are usable, or if M explains all of them."""
    with np.errstate(all="ignore"):
        residuals = transitions.x_next - model.step(transitions.x, transitions.u)
        steps = transitions.x_next - transitions.x
    pairs = np.concatenate([transitions.x, transitions.u], axis=1)
    # Larger numbers have diverged, and their squares would not be finite.
    usable = (np.abs(np.concatenate([pairs, residuals, steps], axis=1)) < 1e100).all(axis=1)
    if usable.sum() < 2:
        return None
    pairs, residuals = pairs[usable], residuals[usable]
    typical = standard_deviations(steps[usable])
    sizes = np.sqrt((residuals**2).mean(axis=0))
    learned = sizes > NEGLIGIBLE * typical
    if not learned.any():
        return None
    shift, scale = pairs.mean(axis=0), standard_deviations(pairs)
    outputs = residuals / np.where(learned, sizes, np.inf)
    return ResidualData(
        (pairs - shift) / scale, outputs, sources[usable], shift, scale, sizes, typical, transitions[usable]
    )
