"""Inputs without effect near 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import OfInput


@dataclass(frozen=True)
class DeadZone(OfInput):
    """An input has no effect near 0. Size: the magnitude below which it has none, and which is lost above."""

    name: ClassVar[str] = "dead zone"
    kinked: ClassVar[bool] = True
    words: ClassVar[str] = "{name} has a dead zone of {size:.3g} {unit}"

    def acts(self, u: Array, before: Array) -> Array:
        return u - np.clip(u, -self.sizes[0], self.sizes[0])
