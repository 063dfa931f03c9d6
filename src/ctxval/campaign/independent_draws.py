"""Independent draws of tasks, which are different for each learned model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.storage.store import Store
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError


class IndependentDraws:
    """The random numbers of the independent draws of one campaign.

    They depend on the seed, so that a study can be repeated. They also depend on the model: otherwise, a model that was
    learned again with the results of an audit would be audited by the same tasks. The store keeps the number that
    depends on the model, so that a campaign continues with the same draws on another machine.
    """

    def __init__(self, store: Store, validation: Validation, seed: int) -> None:
        self._store, self._validation, self._seed = store, validation, seed

    def search_seed(self) -> int:
        """Return the seed of a search that depends on the model, because of independent draws or a refined model."""
        return int(np.random.SeedSequence([self._seed, self.of_model()]).generate_state(1)[0])

    def point(self, trials: Sequence[Trial]) -> Array:
        """Return the next draw from the distribution of tasks, a point of the unit cube ``(d,)``."""
        space = self._validation.space
        return space.rounded(space.unit_draws(1, self.generator(trials))[0])

    def generator(self, trials: Sequence[Trial]) -> np.random.Generator:
        """Return the random numbers of the next draw; the streams of searches have smaller numbers."""
        entropy = [self._seed, len(trials), 0x6175, self.of_model()]
        return np.random.default_rng(np.random.SeedSequence(entropy))

    def of_model(self) -> int:
        """Return the number of the model, which the store keeps, because another processor rounds differently."""
        if self._store.draws() is None:
            self._store.keep_draws(_number_of_model(self._validation))
        return self._store.draws() or 0


def _number_of_model(validation: Validation) -> int:
    """Return a number that identifies a model by its closed loops, and by steps from states and inputs around them."""
    space = validation.space
    rows: list[Array] = []
    for point in (space.low, 0.5 * (space.low + space.high), space.high):
        with suppress(CtxvalError):
            loop = validation.plan(point).model_trajectory
            rows.append(np.hstack([loop.states[:-1], loop.inputs]))
    if not rows:
        return 0
    visited, n = np.concatenate(rows), loop.states.shape[-1]
    low, high = visited.min(axis=0), visited.max(axis=0)
    with suppress(CtxvalError):
        z = np.random.default_rng(0).uniform(2 * low - high, 2 * high - low, (2000, len(low)))
        rows.append(validation.model.step(z[:, :n], z[:, n:]))
    content = json.dumps([[f"{0.0 if abs(value) < 1e-12 else value:.5g}" for value in row.ravel()] for row in rows])
    return int.from_bytes(hashlib.sha256(content.encode()).digest()[:8], "big")
