"""Which of the tasks that would help may be executed: those that are new, and whose distance is that of neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.campaign.dynamics import NEAR
from ctxval.certificates.checks import in_turn, remedies
from ctxval.certificates.evidence import Evidence


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


def next_task(evidence: Evidence, known: Array, new: CandidateFilter) -> Array | None:
    """Return the task to execute next, a point ``(d,)``; None if all tasks lie next to known ones ``(n, d)``.

    It is the first new task among the remedies of the open checks, in the order of their table. If they have none, it
    is one that tests the predictions further, or the one that is farthest from all known ones.
    """
    tasks = [task for remedy in remedies(evidence, len(known)) if remedy.kind == "new" for task in remedy.tasks]
    # Of random tasks, the one farthest from all known tasks comes first.
    others = np.random.default_rng(len(known)).random((256, known.shape[1]))
    away = np.abs(others[:, None] - known).max(axis=2).min(axis=1, initial=1.0)
    tasks += [*in_turn(evidence, len(known)).tasks, others[np.argsort(-away, kind="stable")]]
    farthest, chosen = evidence.coverage.task, new.first(np.concatenate(tasks), known, evidence.coverage.task)
    # A draw with more friction at rest is ruled out at any place, so the place is one where it is untested.
    of_a_draw = evidence.friction and chosen is not None and (evidence.points == chosen).all(axis=1).any()
    elsewhere = new.at_untested_rest(chosen) if of_a_draw and chosen is not None else None
    moved = None if elsewhere is None else new.first(elsewhere[None], known, farthest)
    return chosen if moved is None else moved
