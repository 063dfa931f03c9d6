"""The distances of tasks on draws of the learned dynamics, from which an envelope is made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import ShortRepr
from ctxval.certificates.bounds import rank_within

FLOOR = 0.005  # least spread, as a share of the threshold
LARGEST = 2.0  # multiple of the threshold up to which bounds are told apart


@dataclass(frozen=True, eq=False)
class DrawnDistances(ShortRepr):
    """The distances of some tasks on draws of the learned dynamics."""

    points: Array  #: tasks, points of the unit cube ``(K, d)``
    draws: Array  #: distances on S draws ``(S, K)``; infinity if a loop diverges, NaN if no controller can be designed
    beyond: Array  #: how far the loop on the mean leaves the records, as a share of the visited range ``(K,)``
    #: how far it comes from places that executions entered ``(K,)``, as a share of what is allowed; 0 without positions
    away: Array
    crossed: Array | None = None  #: how far it crosses the boundary of the regular part, from -1 to 1; None without one

    @property
    def known(self) -> Mask:
        """Which tasks have a finite distance on each draw, ``(K,)``."""
        return np.asarray(np.isfinite(self.draws).all(axis=0))

    @property
    def mean(self) -> Array:
        """The means over the draws ``(K,)``; infinity if a distance is not known."""
        return np.where(self.known, np.where(self.known, self.draws, 0.0).mean(axis=0), np.inf)

    def spread(self, threshold: float) -> Array:
        """Return the standard deviations over the draws ``(K,)``, at least a share of the threshold."""
        return np.asarray(np.maximum(np.where(self.known, self.draws, 0.0).std(axis=0), FLOOR * threshold))

    def factor(self, threshold: float, confidence: float) -> float:
        """Return k: the order statistic of the largest standardised excesses of the draws; at least 1."""
        known, spread = self.known, self.spread(threshold)
        excess = ((self.draws - self.mean)[:, known] / spread[known]).max(axis=1, initial=0.0)
        return max(1.0, float(np.sort(excess)[rank_within(confidence, len(excess)) - 1]))

    def and_others(self, others: DrawnDistances) -> DrawnDistances:
        """Return these tasks together with others on the same draws."""
        return DrawnDistances(
            np.concatenate([self.points, others.points]),
            np.concatenate([self.draws, others.draws], axis=1),
            np.concatenate([self.beyond, others.beyond]),
            np.concatenate([self.away, others.away]),
            None if self.crossed is None or others.crossed is None else np.concatenate([self.crossed, others.crossed]),
        )

    def uncovered(self, most: float) -> Array:
        """Return how far loops leave records, by ``most`` at most, and places ``(K,)``: above 1 they do so too far."""
        return np.asarray(np.maximum(self.beyond / most, self.away))

    def departures(self, most: float) -> Array:
        """Return how far loops leave records, leave places, and cross the boundary ``(K, 3)``: above 1 too far."""
        # All have the same slope: smaller slopes cost more of the set, because their errors reach farther.
        crossing = np.zeros(len(self.points)) if self.crossed is None else (most + self.crossed) / most
        return np.minimum(np.stack([self.beyond / most, self.away, crossing], axis=1), LARGEST)

    def leaving(self, most: float) -> Array:
        """Return the largest departure ``(K,)``; nothing is known of tasks above 1."""
        return np.asarray(self.departures(most).max(axis=1))

    def upper(self, factor: float, threshold: float) -> Array:
        """Return mean + k spread as shares of the threshold ``(K,)``, at most ``LARGEST``."""
        return np.asarray(np.minimum((self.mean + factor * self.spread(threshold)) / threshold, LARGEST))
