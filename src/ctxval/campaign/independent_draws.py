"""Independent draws of tasks, which a model does not share with the one that was learned after it."""

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
"""Marks the randomness of an audit's draws; searches mark streams of theirs with small numbers."""


class IndependentDraws:
    """The randomness of the independent draws of one campaign.

    It depends on the seed, so that a study can be repeated, and on the model: one that was learned again from what an
    audit showed would otherwise be audited by the very tasks that it has seen. The store keeps the model's part, so
    that a campaign goes on the same on another machine.

    Args:
        store: of the campaign.
        validation: has the model.
        seed: of the campaign.
    """

    def __init__(self, store: Store, validation: Validation, seed: int) -> None:
        self._store, self._validation, self._seed = store, validation, seed

    def search_seed(self, trials: Sequence[Trial]) -> int:
        """Return the seed of a search whose points are all independent draws."""
        entropy = [self._seed, *self._of_model(trials)]
        return self._seed if len(entropy) == 1 else int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def point(self, trials: Sequence[Trial]) -> Array:
        """Return the next draw of an audit, a point of the unit cube ``(d,)``."""
        entropy = [self._seed, len(trials), _AUDIT, *self._of_model(trials)]
        return np.random.default_rng(np.random.SeedSequence(entropy)).random(self._validation.space.dimension)

    def _of_model(self, trials: Sequence[Trial]) -> list[int]:
        """Return the model's part; none in stores of version 0.1.0 that have drawn without it."""
        kept = self._store.draws()
        if kept is None and not any(trial.origin == "iid" for trial in trials):
            self._store.keep_draws(_digest_of_model(self._validation))
            kept = self._store.draws()
        return [] if kept is None else [kept]


def _digest_of_model(validation: Validation) -> int:
    """Return a number that another model, one that was learned again for instance, does not share.

    Independent draws of tasks depend on it, so that a model is never judged by tasks that the one before it was.
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
