"""The prediction of an execution, which is stored before the execution, and how well the execution agrees with it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np

from ctxval._util.arrays import Array, ArrayLike
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Trajectory
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.draws import DynamicsDraws

_QUANTILES = np.linspace(0.0, 1.0, 21)  # levels of the stored quantiles of the distance


@dataclass(frozen=True)
class ExecutionPrediction(ShortRepr):
    """Draws of the trajectory and of the distance of one task, summarised in plain numbers for JSON.

    Attributes:
        quantiles: quantiles of the distance at 0, 0.05, ..., 1; infinity if a draw diverges.
        deviation: standard deviation of the distance over the draws that do not diverge.
        steps: indices of the predicted states, from 1 to the horizon.
        states: medians of the states at these steps, one row for each.
        deviations: standard deviations of the states at these steps, one row for each.
        diverged: share of the draws that diverge.
    """

    learned_from: int
    quantiles: tuple[float, ...]
    deviation: float
    steps: tuple[int, ...]
    states: tuple[tuple[float, ...], ...]
    deviations: tuple[tuple[float, ...], ...]
    diverged: float

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
        return {
            **asdict(self),
            "quantiles": [None if np.isinf(one) else one for one in self.quantiles],
            "steps": list(self.steps),
            "states": [list(row) for row in self.states],
            "deviations": [list(row) for row in self.deviations],
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self | None:
        """Return the prediction that :meth:`to_json` returned; None if these are not its values."""
        try:
            found = cls(
                int(values["learned_from"]),
                tuple(np.inf if one is None else float(one) for one in values["quantiles"]),
                float(values["deviation"]),
                tuple(int(one) for one in values["steps"]),
                _rows(values["states"]),
                _rows(values["deviations"]),
                float(values["diverged"]),
            )
        except (KeyError, TypeError, ValueError, OverflowError):
            return None
        widths = {len(row) for row in (*found.states, *found.deviations)}
        lengths = {len(found.steps), len(found.states), len(found.deviations)}
        ordered = all(one <= other for one, other in pairwise(found.quantiles))
        consistent = len(found.quantiles) == len(_QUANTILES) and ordered and len(lengths) == len(widths) == 1
        return found if consistent else None

    def score(self, executed: Trajectory, distance: float) -> PredictionScore | None:
        """Return how an execution agrees with the prediction; None if they do not fit together."""
        states = np.array(self.states)
        if max(self.steps) > executed.horizon or states.shape[1:] != executed.states.shape[1:]:
            return None
        rank = float(np.interp(distance, np.nan_to_num(self.quantiles, posinf=1e300), _QUANTILES))
        if self.diverged > 0.5:
            # Nothing is predicted, so nothing can be contradicted, and nothing is confirmed.
            return PredictionScore(np.inf, rank, 0.0)
        ranges = np.maximum(np.ptp(executed.states, axis=0), 1e-9)
        errors = (executed.states[list(self.steps)] - states) / ranges
        # Deviations of a state below 1e-4 of its range and of the distance below 0.2 % of it are no errors.
        variances = (np.array(self.deviations) / ranges) ** 2 + 1e-4**2
        of_states = float((errors**2).sum() / variances.sum())
        scale2 = self.deviation**2 + (2e-3 * max(distance, self.median)) ** 2
        of_distance = (distance - self.median) ** 2 / max(scale2, 1e-300)
        return PredictionScore(max(of_states, of_distance), rank, distance / max(self.median, 1e-300))


@dataclass(frozen=True)
class PredictionScore:
    """How an execution agrees with its prediction.

    Attributes:
        z2: squared standardised error, the larger one of the trajectory and of the distance; infinity if most draws
            diverged.
        rank: share of the draws whose distance is below the executed one.
        ratio: the executed distance, divided by the median of the draws.
    """

    z2: float
    rank: float
    ratio: float


def predict_execution(
    planner: LoopPlanner, draws: DynamicsDraws, point: Array, learned_from: int
) -> ExecutionPrediction | None:
    """Return the prediction of the execution of a task ``(d,)``; None if it cannot be planned."""
    found = planner.run(draws, planner.plan(point[None]))
    if not found:
        return None
    horizon = found[0].inputs.shape[2]
    steps = np.unique(np.linspace(1, horizon, min(horizon, 16)).astype(int))
    states, distances = found[0].states[:, 0][:, steps], found[0].distances[:, 0]
    size = max(float(np.nanmedian(np.abs(states))), 1e-9)
    with np.errstate(all="ignore"):  # what is far beyond the states of all other draws has diverged
        kept = np.isfinite(distances) & (np.abs(states) < 1e6 * size).all(axis=(1, 2))
    good, values = (states[kept], distances[kept]) if kept.any() else (np.zeros_like(states), np.zeros(len(states)))
    return ExecutionPrediction(
        learned_from,
        tuple(_rounded(np.quantile(np.where(kept, distances, np.inf), _QUANTILES, method="higher"))),
        _rounded(values.std())[0],
        tuple(steps.tolist()),
        tuple(tuple(_rounded(row)) for row in np.median(good, axis=0)),
        tuple(tuple(_rounded(row)) for row in good.std(axis=0)),
        float(1 - kept.mean()),
    )


def _rows(listed: Iterable[Iterable[Any]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in listed)


def _rounded(values: ArrayLike) -> list[float]:
    return [float(f"{value:.8g}") for value in np.ravel(values)]
