"""Distances that all executions of a comparison together predict for each candidate; nothing is executed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.progress import stage
from ctxval.comparison.candidates import Candidate
from ctxval.core.trajectory import Trajectory
from ctxval.learning import DynamicsStudy
from ctxval.searches import Prediction

# Identify random streams of tasks that are only predicted; they are none of the streams of trials.
_POOL_STREAM, _CENTRE_STREAM = 0x706F, 0x6365

Known = Sequence[tuple[Array, Trajectory]]
"""Executed tasks, points of the unit cube ``(d,)``, with the system's trajectories."""


class Predictions:
    """Predicts the distances of one candidate, from the executions of all.

    The system is the same for all candidates, so each execution teaches the residual of each model, whatever controller
    was used.
    """

    def __init__(self, candidate: Candidate, seed: int) -> None:
        self.candidate, self._seed = candidate, seed
        self._space = candidate.campaign.validation.space
        self._study = DynamicsStudy(candidate.campaign.validation, seed)
        self._batched = bool(getattr(candidate.campaign.validation.synthesizer, "batched", False))
        self._last: tuple[tuple[int, ...], Prediction | None] | None = None

    def highest(self, known: Known) -> tuple[float, Array] | None:
        """Return the largest predicted distance and its task ``(d,)``; None if nothing can be predicted."""
        prediction = self._from(known)
        if prediction is None:
            return None
        # With and without designs in batches.
        rng, count = np.random.default_rng([self._seed, _POOL_STREAM]), (400, 48)[not self._batched]
        points = rng.random((count, self._space.dimension))
        snapped = rng.random(points.shape) < 0.5 * (np.arange(count) % 2)[:, None]  # maxima often lie at bounds
        points = np.where(snapped, np.round(points), points)
        with stage("predicting distances", count, "designs"):
            expected = prediction.expected(points)[0]
        if not np.isfinite(expected).any():
            return None
        best = int(np.nanargmax(np.where(np.isfinite(expected), expected, np.nan)))
        return float(expected[best]), points[best]

    def of_draw(self, known: Known, point: Array, draw: int, most: float | None) -> tuple[float, float] | None:
        """Return the prediction of a draw and its mean over other tasks; None if nothing can be predicted.

        The mean is over new independent tasks for each draw, so that its error has the expectation 0.
        """
        prediction = self._from(known)
        if prediction is None:
            return None
        rng = np.random.default_rng([self._seed, draw, _CENTRE_STREAM])
        others = self._space.unit_draws((200, 24)[not self._batched], rng)  # with and without designs in batches
        with stage("predicting distances", len(others) + 1, "designs"):
            expected = prediction.expected(np.concatenate([others, point[None]]))[0]
        largest = max(self.candidate.largest, 0.0)
        # Learned dynamics may diverge.
        limit = most if most is not None else (2.0 * largest if largest > 0 else np.inf)
        usual = 0.5 * limit if np.isfinite(limit) else 0.0
        values = np.clip(np.where(np.isfinite(expected), expected, usual), 0.0, limit)
        return float(values[-1]), float(values[:-1].mean())

    def _from(self, known: Known) -> Prediction | None:
        key = tuple(id(trajectory) for _, trajectory in known)
        if self._last is None or self._last[0] != key:
            try:
                prediction = self._study.predict(list(known))
            except Exception:  # the user's parts, at states that no execution has reached, must not end a comparison
                prediction = None
            self._last = key, prediction
        return self._last[1]
