"""What a model does within a step: the flow of its linearisation, which effects change while a step goes on.

A step of M is a map, and its flow is the affine differential equation that ends where the step ends. The matrix is the
logarithm of the Jacobian of the step, so the flow is exact if M is linear. If M is smooth, it differs from that of M by
the third power of the step at most (Higham, "Functions of Matrices", SIAM 2008, chapters 6, 10 and 11).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model, paired
from ctxval.models import MuJoCo

PARTS = 8  #: of a step, a power of 2

Push = tuple[Array, int, Callable[[Array, Array, Array], Array]]
"""The change of the state by a unit of a force in a step ``(..., n)``, the state that is its rate, and the force
``(before, rate, stopping) -> (...)`` at a rate and its mean, where ``stopping`` would let the rate end at 0."""


@dataclass(frozen=True, eq=False)
class Linearisation(ShortRepr):
    """The matrix of flows, and the d that is held and makes a unit of a change of the state in a step."""

    A: Array  #: shape ``(..., n, n)`` or ``(n, n)``
    driven: Array  #: of the same shape

    @classmethod
    def of(cls, model: Model, x: Array, u: Array) -> Linearisation:
        """Return the linearisation of a model at states ``(..., n)`` and inputs ``(..., m)``."""
        unit = np.eye(x.shape[-1])
        if isinstance(model, MuJoCo):  # derivatives of its steps cost more than they tell
            return cls(0.0 * unit, unit)
        jacobian = getattr(model, "jacobian", None)
        J = _slopes(model, x, u) if jacobian is None else jacobian(x, u)[0]
        A = logarithm(np.where(np.isfinite(J).all(axis=(-2, -1), keepdims=True), J, unit))
        moved = _moved(A, 1 / PARTS)
        held, grown = moved, unit + A @ moved
        for _ in range(PARTS.bit_length() - 1):
            held, grown = held + grown @ held, grown @ grown
        driven = _inverse(held)
        # In states of a loop that diverged, a step may have no flow but a straight line.
        errors = np.abs(held @ driven - unit) + np.finfo(np.float64).eps * (np.abs(held) @ np.abs(driven))
        flows = (errors < 1e-6).all(axis=(-2, -1), keepdims=True)  # with rounding, which other kernels do otherwise
        return cls(np.where(flows, A, 0.0), np.where(flows, driven, unit))

    def __getitem__(self, rows: Rows) -> Linearisation:
        """Return that at some of the states; a linear model has the same everywhere."""
        return self if self.A.ndim == 2 else Linearisation(self.A[rows], self.driven[rows])


def _slopes(model: Model, x: Array, u: Array) -> Array:
    """Return the Jacobian of a step in x by differences that suit single precision, too."""
    sizes = 1e-4 * np.maximum(1.0, np.abs(x))
    moves = np.stack([1.0, -1.0])[:, None, None] * (sizes[..., None, None, :] * np.eye(x.shape[-1]))
    inputs = np.array(np.broadcast_to(u[..., None, None, :], (*moves.shape[:-1], u.shape[-1])))
    up, down = np.moveaxis(np.asarray(model.step(x[..., None, None, :] + moves, inputs)), -3, 0)
    return np.swapaxes((up - down) / (2 * sizes)[..., None], -1, -2)


@dataclass(frozen=True, eq=False)
class Flow(ShortRepr):
    """The equation ``dx/ds = d + A (x - start)`` with pushes; s goes from 0 to 1 in a step of M."""

    model: Model
    start: Array  #: the state before the step ``(..., n)``
    inputs: Array  #: those that act ``(..., m)``
    at: Linearisation
    A: Array  #: shape ``(..., n, n)`` or ``(n, n)``
    d: Array  #: shape ``(..., n)``
    reached: Array  #: where the step of M ends, with the mean of the inputs, ``(..., n)``
    varied: Array  #: what is added to d in each part of the step, ``(parts, ..., n)``
    pushes: tuple[Push, ...] = field(default=())

    @classmethod
    def of(cls, model: Model, x: Array, u: Array, at: Linearisation | None = None) -> Flow:
        """Return the flow of a step of a model, which ends where the step ends, by a linearisation near the state.

        Inputs may differ in the parts of the step, ``(..., parts, m)``.
        """
        mean = u.mean(axis=-2) if u.ndim > x.ndim else u
        at = Linearisation.of(model, x, mean) if at is None else at
        reached = np.array(model.step(np.array(x), np.array(mean)))  # a step may work in place
        varied = np.zeros((PARTS, *x.shape))
        if u.ndim > x.ndim:  # inputs go from one to another, in which M is nearly linear
            ends = u[..., [0, -1], :]
            across = np.diff(np.asarray(model.step(*map(np.array, paired(x[..., None, :], ends)))), axis=-2)
            line = np.diff(ends, axis=-2)
            along = ((u - mean[..., None, :]) * line).sum(axis=-1) / np.maximum((line**2).sum(axis=-1), 1e-300)
            varied = np.moveaxis(along[..., None] * times(at.driven[..., None, :, :], across), -2, 0)
        return cls(model, x, mean, at, at.A, times(at.driven, reached - x), reached, varied)

    def driven(self, change: Array) -> Array:
        """Return the d ``(..., n)`` that is held and makes a change of the state in a step of M."""
        return times(self.at.driven, change)

    def end(self, duration: float | Array = 1.0) -> Array:
        """Return the state ``(..., n)`` after a part of a step of M, a number or one of each draw ``(S, 1)``."""
        moved = _moved(self.A, duration / PARTS)
        effects = [(times(moved, push), rate, force) for push, rate, force in self.pushes]
        x = self.start
        for varied in self.varied:
            reached = x + times(moved, self.d + varied + times(self.A, x - self.start))
            for effect, rate, force in effects:
                moving = np.where(np.abs(effect[..., rate]) > 1e-12, effect[..., rate], 1e-12)
                mean = 0.5 * (x[..., rate] + reached[..., rate])
                size = force(x[..., rate], mean, -reached[..., rate] / moving)
                reached = reached + effect * size[..., None]
            x = reached
        return x


def times(matrix: Array, vector: Array) -> Array:
    """Return the products of matrices ``(..., n, k)`` and vectors ``(..., k)``."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _moved(A: Array, h: float | Array) -> Array:
    """Return the change of the state by a unit of its derivative, in a part h of a step: the Pade approximation."""
    h = np.asarray(h)[..., None, None]
    z, unit = h * A, np.eye(A.shape[-1])
    return h * _inverse(unit - z / 2 + z @ z / 12)


