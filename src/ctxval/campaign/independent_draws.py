"""Independent draws of tasks, which are different for each learned model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.describe import describe, rounded
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError
from ctxval.storage.store import Store

_AUDIT = 0x6175
"""Identifies the random stream of an audit; the streams of searches have small numbers."""


class IndependentDraws:
    """The random numbers of the independent draws of one campaign.

    They depend on the seed, so that a study can be repeated. They also depend on the model: otherwise, a model that was
    learned again with the results of an audit would be audited by the same tasks. The store keeps the number that
    depends on the model, so that a campaign continues with the same draws on another machine.

    Args:
        store: the store of the campaign.
        validation: contains the model.
        seed: the seed of the campaign.
    """

    def __init__(self, store: Store, validation: Validation, seed: int) -> None:
        self._store, self._validation, self._seed = store, validation, seed

    def search_seed(self, trials: Sequence[Trial]) -> int:
        """Return the seed of a search that depends on the model, because of independent draws or a refined model."""
        entropy = [self._seed, *self.of_model(trials)]
        return self._seed if len(entropy) == 1 else int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def point(self, trials: Sequence[Trial]) -> Array:
        """Return the next draw from the distribution of tasks, a point of the unit cube ``(d,)``."""
        entropy = [self._seed, len(trials), _AUDIT, *self.of_model(trials)]
        rng = np.random.default_rng(np.random.SeedSequence(entropy))
        return np.asarray(self._validation.space.unit_draws(1, rng)[0])

    def of_model(self, trials: Sequence[Trial]) -> list[int]:
        """Return the number of the model in a list; empty for stores of version 0.1.0 that have draws without it."""
        kept = self._store.draws()
        if kept is None and not any(trial.origin == "iid" for trial in trials):
            self._store.keep_draws(_digest_of_model(self._validation))
            kept = self._store.draws()
        return [] if kept is None else [kept]


def _digest_of_model(validation: Validation) -> int:
    """Return a number that identifies a model; it changes if the model is learned again.

    Independent draws of tasks depend on it, so that a model is never judged by the tasks of an earlier model.
    """
    space = validation.space
    loops: list[list[Any]] = []
    for point in (space.low, 0.5 * (space.low + space.high), space.high):
        try:
            trajectory = validation.plan(point).model_trajectory
            loops.append([trajectory.states.ravel().tolist(), trajectory.inputs.ravel().tolist()])
        except CtxvalError as error:
            loops.append([str(type(error).__name__)])
    content = json.dumps(rounded([describe(validation.model, private=True), loops], 5, least=1e-12), sort_keys=True)
    return int.from_bytes(hashlib.sha256(content.encode()).digest()[:8], "big")
