"""Which task narrows the interval of d* most: the one to execute next, of those that learned dynamics offer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.campaign.dynamics import NEAR
from ctxval.certificates import DynamicsEvidence
from ctxval.certificates.dynamics_diagnostics import (
    uncovered,
    unentered_pocket,
    unsampled_corner,
    unsampled_parameter,
    untested,
    untested_rest,
)

_NEARS = 0.7  # share of the way from the largest executed distance to the limit from which a draw is near it


@dataclass(frozen=True, eq=False)
class CandidateFilter:
    """Tells which tasks may be executed beside known ones."""

    near: float = NEAR  #: the largest change of each coordinate to a task that is no new one
    steady: Callable[[Array], bool] = lambda point: True  #: whether the distance of a task is that of its neighbours
    #: moves a new task ``(d,)``, given the known ones ``(n, d)``; None if tasks are not moved
    spread: Callable[[Array, Array], Array] | None = None
    seen: Rows | slice = field(default_factory=lambda: slice(None))  #: coordinates in which a moved task must be new
    #: a task like this one ``(d,)`` that also tests friction at rest where it is needed; None if there is none
    at_untested_rest: Callable[[Array], Array | None] = lambda task: None

    def first(self, tasks: Array, known: Array, farthest: Array) -> Array | None:
        """Return the first of tasks ``(m, d)`` that may be executed, as it is moved; None if there is none."""

        def is_new(point: Array, by: Rows | slice = slice(None)) -> bool:
            others, task = known[:, by], point[by]
            close = others[np.abs(others - task).max(axis=1) <= self.near]
            # A start may jump between tasks, so the closed loop next to an executed task may lead elsewhere.
            most = 2 if np.array_equal(point, farthest) else 1
            return len(close) < most and not (close == task).all(axis=1).any()

        for task in filter(is_new, tasks):
            moved = task if self.spread is None else self.spread(task, known)
            if (moved is task or is_new(task, self.seen)) and self.steady(moved):
                return moved
        return None


def next_task(
    evidence: DynamicsEvidence, known: Array, best: float, limit: float, confidence: float, new: CandidateFilter
) -> Array | None:
    """Return the task to execute next, a point ``(d,)``; None if all tasks lie next to executed ones.

    These come first: a task whose predicted distance exceeds the limit; the task of the draw that sets the bound,
    while the bound exceeds the limit; the task that leads farthest from the records, while they leave gaps; and
    the task with the largest predicted distance, while no similar distance was executed or a deeper search found it.
    With dry friction, the draw whose distance nears the limit with the least takes the place of the one at the bound.
    Further tasks test the predictions, and if all of these are known, the task that is farthest from all others does.

    The known tasks ``(n, d)`` are executed or open, ``best`` is the largest executed distance, and ``limit`` is what
    the bound must not exceed.
    """
    order = np.argsort(evidence.maxima, kind="stable")
    rank = evidence.rank(confidence)
    highest = evidence.points[[*order[rank::-1], *order[:rank:-1]]]
    if evidence.friction:  # one execution at the least friction at rest that nears the limit rules out all larger ones
        first = int(np.searchsorted(evidence.maxima[order], best + _NEARS * (limit - best), side="right"))
        highest = evidence.points[[*order[first:], *order[:first][::-1]]]
        if (elsewhere := new.at_untested_rest(highest[0])) is not None:
            highest = np.concatenate([elsewhere[None], highest])
    farthest, largest = evidence.coverage.task[None], evidence.local_maxima
    exceeds = evidence.upper(confidence) > limit
    # Every third execution leads farthest from the records in any case, but friction is known where they are dense.
    if exceeds and len(known) % 3 == 2 and (not evidence.friction or uncovered(evidence)):
        candidates = [farthest, highest]
    elif evidence.highest > limit:
        candidates = [largest, highest, farthest]
    elif exceeds:
        candidates = [highest, farthest]
    elif uncovered(evidence):
        candidates = [farthest, highest, largest]
        if evidence.unsampled_parameter is not None and unsampled_parameter(evidence) is not None:
            candidates = [evidence.unsampled_parameter.task[None], *candidates]
        elif evidence.unsampled_corner is not None and unsampled_corner(evidence) is not None:
            candidates = [evidence.unsampled_corner.task[None], *candidates]
        elif evidence.unvisited_region is not None and unentered_pocket(evidence) is not None:
            candidates = [np.array(evidence.unvisited_region.tasks), *candidates]
    elif evidence.search_shortfall > 1 or untested(evidence, best, limit):
        candidates = [largest, highest, farthest]
    elif evidence.untested_rest is not None and untested_rest(evidence, limit) is not None:
        candidates = [np.array(evidence.untested_rest.tasks).reshape(-1, known.shape[1]), highest, farthest]
    else:
        candidates = [highest, farthest] if len(known) % 2 else [farthest, highest]

    # Of random tasks, the one farthest from all known tasks comes first.
    others = np.random.default_rng(len(known)).random((256, known.shape[1]))
    away = np.abs(others[:, None] - known).max(axis=2).min(axis=1, initial=1.0)
    candidates.append(others[np.argsort(-away, kind="stable")])
    return new.first(np.concatenate(candidates), known, evidence.coverage.task)
