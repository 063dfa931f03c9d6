"""Numbers that learned dynamics give to certificates: statistics of runs, and distances under pushes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr


@dataclass(frozen=True, eq=False)
class Statistic:
    """One statistic of a run."""

    value: float  #: positive
    #: gradient, information: what the run says of coefficients w of 1, state and input, whose likelihood is
    #: proportional to ``exp(w' gradient - w' information w / 2)``, ``(k,)`` and ``(k, k)``; None if there is no noise
    gradient: Array | None = None
    information: Array | None = None
    freedom: float = np.nan  #: the degrees of freedom that white noise gives it; NaN if they are not known


@dataclass(frozen=True)
class Tolerance:
    """The smallest push that brings a task above a threshold, in the state in which it takes least."""

    state: str  #: the rate of change of the state, with its units, such as ``speed [m/s^2]``
    push: float  #: the size of the push; infinity if the largest one that was tried does not suffice
    residual: float  #: the largest residual that was recorded, in the same units

    @property
    def ratio(self) -> float:
        """The push as a multiple of the largest recorded residual."""
        return self.push / self.residual


@dataclass(frozen=True, eq=False)
class PushedDistances(ShortRepr):
    """The largest distances if something that no record shows pushes a state, on the posterior mean."""

    residuals: dict[str, float]  #: largest recorded residual of the rate of change of each pushed state, by its label
    levels: Array  #: the sizes of the pushes as multiples of these residuals, ascending from 0, shape ``(L,)``
    everywhere: Array  #: the largest distance for each state and size, shape ``(k, L)``
    away: Array  #: the same if the push acts only where no record is near

    def to_json(self) -> dict[str, Any]:
        """Return all attributes, ready for JSON: distances that are not finite are None."""
        everywhere, away = (
            [[d if np.isfinite(d) else None for d in row] for row in distances.tolist()]
            for distances in (self.everywhere, self.away)
        )
        return {"residuals": self.residuals, "levels": self.levels.tolist(), "everywhere": everywhere, "away": away}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """Return the distances that :meth:`to_json` returned."""
        arrays = (np.array(values[name], dtype=np.float64) for name in ("levels", "everywhere", "away"))
        return cls(values["residuals"], *(np.where(np.isnan(array), np.inf, array) for array in arrays))

    def tolerance(self, threshold: float, *, away: bool = False) -> Tolerance:
        """Return the smallest push that brings a task above the threshold, interpolated between the sizes."""

        def ratio(distances: Array) -> float:
            k = int(np.searchsorted(distances > threshold, True))
            if k in (0, len(distances)):
                return np.inf if k else 0.0
            low, below = self.levels[k - 1], distances[k - 1]
            rise = distances[k] - below
            share = (threshold - below) / rise if np.isfinite(rise) else 0.0
            return float(low + share * (self.levels[k] - low))

        # What may act at every step may also act where no record is near alone, which can be worse.
        ratios = map(ratio, self.away if away else np.maximum(self.everywhere, self.away))
        (state, residual), least = min(zip(self.residuals.items(), ratios, strict=True), key=lambda pair: pair[1])
        return Tolerance(state, least * residual, residual)
