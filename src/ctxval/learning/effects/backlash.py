"""Inputs that follow with play."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import OfInput


@dataclass(frozen=True)
class Backlash(OfInput):
    """An input follows with play. Size: half of the play, in units of the input."""

    name: ClassVar[str] = "backlash"
    holds: ClassVar[bool] = True
    words: ClassVar[str] = "{name} has backlash of {play:.3g} {unit}"

    def acts(self, u: Array, before: Array) -> Array:
        return np.clip(before, u - self.sizes[0], u + self.sizes[0])
