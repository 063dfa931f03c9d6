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
from ctxval._util.representation import call
from ctxval._util.texts import shortened
from ctxval.campaign.costs import costs_of
from ctxval.campaign.dynamics import AUDIT, PREDICTION
from ctxval.campaign.history import predict_from
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.learning.prediction import DistancePredictor
from ctxval.searches import BaseSearch
from ctxval.storage.store import Store


class Proposals:
    """Asks the search of a campaign for points.

    Args:
        validation: the map p -> d(p).
        search: chooses points of the unit cube.
        store: the store of the trajectories.
    """

    def __init__(self, validation: Validation, search: BaseSearch, store: Store) -> None:
        self._validation, self._search, self._store = validation, search, store
        self._predictor = DistancePredictor(validation)

    def next(self, trials: Sequence[Trial]) -> tuple[Array, dict[str, Any] | None]:
        """Return the search's next point ``(d,)`` and its note.

        Args:
            trials: all trials, as the search knows them.

        Raises:
            InputError: if the search returns no point of the unit cube, or a note that JSON does not have.
        """
        if not self._search.uses_prediction:
            return self._asked(), _plain_note(self._search.note())
        with stage("choosing a task", unit="designs"):
            prediction = predict_from(self._predictor, self._store, trials)
            if prediction is not None:
                prediction = replace(prediction, costs=partial(costs_of, prediction, self._validation, trials))
            self._search.use_prediction(prediction)
            return self._asked(), _plain_note(self._search.note())

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

    def __repr__(self) -> str:
        return call(self, self._search)


def _plain_note(note: Any) -> dict[str, Any] | None:
    """Return a search's note, which is stored as JSON.

    Raises:
        InputError: if it is not a dictionary of plain values, or has a key of the campaign's own.
    """
    if isinstance(note, dict) and {PREDICTION, AUDIT} & set(note):
        raise InputError(f"the note of a search must not have the keys {PREDICTION!r} and {AUDIT!r}.")
    try:
        if note is None or (isinstance(note, dict) and json.dumps(note, allow_nan=False)):
            return note
    except (TypeError, ValueError):
        pass
    raise InputError(f"the note of a search must be a dictionary of plain values for JSON, got {note!r}.")
