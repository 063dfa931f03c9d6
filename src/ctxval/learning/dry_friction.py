"""Dry friction that M lacks: what holds a joint until an input overcomes it, found in executions.

Its force changes by a jump where a joint stops or turns, so it is no smooth function of state and input, and few
recorded runs do not teach it to a Gaussian process. Here it is a part of the inputs, as in the time stepping of Moreau
(1988): the inputs ``u - f`` act, with ``|f_j| <= c_j``, where f_j brings the rate that input j drives to rest if it
can, and opposes it as strongly as it can otherwise. What M misses is a smooth function of the state and the inputs that
act. It is learned of steps in which all these rates move, because f is known there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.core.model import Model
from ctxval.core.trajectory import Transitions
from ctxval.models.increments import standard_deviations

_TIMES = 2  # the residual is evaluated at forces that follow from it
_SWEEPS = 4  # each time, of the inputs, whose frictions act on each other's rates
_EXPLAINED = 0.7  # share of the squared residuals, beside a linear function, that must be left at most
_REST = 0.05  # share of the root mean square of a rate below which the joint is at rest
_PER_COEFFICIENT = 5  # fewest recorded steps for each coefficient of the linear function


@dataclass(frozen=True, eq=False)
class DryFriction:
    """M with dry friction of constant size at its inputs."""

    model: Model
    rates: Rows  # the state that each input drives (m,)
    largest: Array  # the largest friction at each input, in its units (m,)
    creep: Array  # the rate at which a held joint creeps under a unit of its input (m,)
    change: Array  # by which inputs are changed to see what they do (m,)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state; shapes ``(..., n), (..., m) -> (..., n)``."""
        return self.following(x, u, lambda acting: np.zeros_like(x))

    def following(self, x: Array, u: Array, missed: Callable[[Array], Array]) -> Array:
        """Return the next states ``(..., n)`` if M misses ``missed(acting inputs)``, which has their shape."""
        reached, effects = _reached(self.model, x, u, self.change)
        force, residuals = np.zeros_like(u), np.zeros_like(reached)
        for _ in range(_TIMES):  # what is missed depends on the force, which it changes little
            force = self._force(reached + residuals, effects, force)
            residuals = missed(u - force)
        force = self._force(reached + residuals, effects, force)
        return np.asarray(reached + residuals - (effects * force[..., None, :]).sum(axis=-1))

    def _force(self, reached: Array, effects: Array, force: Array) -> Array:
        """Return the friction ``(..., m)`` that holds joints, but for their creep, if it can, from a first guess."""
        m, of_rates, force = len(self.rates), effects[..., self.rates, :], force.copy()
        with np.errstate(all="ignore"):  # states of draws that diverge
            for j in [*range(m)] * (_SWEEPS if m > 1 else 1):  # projected Gauss-Seidel
                own = of_rates[..., j, j]
                rate = reached[..., self.rates[j]] - (of_rates[..., j, :] * force).sum(axis=-1)
                holding = (rate + own * force[..., j]) / (own + np.sign(own) * self.creep[j])
                force[..., j] = np.clip(np.nan_to_num(holding), -self.largest[j], self.largest[j])
        return force

    def acting(self, transitions: Transitions) -> tuple[Transitions, Mask]:
        """Return transitions with the inputs that act, and of which the friction is known ``(N,)``: all joints move."""
        directions = _directions(transitions, self.rates)
        acting = transitions.u - self.largest * directions
        return Transitions(transitions.x, acting, transitions.x_next), (directions != 0).all(axis=1)


def found_friction(model: Model, transitions: Transitions) -> DryFriction | None:
    """Return M with the friction that explains transitions best; None if friction does not explain much of them.

    It is estimated beside a linear function of state and input, because M may be wrong in other ways, too.
    """
    x, u = transitions.x, transitions.u
    ranges = np.abs(u).max(axis=0, initial=0.0)
    if not len(ranges) or not (ranges > 0).all():
        return None
    reached, effects = _reached(model, x, u, 1e-3 * ranges)
    strength = np.sqrt((effects**2).mean(axis=0)) / standard_deviations(transitions.x_next - x)[:, None]
    rates = strength.argmax(axis=0)
    directions = _directions(transitions, rates)
    moving = (directions != 0).all(axis=1)
    features = np.column_stack([np.ones(len(x)), x / standard_deviations(x), u / ranges])[moving]
    if len(set(rates.tolist())) < len(rates) or len(features) < _PER_COEFFICIENT * features.shape[1]:
        return None
    residuals = (transitions.x_next - reached)[moving][:, rates]
    of_friction = -(effects[:, rates] * directions[:, None, :])[moving]  # (N, m, m): of each rate, by each input
    sizes = np.sqrt((residuals**2).mean(axis=0))
    if not (np.isfinite(of_friction).all() and np.isfinite(sizes).all() and (sizes > 0).all()):
        return None
    linear = np.linalg.qr(features)[0]

    def beside_linear(values: Array) -> Array:
        flat = values.reshape(len(values), -1)
        return (flat - linear @ (linear.T @ flat)).reshape(values.shape)

    left = beside_linear(residuals / sizes)
    explained = beside_linear(of_friction / sizes[:, None])
    largest, rest = nnls(explained.reshape(-1, len(rates)), left.ravel())
    if not rest**2 < _EXPLAINED * (left**2).sum():
        return None
    return DryFriction(model, rates, largest, _creep(transitions, reached, effects, rates), 1e-3 * ranges)


def _creep(transitions: Transitions, reached: Array, effects: Array, rates: Rows) -> Array:
    """Return the rates of joints that stay at rest per unit of what holds them ``(m,)``, by least squares."""
    before, after = transitions.x[:, rates], transitions.x_next[:, rates]
    still = 0.2 * _REST * np.sqrt((after**2).mean(axis=0))  # a joint that stops is faster
    held = (np.abs(before) <= still) & (np.abs(after) <= still)
    force = (np.linalg.pinv(effects[:, rates]) @ (reached[:, rates] - after)[:, :, None])[:, :, 0]
    squares = np.where(held, force**2, 0.0).sum(axis=0)
    return np.asarray(np.maximum(np.where(held, force * after, 0.0).sum(axis=0) / np.maximum(squares, 1e-300), 0.0))


def _directions(transitions: Transitions, rates: Rows) -> Array:
    """Return in which directions rates move ``(N, m)``, 1 or -1; 0 if a joint is nearly at rest, or turns."""
    before, after = transitions.x[:, rates], transitions.x_next[:, rates]
    still = _REST * np.sqrt((after**2).mean(axis=0))
    moves = (np.minimum(np.abs(before), np.abs(after)) > still) & (before * after > 0)
    return np.where(moves, np.sign(after), 0.0)


def _reached(model: Model, x: Array, u: Array, change: Array) -> tuple[Array, Array]:
    """Return the next states ``(..., n)`` of M, and what a unit of each input changes in them ``(..., n, m)``."""
    m = u.shape[-1]
    changes = np.concatenate([np.zeros((1, m)), np.diag(change)]).reshape(m + 1, *[1] * (u.ndim - 1), m)
    inputs = u + changes
    each = model.step(np.array(np.broadcast_to(x, (*inputs.shape[:-1], x.shape[-1]))), inputs)
    return each[0], np.moveaxis(each[1:] - each[0], 0, -1) / change
