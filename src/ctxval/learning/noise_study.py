"""Learning dynamics with noise from growing sets of executions: whether there is noise, and with which history.

The better M is, the smaller its residual, and the larger the share of noise in it. So noise is not judged by this
share, but by what it does to distances in closed loop.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.latest import Latest
from ctxval.errors import InputError
from ctxval.learning.closed_loops import LoopPlanner, PlannedTasks
from ctxval.learning.draws import DisturbedDynamics
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.extended import ExtendedValidation
from ctxval.learning.histories import Record
from ctxval.learning.noisy_draws import REPLICATES, NoisyPosterior
from ctxval.learning.recorded import digest, scheduled
from ctxval.learning.structures import NOISY, ChosenStructure, fit_structures, predicted_by_history
from ctxval.learning.worst_case import WorstCaseSearch

MATTERS = 0.01
"""Standard deviation of the distance of a task over its executions, as a share of the largest distance, from which
noise matters."""

_TRIED = 32  # tasks of the pool among which those with the largest distances show what noise does
_TASKS, _RUNS = 6, 10  # these tasks, and how often each of them is run
_ROUNDING = 1e-5  # standard deviation of noise, as a share of a state's, below which it is rounding


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
        replicates, learned = REPLICATES if self.planner.batched else 4, None
        if key not in self._structures:
            learned = self._learned(posterior, records[:some], replicates)
            if learned is None:
                return None
            self._structures[key] = learned[1]
        if learned is None or some < len(records):
            learned = self._learned(posterior, records, replicates, self._structures[key])
        if learned is None:
            return None
        noisy, _ = learned
        # If it changes distances by a negligible share of the largest one, it is left out.
        return noisy if self._effect_of_noise(noisy) > MATTERS else replace(noisy, replicates=1)

    def again(
        self, noisy: NoisyPosterior, records: Sequence[Record], posterior: DynamicsPosterior, others: Sequence[Record]
    ) -> NoisyPosterior | None:
        """Return dynamics with the structure that was chosen for records, learned from other records."""
        chosen = self._structures[digest(records[: scheduled(len(records))])]
        learned = self._learned(posterior, others, noisy.replicates, chosen)
        return None if learned is None else learned[0]

    def _learned(
        self,
        posterior: DynamicsPosterior,
        records: Sequence[Record],
        replicates: int,
        chosen: ChosenStructure | None = None,
    ) -> tuple[NoisyPosterior, ChosenStructure] | None:
        """Return the posterior of noisy dynamics, and its structure, which is learned unless it was chosen before.

        Returns None if nothing can be learned: the recursions diverge, or numbers are too large.
        """
        data = posterior.data
        try:
            with single_threaded(), np.errstate(all="ignore"):
                fit, chosen = fit_structures(posterior.model, records, self.extended.pairs, data.learned, chosen)
        except (np.linalg.LinAlgError, InputError, ValueError):  # numbers that are not finite
            return None
        horizon, seed = max(len(record.inputs) for record in records), (self.seed, len(records))
        return NoisyPosterior(fit, data, _scatter_of(records), horizon, replicates, self.quantile, seed), chosen

    def _is_needed(self, posterior: DynamicsPosterior, records: Sequence[Record]) -> bool:
        """Return whether executions do not follow from task, state and input: noise, or what is not recorded, acts."""
        if float((posterior.most_probable.noise**2).max()) > NOISY:
            return True
        if self._effect_of_noise(posterior) > MATTERS or self._effect_of_starts(posterior, records) > MATTERS:
            return True
        if len(records) < 3:
            return False
        last = records[-1]
        with contextlib.suppress(np.linalg.LinAlgError, InputError, ValueError), np.errstate(all="ignore"):
            mean = posterior.means_without([[len(records) - 1]])
            predicted: Array = mean.step(last.states[None, :-1], last.inputs[None])[0]
            return predicted_by_history(posterior, records, self.extended.pairs, predicted)
        return False

    def _effect_of_noise(self, posterior: DynamicsPosterior | NoisyPosterior) -> float:
        """Return the largest standard deviation of the distance of a task over noise, as a share of the largest one.

        Of some tasks, those with the largest distances count. Only finite distances do.
        """
        scatter = posterior.scatter if isinstance(posterior, NoisyPosterior) else np.zeros(1)
        if not _matters(posterior.deviations, posterior) and not _matters(scatter, posterior):
            return 0.0
        with single_threaded(), np.errstate(all="ignore"):
            planned, count, largest = self._largest(posterior)
            runs = np.full((_RUNS, count), np.nan)
            noisy = posterior.mean if isinstance(posterior, NoisyPosterior) else _shaken(posterior)
            for plan, loops in zip(planned, self.planner.run(noisy, planned), strict=True):
                runs[: len(loops.distances), plan.rows] = loops.distances[:_RUNS]
        return _share(runs, largest)

    def _effect_of_starts(self, posterior: DynamicsPosterior, records: Sequence[Record]) -> float:
        """Return the same over initial states that deviate from those of the tasks as those of the records do."""
        scatter = _scatter_of(records)
        if not _matters(scatter, posterior):
            return 0.0
        rng = np.random.default_rng(0)
        with single_threaded(), np.errstate(all="ignore"):
            planned, count, largest = self._largest(posterior)
            runs = []
            for _ in range(_RUNS):
                starts = (plan.task.initial_state for plan in planned)
                moved = [start + scatter * rng.standard_normal(start.shape) for start in starts]
                tried = [replace(plan, task=plan.task.starting_at(x)) for plan, x in zip(planned, moved, strict=True)]
                runs.append(self.planner.distances(posterior.silent, tried, count)[0])
        return _share(np.stack(runs), largest)

    def _largest(self, posterior: DynamicsPosterior | NoisyPosterior) -> tuple[list[PlannedTasks], int, float]:
        """Return the plans of the tasks with the largest distances without noise, their number, and the largest one."""
        tasks = self.search.pool[:_TRIED]
        distances = self.planner.distances(posterior.silent, self.planner.plan(tasks), len(tasks))[0]
        distances = np.nan_to_num(distances, nan=-1.0, posinf=-1.0)
        chosen = tasks[np.argsort(-distances, kind="stable")[:_TASKS]]
        return self.planner.plan(chosen), len(chosen), float(distances.max())


def _scatter_of(records: Sequence[Record]) -> Array:
    """Return the standard deviations of first records from the initial states of their tasks, shape ``(n,)``."""
    return np.asarray(np.sqrt(np.mean([(record.states[0] - record.start) ** 2 for record in records], axis=0)))


def _share(runs: Array, largest: float) -> float:
    """Return the largest standard deviation over runs ``(R, q)`` of finite distances as a share of the largest one."""
    runs = runs[:, np.isfinite(runs).any(axis=0)]
    if not runs.size or not largest > 0:
        return 0.0
    finite = np.where(np.isfinite(runs), runs, np.nan)
    return float(np.nanmax(np.nanstd(finite, axis=0)) / largest)


def _matters(deviations: Array, posterior: DynamicsPosterior | NoisyPosterior) -> bool:
    """Return whether standard deviations ``(n,)`` of states are more than rounding."""
    return bool((deviations > _ROUNDING * posterior.data.scale[: len(posterior.data.sizes)]).any())


def _shaken(posterior: DynamicsPosterior) -> DisturbedDynamics:
    """Return the posterior mean with white noise as large as was learned, several times."""
    deviations = posterior.deviations

    def noise(ways: Rows, x: Array) -> Array:
        # The noise is a function of the states, so that a loop is the same each time.
        seed = np.frombuffer(np.ascontiguousarray(x).tobytes()[-64:], dtype=np.uint32)
        rng = np.random.default_rng([int(ways[0]), *seed.tolist()])
        return deviations * rng.standard_normal(x.shape)

    return DisturbedDynamics(posterior.mean, np.arange(_RUNS), noise)