def _inverse(matrices: Array) -> Array:
    """Return the inverses of matrices ``(..., n, n)``; NaN if one has none."""
    try:
        return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        regular = (np.abs(np.linalg.slogdet(matrices).sign) > 0)[..., None, None]
        inverses = np.linalg.inv(np.where(regular, matrices, np.eye(matrices.shape[-1])))
        return np.where(regular, inverses, np.nan)


def logarithm(J: Array) -> Array:
    """Return the principal logarithms of matrices ``(..., n, n)``; ``J - 1`` of those that have no real one."""
    unit = np.eye(J.shape[-1])
    rows = J.reshape(-1, *unit.shape)
    result = rows - unit
    ratio = np.asarray(np.linalg.solve(rows + (1 + 1e-12) * unit, result), np.float64)  # an eigenvalue may be -1
    near = _near(ratio)
    far = np.flatnonzero(~near)
    if len(far):
        eigenvalues = np.linalg.eigvals(rows[far])
        without = ((eigenvalues.real < 1e-9) & (np.abs(eigenvalues.imag) < 1e-9)).any(axis=-1)
        far = far[~without]
        result[far] = _by_roots(rows[far])
    result[near] = _by_series(ratio[near])
    return result.reshape(J.shape)


def _near(ratio: Array) -> Mask:
    """Return whether the eigenvalues of matrices are at most about 0.5 in magnitude, in any units of the states."""
    return np.asarray(np.linalg.norm(np.linalg.matrix_power(ratio, 8), axis=(-2, -1)) < 0.5**8)


def _by_series(ratio: Array) -> Array:
    """Return twice the inverse hyperbolic tangent of ``(J - 1) / (J + 1)``, which is the logarithm of J."""
    unit, square = np.eye(ratio.shape[-1]), ratio @ ratio
    series = unit / 17
    for odd in range(15, 0, -2):
        series = unit / odd + square @ series
    return np.asarray(2 * ratio @ series)


def _by_roots(J: Array) -> Array:
    """Return logarithms of matrices ``(N, n, n)`` far from 1: those of 32nd roots, by Denman and Beavers' iteration."""
    unit = np.eye(J.shape[-1])
    for _ in range(5):
        product = J
        for _ in range(30):
            inverse = np.linalg.inv(product)
            J = 0.5 * J @ (unit + inverse)
            product = 0.5 * (unit + 0.5 * (product + inverse))
            if (np.abs(product - unit) < 1e-14).all():
                break
    return 32 * _by_series(np.asarray(np.linalg.solve(J + unit, J - unit), np.float64))
