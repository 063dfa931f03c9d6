"""Learning dynamics with noise from growing sets of executions: whether there is noise, and with which history.

The better M is, the smaller its residual, and the larger the share of noise in it. So noise is not judged by this
share, but by what it does to distances in closed loop. How much history the next record depends on is the structure of
noisy dynamics, chosen by evidence.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ctxval._util.arrays import Array, Mask, single_threaded
from ctxval._util.latest import Latest
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.learning.closed_loops import AnyPosterior, LoopPlanner
from ctxval.learning.draws import Draws
from ctxval.learning.dynamics_posterior import DynamicsPosterior
from ctxval.learning.extended import ExtendedValidation
from ctxval.learning.histories import History, Record, Structure
from ctxval.learning.innovations import FilterFit, InnovationsFit, LaggedFit, fit_filter, fit_lagged
from ctxval.learning.noisy_draws import NoisyPosterior
from ctxval.learning.recorded import digest, scheduled
from ctxval.learning.stage_costs import Costs, Ledger, reduced
from ctxval.learning.worst_case import WorstCaseSearch


@dataclass(frozen=True)
class NoiseSettings:
    """When executions are noisy, and when they depend on more history than a state and an input."""

    structures: tuple[Structure, ...] = (
        *(Structure(lags) for lags in range(4)),
        *(Structure(lags, ratio) for lags, ratio in ((0, 3.0), (0, 30.0), (2, 30.0))),
    )

    exact: float = 1e-3  # share of noise below which records with lags determine the next one
    noisy: float = 0.01  # share of noise from which executions of one task differ
    matters: float = 0.01  # standard deviation of a task's distance that matters, as a share of the largest distance
    rounding: float = 1e-5  # standard deviation, as a share of a state's, below which it is rounding
    history_error: float = 0.1  # share of the error without a history that a history leaves at most
    history_residual: float = 0.02  # the same, as a share of the residual
    reproduced: float = 0.2  # error of executed distances by an exact history, as a share of the largest one
    diverged: float = 10.0  # multiple of the largest distance without it from which its closed loops diverge
    pool: int = 32  # tasks of the pool among which those with the largest distances show what noise does
    batched_pool: int = 256  # tasks of the pool whose closed loops must not diverge, if they run together
    tasks: int = 6  # number of these tasks
    runs: int = 10  # how often each of them is run
    replicates: int = 10  # sequences of noise of each draw in a search
    replicates_alone: int = 4  # the same, if each closed loop is designed and run on its own


class NoiseStudy:
    """Learns dynamics with noise and histories of one experiment; chosen structures are kept."""

    def __init__(
        self,
        extended: ExtendedValidation,
        planner: LoopPlanner,
        search: WorstCaseSearch,
        seed: int,
        quantile: float,
        settings: NoiseSettings = NoiseSettings(),
    ) -> None:
        self.extended, self.planner, self.search, self.seed, self.quantile = extended, planner, search, seed, quantile
        self.settings = settings
        self._structures = Latest[tuple[bytes, tuple[Structure, ...]], ChosenStructure](8)

    def learn(self, posterior: DynamicsPosterior, records: Sequence[Record], ledger: Ledger) -> NoisyPosterior | None:
        """Return dynamics with noise; None if task, state and input suffice for executions, or nothing is learned.

        What does not fit into the budget of the ledger is left out, the costly structures first.
        """
        with ledger.spending("noise"):
            return self._learn_within(posterior, records, ledger)

    def _learn_within(
        self, posterior: DynamicsPosterior, records: Sequence[Record], ledger: Ledger
    ) -> NoisyPosterior | None:
        settings = self.settings
        # Executions do not follow from task, state and input if noise, or what is not recorded, acts.
        is_needed = float((posterior.most_probable.noise**2).max()) > settings.noisy
        varies = not is_needed and any(self._varies(posterior, starts) for starts in (None, _scatter_of(records)))
        stage = "whether noise matters"
        if varies and not ledger.learns("noise", stage, lambda costs: costs.noise_on_distances()):
            return None
        is_needed = is_needed or self._effect(posterior) > settings.matters
        is_needed = is_needed or self._effect(posterior, _scatter_of(records)) > settings.matters
        asks = not is_needed and len(records) >= 3 and any(each.lags for each in settings.structures)
        if asks and ledger.learns("noise", "histories", lambda costs: costs.usual_lags()):
            last = records[-1]
            with contextlib.suppress(np.linalg.LinAlgError, InputError, ValueError), np.errstate(all="ignore"):
                mean = posterior.means_without([[len(records) - 1]])
                predicted = mean.step(last.states[:-1], last.inputs)
                is_needed = predicted_by_history(posterior, records, self.extended.pairs, predicted, settings)
        if not is_needed:
            return None
        replicates = settings.replicates if self.planner.batched else settings.replicates_alone
        structures = self._within(ledger, replicates)
        if not structures:
            return None
        some = scheduled(len(records))
        key, learned = (digest(records[:some]), structures), None
        if key not in self._structures:
            learned = self._learned(posterior, records[:some], replicates, structures)
            if learned is None:
                return None
            self._structures[key] = learned[1]
        if learned is None or some < len(records):
            learned = self._learned(posterior, records, replicates, structures, self._structures[key])
        if learned is None:
            return None
        noisy, _ = learned
        # If it changes distances by a negligible share of the largest one, it is left out. A certificate for all
        # executions would be withdrawn for it, though, so it is kept if first records show that there is noise indeed,
        # and no part of the dynamics that is not learned. Estimates of states deviate without noise, too.
        n = len(posterior.data.sizes)
        scatters = _scatter_of(records)[:n] > settings.rounding * posterior.data.scale[:n]
        hidden = self.extended.given.outputs.hide_states
        is_measured = not hidden and noisy.noise > settings.noisy and bool(scatters.any())
        return noisy if is_measured or self._effect(noisy) > settings.matters else replace(noisy, replicates=1)

    def _within(self, ledger: Ledger, replicates: int) -> tuple[Structure, ...]:
        """Return the structures that fit into the budget: all, those without measurement noise, or that of states.

        They leave time for the smallest search with sequences of noise, which takes longer than one without.
        """

        def smallest(costs: Costs) -> float:
            few = reduced(self.search.settings, costs.thinking.settings.shares[-1])
            return costs.search(few, replicates, whole=False)

        ledger.owed = max(ledger.owed, ledger.seconds("loops", smallest))
        structures = self.settings.structures
        without_filters = tuple(each for each in structures if not each.ratio)
        for stage, some in (
            ("measurement noise", structures),
            ("more than one lag", without_filters),
            ("histories", without_filters[:1]),
        ):
            lags, filters = [each.lags for each in some if not each.ratio], sum(bool(each.ratio) for each in some)

            def seconds(costs: Costs, lags: Sequence[int] = lags, filters: int = filters) -> float:
                return costs.lags(lags) + filters * costs.filter()

            if ledger.learns("noise", stage, seconds):
                return some
        ledger.replaced[-1] = "noise"
        return ()

    def again(
        self, noisy: NoisyPosterior, records: Sequence[Record], posterior: DynamicsPosterior, others: Sequence[Record]
    ) -> NoisyPosterior | None:
        """Return dynamics with the structure that was chosen for records, learned from other records."""
        structures = self.settings.structures
        chosen = self._structures[digest(records[: scheduled(len(records))]), structures]
        learned = self._learned(posterior, others, noisy.replicates, structures, chosen)
        return None if learned is None else learned[0]

    def _learned(
        self,
        posterior: DynamicsPosterior,
        records: Sequence[Record],
        replicates: int,
        structures: tuple[Structure, ...],
        chosen: ChosenStructure | None = None,
    ) -> tuple[NoisyPosterior, ChosenStructure] | None:
        """Return the posterior of noisy dynamics and its structure, which may be chosen; None if recursions diverge."""
        data = posterior.data
        try:
            with single_threaded(), np.errstate(all="ignore"):
                model, pairs = posterior.model_with(1.0), self.extended.pairs
                settings = replace(self.settings, structures=structures)
                fit, chosen = fit_structures(model, records, pairs, data.learned, chosen, settings)
        except (np.linalg.LinAlgError, InputError, ValueError):  # numbers that are not finite
            return None
        horizon, seed = max(len(record.inputs) for record in records), (self.seed, len(records))
        return NoisyPosterior(fit, data, _scatter_of(records), horizon, replicates, self.quantile, seed), chosen

    def _noisy(self, posterior: AnyPosterior) -> Draws | None:
        return posterior.with_noise(self.settings.runs, self._rounding(posterior))

    def _rounding(self, posterior: AnyPosterior) -> Array:
        return self.settings.rounding * posterior.data.scale[: len(posterior.data.sizes)]

    def _varies(self, posterior: AnyPosterior, starts: Array | None) -> bool:
        """Return whether noise, or starts with such deviations ``(n,)`` if they are given, are more than rounding."""
        if starts is None:
            return self._noisy(posterior) is not None
        return bool((starts > self._rounding(posterior)).any())

    def _effect(self, posterior: AnyPosterior, starts: Array | None = None) -> float:
        """Return the largest standard deviation of a task's distance over noise, as a share of the largest distance.

        If they are given, it is that over starts with such deviations ``(n,)``. The tasks have large finite distances.
        """
        planner, settings = self.planner, self.settings
        if not self._varies(posterior, starts):
            return 0.0
        noisy = self._noisy(posterior) if starts is None else None
        silent = posterior.mean.without_noise()
        with single_threaded(), np.errstate(all="ignore"):
            tasks = self.search.pool[: settings.pool]
            distances = planner.distances(silent, planner.plan(tasks), len(tasks))[0]
            distances = np.nan_to_num(distances, nan=-1.0, posinf=-1.0)
            planned = planner.plan(tasks[np.argsort(-distances, kind="stable")[: settings.tasks]])
            runs = np.full((settings.runs, min(settings.tasks, len(tasks))), np.nan)
            if noisy is not None:
                for plan, loops in zip(planned, planner.run(noisy, planned), strict=True):
                    runs[: len(loops.distances), plan.rows] = loops.distances[: settings.runs]
            elif starts is not None:
                rng = np.random.default_rng(0)
                for run in runs:
                    initial = [plan.task.initial_state for plan in planned]
                    moved = zip(planned, [x + starts * rng.standard_normal(x.shape) for x in initial], strict=True)
                    tried = [replace(plan, task=plan.task.starting_at(x)) for plan, x in moved]
                    run[:] = planner.distances(silent, tried, len(run))[0]
        runs = runs[:, np.isfinite(runs).any(axis=0)]
        if not runs.size or not distances.max() > 0:
            return 0.0
        return float(np.nanmax(np.nanstd(np.where(np.isfinite(runs), runs, np.nan), axis=0)) / distances.max())


def _scatter_of(records: Sequence[Record]) -> Array:
    """Return the standard deviations of first records from the initial states of their tasks, shape ``(n,)``."""
    return np.asarray(np.sqrt(np.mean([(record.states[0] - record.start) ** 2 for record in records], axis=0)))


class ChosenStructure(NamedTuple):
    """A structure, learned from some executions, with the hyperparameters of the fit whose records are the state."""

    structure: Structure
    theta: Array


def fit_structures(
    model: Model, records: Sequence[Record], pairs: Array, live: Mask, chosen: ChosenStructure | None = None,
    settings: NoiseSettings = NoiseSettings(),
) -> tuple[InnovationsFit, ChosenStructure]:  # fmt: skip
    """Return the posterior of the most probable structure, or of a structure that was chosen before.

    Fewer lags are preferred: the fewest that determine the next record, or else those with the largest evidence.
    Measurement noise is considered if no lags determine it.
    """

    def lagged(structure: Structure, theta: Array | None) -> LaggedFit:
        history = History(model, structure, np.eye(len(live)))
        return fit_lagged(history, records, pairs, theta, live)

    def filtered(structure: Structure, plain: InnovationsFit) -> FilterFit:
        middle = plain.scaled.shift[: len(live)], plain.scaled.shift[len(live) : pairs.shape[1]]
        scales = np.maximum(plain.noise, 1e-9 * plain.scaled.scale[: len(live)])
        return fit_filter(History.of(model, structure, scales, middle), records, pairs, plain)

    if chosen is not None:
        plain = lagged(Structure(0 if chosen.structure.ratio else chosen.structure.lags), chosen.theta)
        return (filtered(chosen.structure, plain) if chosen.structure.ratio else plain), chosen
    possible = [structure for structure in settings.structures if structure.lags <= max(1, len(records))]
    fits: list[InnovationsFit] = [lagged(structure, None) for structure in possible if not structure.ratio]
    of_states, least = fits[0], min(fit.share for fit in fits)
    exact = [fit for fit in fits if fit.share <= max(10 * least, 1e-6)] if least <= settings.exact else []
    best = min(exact, key=lambda fit: fit.history.structure.lags) if exact else max(fits, key=_preference)
    if best.share > settings.noisy:
        for structure in possible:
            if structure.ratio:
                with contextlib.suppress(np.linalg.LinAlgError):
                    fits.append(filtered(structure, of_states))
        best = max(fits, key=_preference)
    structure = best.history.structure
    return best, ChosenStructure(structure, (of_states if structure.ratio else best).theta)


def predicted_by_history(
    posterior: DynamicsPosterior, records: Sequence[Record], pairs: Array, without_history: Array,
    settings: NoiseSettings,
) -> bool:  # fmt: skip
    """Return whether a history predicts the last record far better than state and input do, or neither predicts it."""
    last, sizes, live = records[-1], posterior.data.sizes, posterior.data.learned

    def share(errors: Array) -> float:
        return float(((errors[:, live] / sizes[live]) ** 2).mean(axis=0).max())

    without = share(last.states[1:] - without_history)
    if without < settings.exact:
        return False
    shares = []
    for lags in (1, 2, 3):
        history = History(posterior.covariances.model, Structure(lags), np.eye(len(live)))
        fit = fit_lagged(history, records[:-1], pairs, None, live, usual=True)
        with_history = share(history.along([last], fit.residual)[2])
        if with_history < min(settings.history_error * without, settings.history_residual):
            return True
        shares += [with_history, fit.share]
    # Share of the residual that nothing predicts if there is noise.
    return min(without, *shares) > 0.05  # noise


def _preference(fit: InnovationsFit) -> float:
    structure = fit.history.structure
    return fit.evidence - 3 * structure.lags - (3 if structure.ratio else 0)
