"""States in which unit quaternions stand: orientations of free and ball joints, whose differences are rotations.

The difference of two orientations is a rotation vector in the body frame, in radians. It takes the places of x, y and z
of the quaternion, and the place of w is 0; so differences have as many numbers as states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.quaternions import continued, normalised, product
from ctxval.core.model import Model


@dataclass(frozen=True)
class StateGeometry:
    """Where states have unit quaternions, w first; plain vectors have none, and are subtracted and added."""

    quaternions: tuple[int, ...] = ()  #: the index of each w

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
        """Return what a function of states ``(..., n)`` may depend on: of q and -q, the one with w >= 0."""
        if not self.quaternions:
            return x
        features = np.array(x)
        for w in self.quaternions:
            features[..., w : w + 4] *= np.copysign(1.0, x[..., w : w + 1])
        return features

    def continued(self, states: Array, start: Array) -> Array:
        """Return recorded states ``(N, n)``; of q and -q, that which continues from a first state ``(n,)``."""
        if not self.quaternions:
            return states
        states = np.array(states)
        for w in self.quaternions:
            at = slice(w, w + 4)
            states[:, at] = continued(np.concatenate([start[None, at], states[:, at]]))[1:]
        return states


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
