"""The prediction of an execution, which is stored before the execution, and how well the execution agrees with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ctxval._util.arrays import Array, ArrayLike
from ctxval._util.describe import plain_json
from ctxval._util.representation import ShortRepr
from ctxval.core.quantiles import LEVELS, chance_of_more
from ctxval.core.trajectory import Trajectory

if TYPE_CHECKING:
    from ctxval.learning.closed_loops import LoopPlanner
    from ctxval.learning.draws import Draws

_QUANTILES = np.linspace(0.0, 1.0, 21)  # levels of the stored quantiles of the distance


@dataclass(frozen=True)
class NoisePrediction(ShortRepr):
    """What the executions of one task are predicted to be if the system is noisy, as quantiles at ``LEVELS``."""

    runs: int  # the number of closed loops that the quantiles are of
    distances: tuple[float, ...]  # those of the distance
    roughness: tuple[float, ...]  # root mean squares of the second differences of each state from step to step
    # those of statistics of the trajectory: its mean squared deviation from the median, and the mean square and the
    # largest magnitude of its second differences, relative to roughness
    statistics: tuple[tuple[float, ...], ...]

    def chance_of_more(self, distance: float) -> float:
        """Return the predicted probability that the distance of an execution exceeds a value."""
        return chance_of_more(self.distances, distance, self.runs)

    def p_values(self, executed: Trajectory, deviation: float) -> tuple[float, ...]:
        """Return the predicted probabilities that the statistics exceed those of an execution."""
        differences = _differences(executed.states[None], np.array(self.roughness))
        pairs = zip(self.statistics, (deviation, *(float(each[0]) for each in differences)), strict=True)
        return tuple(chance_of_more(quantiles, value, self.runs) for quantiles, value in pairs)


def _differences(states: Array, roughness: Array) -> tuple[Array, Array]:
    """Return the mean square and the largest magnitude of the second differences of states ``(L, H + 1, n)``."""
    if states.shape[1] < 3:
        return np.zeros(len(states)), np.zeros(len(states))
    scaled = np.diff(states, 2, axis=1) / np.maximum(roughness, 1e-12)
    return (scaled**2).mean(axis=(1, 2)), np.abs(scaled).max(axis=(1, 2))


@dataclass(frozen=True)
class ExecutionPrediction(ShortRepr):
    """Draws of the trajectory and of the distance of one task, summarised in plain numbers for JSON."""

    learned_from: int
    quantiles: tuple[float, ...]  # quantiles of the distance at 0, 0.05, ..., 1; infinity if a draw diverges
    deviation: float  # standard deviation of the distance over the draws that do not diverge
    steps: tuple[int, ...]  # indices of the predicted states, from 1 to the horizon
    states: tuple[tuple[float, ...], ...]  # medians of the states at these steps, one row for each
    deviations: tuple[tuple[float, ...], ...]  # standard deviations of the states at these steps, one row for each
    diverged: float  # share of the draws that diverge
    noise: NoisePrediction | None = None  # what noise does to the execution; None if the system is not noisy

    @property
    def median(self) -> float:
        """The median of the distance."""
        return self.quantiles[len(self.quantiles) // 2]

    @property
    def upper(self) -> float:
        """The 0.95 quantile of the distance."""
        return self.quantiles[-2]

    def to_json(self) -> dict[str, Any]:
        """Return all attributes, ready for JSON: infinity is None."""
        return plain_json(vars(self))

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self | None:
        """Return the prediction that :meth:`to_json` returned; None if these are not its values."""
        try:
            prediction = cls(
                int(values["learned_from"]),
                tuple(np.inf if value is None else float(value) for value in values["quantiles"]),
                float(values["deviation"]),
                tuple(int(step) for step in values["steps"]),
                _rows(values["states"]),
                _rows(values["deviations"]),
                float(values["diverged"]),
            )
            if (noise := values.get("noise")) is not None:
                distances = tuple(np.inf if value is None else float(value) for value in noise["distances"])
                (roughness,) = _rows([noise["roughness"]])
                noise = NoisePrediction(int(noise["runs"]), distances, roughness, _rows(noise["statistics"]))
                if {len(row) for row in (distances, *noise.statistics)} != {len(LEVELS)} or len(noise.statistics) != 3:
                    return None
        except (KeyError, TypeError, ValueError, OverflowError):
            return None
        widths = {len(row) for row in (*prediction.states, *prediction.deviations)}
        lengths = {len(prediction.steps), len(prediction.states), len(prediction.deviations)}
        ordered = all(low <= high for low, high in pairwise(prediction.quantiles))
        consistent = len(prediction.quantiles) == len(_QUANTILES) and ordered and len(lengths) == len(widths) == 1
        return replace(prediction, noise=noise) if consistent else None

    def score(self, executed: Trajectory, distance: float) -> PredictionScore | None:
        """Return how an execution agrees with the prediction; None if they do not fit together."""
        states = np.array(self.states)
        if max(self.steps) > executed.horizon or states.shape[1:] != executed.states.shape[1:]:
            return None
        rank = float(np.interp(distance, np.nan_to_num(self.quantiles, posinf=1e300), _QUANTILES))
        if self.diverged > 0.5:
            # Nothing is predicted, so nothing can be contradicted, and nothing is confirmed.
            return PredictionScore(np.inf, rank, 0.0, (1.0,) * 3 if self.noise else ())
        ranges = np.maximum(np.ptp(states if self.noise else executed.states, axis=0), 1e-9)
        # Deviations of a state below 1e-4 of its range and of the distance below 0.2 % of it are no errors.
        reached = executed.states[list(self.steps)]
        of_states = float(_deviation(reached[None], states, np.array(self.deviations), ranges)[0])
        scale2 = self.deviation**2 + (2e-3 * max(distance, self.median)) ** 2
        of_distance = (distance - self.median) ** 2 / max(scale2, 1e-300)
        p_values = () if self.noise is None else self.noise.p_values(executed, of_states)
        return PredictionScore(max(of_states, of_distance), rank, distance / max(self.median, 1e-300), p_values)


@dataclass(frozen=True)
class PredictionScore:
    """How an execution agrees with its prediction."""

    # squared standardised error, the larger one of the trajectory and of the distance; infinity if most draws diverged
    z2: float
    rank: float  # share of the draws whose distance is below the executed one
    ratio: float  # the executed distance, divided by the median of the draws
    # predicted probabilities of more than what statistics of the trajectory are; empty without noise
    p_values: tuple[float, ...] = ()


def _deviation(states: Array, medians: Array, deviations: Array, ranges: Array) -> Array:
    """Return squared deviations ``(L,)`` of states ``(L, k, n)`` from medians, relative to their variances."""
    variances = (deviations / ranges) ** 2 + 1e-4**2
    return np.asarray((((states - medians) / ranges) ** 2).sum(axis=(1, 2)) / variances.sum())


def predict_execution(
    planner: LoopPlanner,
    draws: Draws,
    point: Array,
    learned_from: int,
    recorded: Callable[[Trajectory], Trajectory] = lambda trajectory: trajectory,
    *,
    distribution: bool = False,
) -> ExecutionPrediction | None:
    """Return the prediction of the execution of a task ``(d,)`` as it is recorded; None if it cannot be planned.

    With ``distribution``, the draws predict how an execution is distributed, as sequences of noise do.
    """
    planned = planner.plan(point[None])
    if not planned:
        return None
    (run,) = planner.run(draws, planned)
    horizon = run.inputs.shape[2]
    steps = np.unique(np.linspace(1, horizon, min(horizon, 16)).astype(int))
    loops = recorded(Trajectory(planned[0].nominal.times, run.states[:, 0], run.inputs[:, 0])).states
    states, distances = loops[:, steps], run.distances[:, 0]
    size = max(float(np.nanmedian(np.abs(states))), 1e-9)
    with np.errstate(all="ignore"):  # what is far beyond the states of all other draws has diverged
        kept = np.isfinite(distances) & (np.abs(states) < 1e6 * size).all(axis=(1, 2))
    good, values = (states[kept], distances[kept]) if kept.any() else (np.zeros_like(states), np.zeros(len(states)))
    medians, deviations = np.median(good, axis=0), good.std(axis=0)
    noise, kept_distances = None, np.where(kept, distances, np.inf)
    if (draws.replicates > 1 or distribution) and kept.any():
        whole = loops[kept]
        roughness = np.sqrt((np.diff(whole, 2, axis=1) ** 2).mean(axis=(0, 1)))
        ranges = np.maximum(np.ptp(medians, axis=0), 1e-9)
        of_runs = (_deviation(good, medians, deviations, ranges), *_differences(whole, roughness))
        noise = NoisePrediction(
            len(kept),
            _rounded(np.quantile(kept_distances, LEVELS, method="higher")),
            _rounded(roughness),
            tuple(_rounded(np.quantile(each, LEVELS)) for each in of_runs),
        )
    return ExecutionPrediction(
        learned_from,
        _rounded(np.quantile(kept_distances, _QUANTILES, method="higher")),
        _rounded(values.std())[0],
        tuple(steps.tolist()),
        tuple(map(_rounded, medians)),
        tuple(map(_rounded, deviations)),
        float(1 - kept.mean()),
        noise,
    )


def _rows(listed: Iterable[Iterable[Any]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in listed)


def _rounded(values: ArrayLike) -> tuple[float, ...]:
    return tuple(float(f"{value:.8g}") for value in np.ravel(values))
