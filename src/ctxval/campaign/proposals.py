"""Points that a search proposes, with what the executions so far teach and what thinking costs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.progress import stage
from ctxval._util.texts import enumerated, shortened
from ctxval.campaign.choices import Choice
from ctxval.campaign.costs import costs_of
from ctxval.campaign.dynamics import PREDICTION, CampaignDynamics
from ctxval.campaign.history import waiting_points
from ctxval.campaign.steadiness import Steadiness
from ctxval.core.trial import CONVERGED, UNSTEADY, Trial
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.searches import BaseSearch, SequentialSearch

_MOVED = 0x6D6F
"""Identifies the random stream of moves away from tasks that are not steady."""


_SPREAD = 512
"""Number of random tasks of which the one farthest from all that are being executed is taken."""


class Proposals:
    """Asks the search of a campaign for points, and tests points before they are executed.

    Args:
        validation: the map p -> d(p).
        search: chooses points of the unit cube.
        dynamics: predicts distances from the executed trajectories.
    """

    def __init__(self, validation: Validation, search: BaseSearch, dynamics: CampaignDynamics) -> None:
        self._validation, self._search, self._dynamics = validation, search, dynamics

    def next(self, trials: Sequence[Trial], rejected: int = 0) -> tuple[Array, dict[str, Any] | None]:
        """Return the search's next point ``(d,)`` and its note."""
        steady = Steadiness(self._dynamics.planner)
        if not self._search.uses_prediction:
            return self._executable(self._asked(), trials, steady, rejected)
        with stage("choosing a task", unit="designs"):
            prediction = self._dynamics.prediction(trials, pending=True)
            if prediction is not None:
                expected = prediction.expected
                steady = Steadiness(self._dynamics.planner, lambda points: expected(points)[0])
                costs = partial(costs_of, prediction, self._validation, trials)
                prediction = replace(prediction, costs=costs, steady=steady)
            self._search.use_prediction(prediction)
            return self._executable(self._asked(), trials, steady, rejected)

    def spread(self, trials: Sequence[Trial]) -> Array | None:
        """Return a task far from all that are being executed, a point ``(d,)``, if nothing at all is known yet.

        Guesses of a search that knows nothing are random; far apart, and mostly with parameters at their bounds, they
        teach more. The first task is that of the search, also if others follow at once.
        """
        known = any(trial.distance is not None for trial in trials)
        waiting = waiting_points(trials)
        if known or not len(waiting) or not self._search.uses_prediction:
            return None
        if self._dynamics.prediction(trials) is not None:
            return None
        rng = np.random.default_rng([len(trials), _MOVED])
        some = rng.random((_SPREAD, waiting.shape[1]))
        some = np.where(rng.random(some.shape) < rng.random((_SPREAD, 1)), np.round(some), some)
        gaps = np.linalg.norm(some[:, None] - waiting, axis=2).min(axis=1)
        return np.asarray(some[gaps.argmax()])

    def tested(self, choice: Choice, trials: Sequence[Trial]) -> tuple[Array, dict[str, Any] | None]:
        """Return the point ``(d,)`` of a choice that another part has made, rounded and tested, and its note."""
        assert choice.unit_point is not None
        if choice.parameters is not None or choice.origin == "iid":
            return choice.unit_point, choice.note
        steady, point, rejected = Steadiness(self._dynamics.planner), choice.unit_point, choice.rejected
        if rejected is None:
            point, rejected = self._steady(point, trials, steady), steady.rejected
        return self._validation.space.rounded(point), _with_rejected(choice.note, rejected)

    def _asked(self) -> Array:
        asked, dimension = self._search.ask(1), self._validation.space.dimension
        try:
            point: Array = np.asarray(asked, dtype=np.float64) if np.isrealobj(asked) else np.array(np.nan)
        except (TypeError, ValueError):
            point = np.array(np.nan)
        if point.shape != (1, dimension) or not ((point >= 0) & (point <= 1)).all():
            raise InputError(
                f"a search must return points of the unit cube, shape (1, {dimension}), "
                f"got {shortened(repr(asked), 200)}."
            )
        return np.asarray(point[0])

    def _executable(
        self, point: Array, trials: Sequence[Trial], steady: Steadiness, rejected: int
    ) -> tuple[Array, dict[str, Any] | None]:
        """Return a proposed point, tested and rounded, and its note; tell the search which point it has become.

        The point of an earlier trial stays, and independent draws are only rounded.
        """
        note = _plain_note(self._search.note())
        if any(np.array_equal(point, trial.unit_point) for trial in trials):
            return point, note
        if not self._search.iid:
            point = self._steady(point, trials, steady)
        rounded = self._validation.space.rounded(point)
        if isinstance(self._search, SequentialSearch):
            self._search.amend(rounded)
        return rounded, _with_rejected(note, rejected + steady.rejected)

    def _steady(self, point: Array, trials: Sequence[Trial], steady: Steadiness) -> Array:
        """Return a steady point: the given one, or one next to it."""
        if self._validation.is_on_model:
            return point  # no distance depends on how a controller would react to errors of M
        return point if steady(point) else steady.moved(point, np.random.default_rng([len(trials), _MOVED]))


def _with_rejected(note: dict[str, Any] | None, rejected: int) -> dict[str, Any] | None:
    return {**(note or {}), UNSTEADY: rejected} if rejected else note


def _plain_note(note: Any) -> dict[str, Any] | None:
    """Return a search's note, which is stored as JSON."""
    reserved = (PREDICTION, CONVERGED, UNSTEADY)
    if isinstance(note, dict) and set(reserved) & set(note):
        raise InputError(f"the note of a search must not have the keys {enumerated(reserved, 10)}.")
    try:
        if note is None or (isinstance(note, dict) and json.dumps(note, allow_nan=False)):
            return note
    except (TypeError, ValueError):
        pass
    raise InputError(f"the note of a search must be a dictionary of plain values for JSON, got {note!r}.")
