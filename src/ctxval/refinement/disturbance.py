"""The measured residual of a refined model by regions of states and inputs: what a robust controller must assume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import aligned
from ctxval.refinement.records import HeldOut

QUANTILE = 0.95
"""The share of the held-out transitions whose residual is at most the stated quantile."""


@dataclass(frozen=True, eq=False)
class ResidualRegion(ShortRepr):
    """The magnitude of the residual in one region.

    Attributes:
        low, high: the box of states and inputs, shapes ``(n + m,)``; infinite where it has no end.
        steps: number of held-out transitions in it.
        quantile: 0.95 quantile of the residual of each state in one step, shape ``(n,)``.
        largest: its maximum, shape ``(n,)``.
    """

    low: Array
    high: Array
    steps: int
    quantile: Array
    largest: Array


@dataclass(frozen=True, eq=False)
class MeasuredResidual(ShortRepr):
    """The residual ``S(x, u) - M'(x, u)`` of one step, measured on transitions that M' was not learned from.

    It is measured and not guaranteed: another state or input may have a larger one.

    Attributes:
        states, inputs: the names of states and inputs with their units.
        whole: the residual in all regions together, whose box is the range of the records.
        regions: disjoint regions that cover all states and inputs, those with small residuals first.
    """

    states: dict[str, str]
    inputs: dict[str, str]
    whole: ResidualRegion
    regions: tuple[ResidualRegion, ...]

    @property
    def text(self) -> str:
        """The table as plain text."""
        units = [f"{name} [{unit}]" if unit else name for name, unit in self.states.items()]
        head = ["region", "steps", *(f"{unit}: 95 %" for unit in units), *(f"{unit}: largest" for unit in units)]
        rows = [head]
        for region, where in [*((region, self._where(region)) for region in self.regions), (self.whole, "all records")]:
            sizes = (*region.quantile.tolist(), *region.largest.tolist())
            rows.append([where, str(region.steps), *(f"{value:.3g}" for value in sizes)])
        return aligned(rows, right=True)

    @property
    def range_text(self) -> str:
        """The range of the records in one line; nothing was measured outside."""
        names = {**self.states, **self.inputs}
        parts = [
            f"{name} {low:.3g} to {high:.3g} {unit}".rstrip()
            for (name, unit), low, high in zip(names.items(), self.whole.low, self.whole.high, strict=True)
        ]
        return ", ".join(parts)

    def _where(self, region: ResidualRegion) -> str:
        parts = []
        ends = zip((*self.states, *self.inputs), region.low.tolist(), region.high.tolist(), strict=True)
        for name, low, high in ends:
            if np.isfinite(low) and np.isfinite(high):
                parts.append(f"{low:.3g} < {name} <= {high:.3g}")
            elif np.isfinite(low):
                parts.append(f"{name} > {low:.3g}")
            elif np.isfinite(high):
                parts.append(f"{name} <= {high:.3g}")
        return ", ".join(parts) or "everywhere"

    def to_dict(self) -> dict[str, Any]:
        """Return all numbers as plain values; an end that is infinite is None."""
        names = (*self.states, *self.inputs)

        def plain(one: ResidualRegion) -> dict[str, Any]:
            ends = zip(names, one.low.tolist(), one.high.tolist(), strict=True)
            return {
                "range": {name: [end if np.isfinite(end) else None for end in pair] for name, *pair in ends},
                "steps": one.steps,
                "quantile": dict(zip(self.states, one.quantile.tolist(), strict=True)),
                "largest": dict(zip(self.states, one.largest.tolist(), strict=True)),
            }

        return {
            "quantile_level": QUANTILE,
            "units": {**self.states, **self.inputs},
            "whole": plain(self.whole),
            "regions": [plain(region) for region in self.regions],
            "guaranteed": False,
        }


def measure_residual(held: HeldOut, states: dict[str, str], inputs: dict[str, str]) -> MeasuredResidual:
    """Return the residual by regions, from errors on transitions that were held out.

    The regions are those of a small regression tree: each split explains most of the spread of the logarithm of the
    error, in units of the typical change of each state.

    Args:
        found: the errors.
        states, inputs: the names of states and inputs with their units.
    """
    magnitude = np.abs(held.errors)
    sizes = np.maximum(held.changes.std(axis=0), 1e-300)
    error = np.sqrt(((held.errors / sizes) ** 2).mean(axis=1))
    logs = np.log(np.maximum(error, 1e-12 * max(float(error.max(initial=0.0)), 1e-300)))
    boxes = _split(held.pairs, logs)
    regions = [_region(magnitude, *box) for box in boxes]
    inside = np.ones(len(magnitude), dtype=bool)
    whole = _region(magnitude, inside, held.pairs.min(axis=0), held.pairs.max(axis=0))
    ordered = sorted(regions, key=lambda region: float((region.quantile / sizes).max()))
    return MeasuredResidual(states, inputs, whole, tuple(ordered))


_Box = tuple[Mask, Array, Array]


def _split(pairs: Array, logs: Array) -> list[_Box]:
    """Return boxes with the transitions in them: the box whose split explains most is split first."""
    k = pairs.shape[1]
    boxes: list[_Box] = [(np.ones(len(pairs), dtype=bool), np.full(k, -np.inf), np.full(k, np.inf))]
    # A split must explain a share of the spread, and more than rounding.
    least = max(0.1 * float(((logs - logs.mean()) ** 2).sum()), 1e-6 * len(logs))
    while len(boxes) < 6:
        splits = [_best_split(pairs, logs, box[0]) for box in boxes]
        best = max(range(len(boxes)), key=lambda i: splits[i][0])
        gain, column, place = splits[best]
        if not gain > least:
            break
        inside, low, high = boxes.pop(best)
        below: Mask = np.asarray(pairs[:, column] <= place)
        lower_end, upper_end = high.copy(), low.copy()
        lower_end[column] = upper_end[column] = place
        boxes += [(inside & below, low, lower_end), (inside & ~below, upper_end, high)]
    return boxes


def _best_split(pairs: Array, logs: Array, inside: Mask) -> tuple[float, int, float]:
    """Return the spread that the best split of a box explains, with its column and its place."""
    best = (0.0, 0, 0.0)
    chosen = logs[inside]
    total = float(((chosen - chosen.mean()) ** 2).sum())
    for column in range(pairs.shape[1]):
        values = pairs[inside, column]
        # Rounded, so that they can be written down.
        for place in (float(f"{cut:.3g}") for cut in np.quantile(values, (0.25, 0.5, 0.75))):
            below = values <= place
            # The 0.95 quantile of fewer would be their largest value.
            if min(int(below.sum()), int((~below).sum())) < 40:
                continue
            left = sum(float(((part - part.mean()) ** 2).sum()) for part in (chosen[below], chosen[~below]))
            best = max(best, (total - left, column, place))
    return best


def _region(magnitude: Array, inside: Mask, low: Array, high: Array) -> ResidualRegion:
    sizes = magnitude[inside]
    return ResidualRegion(low, high, len(sizes), np.quantile(sizes, QUANTILE, axis=0), sizes.max(axis=0))
