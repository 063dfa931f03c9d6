"""States in which unit quaternions stand, and states of which the dynamics do not depend.

The difference of two orientations is a rotation vector in the body frame, in radians. It takes the places of x, y and z
of the quaternion, and the place of w is 0; so differences have as many numbers as states.

If the dynamics do not depend on where a free joint is and where it heads, what a model misses is a function of the
state in the heading frame, which is turned about the vertical axis by the yaw angle, and it is a vector of that frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.quaternions import continued, normalised, product

if TYPE_CHECKING:
    from ctxval.core.model import Model


@dataclass(frozen=True)
class StateGeometry:
    """Where states have unit quaternions, w first; plain vectors have none, and are subtracted and added."""

    quaternions: tuple[int, ...] = ()  #: the index of each w
    invariant: tuple[int, ...] = ()  #: the states of which the dynamics do not depend
    #: the indices of the first position and the first velocity of a free joint of whose yaw they do not depend
    heading: tuple[int, int] | None = None

    def difference(self, x: Array, y: Array) -> Array:
        """Return what leads from states y to states x, both ``(..., n)``; q and -q are one orientation."""
        gap = np.asarray(x - y)
        for w in self.quaternions:
            at = slice(w, w + 4)
            q = product(y[..., at] * [1.0, -1.0, -1.0, -1.0], x[..., at])
            sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
            half = np.arctan2(sine, np.abs(q[..., :1]))
            with np.errstate(invalid="ignore"):
                turn = np.where(sine > 1e-150, 2 * half / np.where(sine > 1e-150, sine, 1.0), 2.0)
            gap[..., w] = 0.0
            gap[..., w + 1 : w + 4] = turn * np.copysign(1.0, q[..., :1]) * q[..., 1:]
        return gap

    def add(self, x: Array, difference: Array) -> Array:
        """Return the states ``(..., n)`` to which differences lead from states x; quaternions have the length 1."""
        moved = np.asarray(x + difference)
        for w in self.quaternions:
            turn = np.broadcast_to(difference[..., w + 1 : w + 4], (*moved.shape[:-1], 3))
            angle = np.linalg.norm(turn, axis=-1, keepdims=True)
            half = np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * turn], axis=-1)
            moved[..., w : w + 4] = normalised(product(np.broadcast_to(x[..., w : w + 4], half.shape), half))
        return moved

    def features(self, x: Array) -> Array:
        """Return what a function of states ``(..., n)`` may depend on, in as many numbers.

        It is the state in the heading frame with 0 for invariant states and, of q and -q, the one with w >= 0.
        """
        if not self.quaternions and not self.invariant:
            return x
        features = np.array(x)
        if self.heading is not None:
            first, velocity = self.heading
            half = _half_yaw(x[..., first + 3 : first + 7]) * [1.0, 0.0, 0.0, -1.0]
            features[..., first + 3 : first + 7] = product(half, x[..., first + 3 : first + 7])
            features[..., velocity : velocity + 2] = _turned(half, x[..., velocity : velocity + 2])
        features[..., self.invariant] = 0.0
        for w in self.quaternions:
            features[..., w : w + 4] *= np.copysign(1.0, features[..., w : w + 1])
        return features

    def missed(self, reached: Array, predicted: Array, x: Array) -> Array:
        """Return what leads from predicted to reached states, in the heading frame of the states x before the step."""
        return self._turned(self.difference(reached, predicted), x, -1.0)

    def corrected(self, predicted: Array, missed: Array, x: Array) -> Array:
        """Return predicted states to which something was added that is missed; the inverse of :meth:`missed`."""
        return self.add(predicted, self._turned(missed, x, 1.0))

    def _turned(self, difference: Array, x: Array, sign: float) -> Array:
        """Return differences with positions and velocities turned by the yaw angle of states or back."""
        if self.heading is None:
            return difference
        first, velocity = self.heading
        half = _half_yaw(x[..., first + 3 : first + 7]) * [1.0, 0.0, 0.0, sign]
        turned = np.array(np.broadcast_to(difference, np.broadcast_shapes(difference.shape, x.shape)))
        for at in (first, velocity):
            turned[..., at : at + 2] = _turned(half, turned[..., at : at + 2])
        return turned

    def continued(self, states: Array, start: Array) -> Array:
        """Return recorded states ``(N, n)``; of q and -q, that which continues from a first state ``(n,)``."""
        if not self.quaternions:
            return states
        states = np.array(states)
        for w in self.quaternions:
            at = slice(w, w + 4)
            states[:, at] = continued(np.concatenate([start[None, at], states[:, at]]))[1:]
        return states


def _half_yaw(q: Array) -> Array:
    """Return the quaternions ``(..., 4)`` of the turns about the vertical axis in orientations."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    half = 0.5 * np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
    return np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)


def _turned(half: Array, vectors: Array) -> Array:
    """Return vectors ``(..., 2)`` of the ground, turned by quaternions about the vertical axis."""
    cosine = half[..., 0] ** 2 - half[..., 3] ** 2
    sine = 2 * half[..., 0] * half[..., 3]
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


PLAIN = StateGeometry()


def geometry_of(model: Model) -> StateGeometry:
    """Return the geometry of a model's states, which it or the model inside of it has as ``geometry``."""
    inside: object = model
    for _ in range(8):  # wrappers
        found = getattr(inside, "geometry", None)
        if isinstance(found, StateGeometry):
            return found
        inside = getattr(inside, "model", getattr(inside, "given", None))
    return PLAIN
