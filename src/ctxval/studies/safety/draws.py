"""What independent draws of tasks bound: the share of the tasks with a margin that S violates."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.checked import NonNegativeFloat, PositiveInt, Probability, checked
from ctxval._util.representation import ShortRepr
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.history import executed_trials
from ctxval.campaign.storage.store import Store
from ctxval.certificates.options import CONFIDENCE
from ctxval.certificates.scenario import volume_bound
from ctxval.core.floating_base import UntilFall
from ctxval.core.space import TaskSpace
from ctxval.core.validation import Validation
from ctxval.distances import UnsafeMargin
from ctxval.errors import InputError
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.searches import by_name
from ctxval.specs import Specification


def spec_distance(validation: Validation) -> UnsafeMargin:
    """Return the distance of a validation, which must be the margin of unsafe tasks."""
    distance = validation.distance.distance if isinstance(validation.distance, UntilFall) else validation.distance
    if not isinstance(distance, UnsafeMargin):
        raise InputError(
            f"the distance must be an UnsafeMargin of a specification, got {distance!r}: see "
            "ctxval.studies.safety.judged_by."
        )
    return distance


def on_model(planner: LoopPlanner, spec: Specification, unit: Array) -> Array:
    """Return rho_M at points ``(N, d)`` of the unit cube, ``(N,)``; minus infinity if a task cannot be planned."""
    rho = np.full(len(unit), -np.inf)
    with single_threaded():
        for loops in planner.plan(unit):
            with np.errstate(all="ignore"):
                of_tasks = spec.robustness(loops.nominal, loops.task)
            rho[loops.rows] = np.where(loops.nominal.finite, of_tasks, -np.inf)
    return rho


@dataclass(frozen=True)
class DrawnTasks(ShortRepr):
    """What independent draws show of the tasks that M satisfies with a margin; nothing is assumed of the dynamics."""

    margin: float
    draws: int  #: number of executed draws
    unsafe: int  #: number of those that S violates, or whose execution failed
    share: float  #: with the confidence, at most this share of these tasks is unsafe (Clopper and Pearson 1934)
    confidence: float


@dataclass(frozen=True, eq=False)
class TasksWithMargin:
    """A sampler of tasks that M satisfies with a robustness above a margin; S is not executed."""

    planner: LoopPlanner
    space: TaskSpace
    spec: Specification
    margin: float

    def __call__(self, rng: np.random.Generator, n: int) -> Array:
        """Return n independent tasks, rows ``(n, d)`` in the units of the space."""
        kept = np.empty((0, self.space.dimension))
        for _ in range(64):  # batches of tasks that are tried for one with the margin, and tasks in each
            unit = self.space.unit_draws(512 if self.planner.batched else 16, rng)
            kept = np.concatenate([kept, unit[on_model(self.planner, self.spec, unit) > self.margin]])
            if len(kept) >= n:
                return np.asarray(self.space.from_unit(kept[:n]))
        raise InputError(
            f"hardly any task satisfies the specification on the model with a margin of {self.margin:g}, so there is "
            "nothing to draw from."
        )

    def describe(self) -> dict[str, Any]:
        """Return what identifies this sampler in a store."""
        return {"margin": self.margin, "of": self.space}


def require_box(validation: Validation) -> None:
    """Refuse a suite of tasks, of which draws bound no share."""
    if validation.space.members is not None:
        raise InputError("a suite has finitely many tasks, so no share of it is bounded by draws: execute its tasks.")


@checked
def draw_tasks(
    campaign: Campaign,
    margin: NonNegativeFloat,
    draws: PositiveInt,
    *,
    store: str | Path | None = None,
    confidence: Probability = CONFIDENCE,
    progress: bool | None = None,
) -> DrawnTasks:
    """Execute independent draws among the tasks that M satisfies with a margin, and bound the share that is unsafe.

    Choose the margin and the number of draws before the draws are executed. They have a store of their own.

    Args:
        campaign: a campaign whose distance is a :class:`ctxval.distances.UnsafeMargin`.
        margin: the margin, such as the bound of :func:`assess`.
        draws: total number of draws, with those that the store has.
        store: the file of the store; in memory by default.
        confidence: the confidence of the bound.
        progress: as in :meth:`ctxval.Campaign.run`.
    """
    validation = campaign.validation
    require_box(validation)
    spec = spec_distance(validation).spec
    sampler = TasksWithMargin(LoopPlanner(validation), validation.space, spec, float(margin))
    sampler(np.random.default_rng(0), 1)  # refuses a margin that no task has
    of_margin = validation.with_parts(space=validation.space.sampled(sampler), distance=UnsafeMargin(spec))
    search = by_name("random")
    drawn = Campaign(of_margin, search=search, store=Store(store), seed=campaign.seed, name=campaign.name)
    drawn.audit(draws, progress=progress)
    trials = drawn.trials[:draws]
    unsafe = len([trial for trial in trials if trial.state == "failed"])
    for trial, system in executed_trials(drawn.store, trials):
        task = validation.task_at(validation.space.parameters(validation.space.from_unit(trial.unit_point)))
        unsafe += float(spec.robustness(system, task)) <= 0
    share = volume_bound(len(trials), unsafe, 1 - confidence) if unsafe < len(trials) else 1.0
    return DrawnTasks(float(margin), len(trials), unsafe, share, confidence)
