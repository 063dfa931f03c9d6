"""What recordings predict of the tasks of an experiment: the worst ones, a bound, and which executions tell most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.boxes import separated_rows
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning import DynamicsStudy
from ctxval.learning.closed_loops import loop_pairs


@dataclass(frozen=True, eq=False)
class PredictedTask(ShortRepr):
    """The predicted distance of one task."""

    parameters: dict[str, Any]
    median: float  #: median, 0.05 and 0.95 quantile of the distance over posterior samples of the dynamics
    low: float
    high: float
    #: for a proposed execution, the share of the variance of the distances of likely worst tasks that it and those
    #: before it resolve; None for others
    resolved: float | None = None


@dataclass(frozen=True, eq=False)
class PredictedTasks(ShortRepr):
    """What recordings predict of the tasks of an experiment. No execution has tested it."""

    worst: tuple[PredictedTask, ...]  #: tasks with large predicted distances, the largest first
    median: float  #: median and 0.95 quantile of the largest distance over all tasks, over posterior samples
    upper: float
    executions: tuple[PredictedTask, ...]  #: the executions that would tell most of the largest distance, in this order
    draws: int  #: number of posterior samples of the dynamics
    unplanned: float  #: share of the tasks for which no controller can be designed, or on which the model diverges
    #: how far the closed loops of the tasks lead beyond all records of one state or input, as a share of the range that
    #: they visit, and the index of this state or input; states come before inputs
    beyond: float
    beyond_of: int


def predicted_tasks(
    validation: Validation, recorded: Sequence[Trajectory], *, executions: int = 10, seed: int = 0
) -> PredictedTasks | None:
    """Return what recordings predict of the tasks of an experiment; S is never executed.

    Returns None if the model explains the recordings, or if no task can be planned.
    """
    study = DynamicsStudy(validation, seed)
    learned = study.learn([], recorded)
    if learned is None:
        return None
    with single_threaded():
        worst, pool = learned.worst_case_of(1), study.search.pool
        random = pool[np.random.default_rng([seed, 3]).permutation(len(pool))[:96]]
        together = np.concatenate([worst.elites[:24], worst.points, random])
        points = np.unique(together.round(6), axis=0)[:: max(1, -(-len(together) // 384))]
        rng, planner = np.random.default_rng([seed, 4]), study.planner
        pairs = loop_pairs(planner, learned.posterior, points)
        pivots = pairs[rng.permutation(len(pairs))[:700]]
        distances = planner.distances(learned.posterior.draw(pivots, rng), planner.plan(points), len(points))
    planned = ~np.isnan(distances).any(axis=0)
    points, distances = points[planned], distances[:, planned]
    if not len(points):
        return None
    known = distances[np.isfinite(distances)]
    # A sample that diverges counts as a large distance.
    largest = 10.0 * float(np.quantile(known, 0.95)) if len(known) else 1.0
    drawn = np.minimum(distances, max(largest, float(known.max(initial=0.0))))
    order = np.argsort(-np.median(drawn, axis=0), kind="stable")
    # A share of the diagonal of the cube.
    apart = order[separated_rows(points[order], 0.02 * np.sqrt(points.shape[1]), len(points))]
    points, drawn = points[apart], drawn[:, apart]
    chosen, resolved = _informative(drawn, executions)
    maxima, space = worst.maxima, validation.space

    def predicted(row: int, share: float | None = None) -> PredictedTask:
        low, median, high = np.quantile(drawn[:, row], [0.05, 0.5, 0.95]).tolist()
        return PredictedTask(space.describe_point(space.from_unit(points[row])), median, low, high, share)

    return PredictedTasks(
        tuple(predicted(row) for row in range(min(5, len(points)))),
        float(np.median(maxima)),
        float(np.quantile(maxima, 0.95, method="higher")),
        tuple(map(predicted, chosen.tolist(), resolved.tolist())),
        len(maxima),
        worst.unplanned,
        learned.coverage.beyond.size,
        learned.labels.index(learned.coverage.beyond.coordinates[0]),
    )


def _informative(drawn: Array, count: int) -> tuple[Rows, Array]:
    """Return the tasks whose execution tells most of the worst tasks, one after the other.

    The distances of tasks are taken as jointly normal, with the covariance of the draws. The weight of a task is the
    share of the draws in which it is worst. Each choice resolves the largest part of the weighted variance that those
    before it leave.
    """
    C = np.cov(drawn, rowvar=False).reshape(drawn.shape[1], -1)
    worst = np.bincount(drawn.argmax(axis=1), minlength=drawn.shape[1]) / len(drawn)
    weights = 0.99 * worst + 0.01 / drawn.shape[1]  # the other tasks count a little, too
    total = float(weights @ np.diag(C))
    noise = 1e-6 * float(np.trace(C)) / len(C)
    chosen, shares = list[int](), list[float]()
    for _ in range(min(count, drawn.shape[1])):
        gains = (weights @ C**2) / (np.diag(C) + noise) if noise > 0 else np.diag(C)
        gains = np.where(np.isin(np.arange(len(C)), chosen), -np.inf, gains)
        best = int(np.argmax(gains))
        chosen.append(best)
        C = C - np.outer(C[:, best], C[best]) / (C[best, best] + noise) if noise > 0 else C
        shares.append(1 - float(weights @ np.diag(C).clip(min=0)) / total if total > 0 else 1.0)
    return np.array(chosen, dtype=np.intp), np.array(shares)
