"""Learning dynamics with noise from growing sets of executions: whether there is noise, and with which history."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.latest import Latest
from ctxval.errors import InputError
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.extended import ExtendedValidation
from ctxval.learning.histories import Record
from ctxval.learning.noise_effect import effect_of_noise, effect_of_starts
from ctxval.learning.noisy_draws import MATTERS, REPLICATES, NoisyPosterior, learn_noisy, scatter_of
from ctxval.learning.recorded import digest, scheduled
from ctxval.learning.structures import NOISY, ChosenStructure, predicted_by_history
from ctxval.learning.worst_case import WorstCaseSearch

_TRIED = 32  # tasks of the pool among which those with the largest distances show what noise does


class NoiseStudy:
    """Learns dynamics with noise and histories of one experiment; chosen structures are kept.

    Args:
        search: whose pool of tasks shows what noise does to distances.
        quantile: the share of the executions of a task that a distance is about.
    """

    def __init__(
        self, extended: ExtendedValidation, planner: LoopPlanner, search: WorstCaseSearch, seed: int, quantile: float
    ) -> None:
        self.extended, self.planner, self.search, self.seed, self.quantile = extended, planner, search, seed, quantile
        self._structures = Latest[bytes, ChosenStructure](8)

    def learn(self, posterior: DynamicsPosterior, records: Sequence[Record]) -> NoisyPosterior | None:
        """Return dynamics with noise; None if executions follow from task, state and input, or if nothing is learned.

        Args:
            posterior: what the executions teach without noise.
            records: of these executions.
        """
        if not self._is_needed(posterior, records):
            return None
        some = scheduled(len(records))
        key = digest(records[:some])
        # There are fewer sequences of noise if each closed loop is designed and run on its own.
        replicates = REPLICATES if self.planner.batched else 4
        learn = functools.partial(
            learn_noisy, posterior, pairs=self.extended.pairs, replicates=replicates, quantile=self.quantile
        )
        if key not in self._structures:
            first = learn(records[:some], seed=(self.seed, some))
            if first is None:
                return None
            self._structures[key] = first[1]
            if some == len(records):
                return self._with_effect(first[0])
        again = learn(records, chosen=self._structures[key], seed=(self.seed, len(records)))
        return None if again is None else self._with_effect(again[0])

    def again(
        self, noisy: NoisyPosterior, records: Sequence[Record], posterior: DynamicsPosterior, others: Sequence[Record]
    ) -> NoisyPosterior | None:
        """Return dynamics with the structure that was chosen for records, learned from other records."""
        chosen = self._structures[digest(records[: scheduled(len(records))])]
        again = learn_noisy(
            posterior, others, self.extended.pairs, chosen,
            replicates=noisy.replicates, quantile=noisy.quantile, seed=(self.seed, len(others)),
        )  # fmt: skip
        return None if again is None else again[0]

    def _with_effect(self, noisy: NoisyPosterior) -> NoisyPosterior:
        return noisy.with_effect(effect_of_noise(self.planner, noisy, self.search.pool[:_TRIED]))

    def _is_needed(self, posterior: DynamicsPosterior, records: Sequence[Record]) -> bool:
        """Return whether executions do not follow from task, state and input: noise, or what is not recorded, acts."""
        if float((posterior.most_probable.noise**2).max()) > NOISY:
            return True
        tasks = self.search.pool[:_TRIED]
        if effect_of_noise(self.planner, posterior, tasks) > MATTERS:
            return True
        if effect_of_starts(self.planner, posterior, tasks, scatter_of(records)) > MATTERS:
            return True
        if len(records) < 3:
            return False
        last = records[-1]
        with contextlib.suppress(np.linalg.LinAlgError, InputError, ValueError), np.errstate(all="ignore"):
            mean = posterior.means_without([[len(records) - 1]])
            predicted: Array = mean.step(last.states[None, :-1], last.inputs[None])[0]
            return predicted_by_history(posterior, records, self.extended.pairs, predicted)
        return False
