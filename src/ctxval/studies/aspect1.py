"""Aspect 1 of the paper's Remark 1: whether the model itself completes the tasks, by simulation only.

>>> from ctxval import aspect1  # doctest: +SKIP
>>> print(aspect1.check(experiment.validation, threshold=0.05))  # doctest: +SKIP
"""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import Must, NonNegativeInt, PositiveFloat, checked
from ctxval._util.progress import advance, stage
from ctxval._util.texts import text_of
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.goals_of_model import GoalWarning
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.certificates.options import CONFIDENCE
from ctxval.certificates.scenario import volume_bound
from ctxval.certificates.verdict import Verdict
from ctxval.core.controller import converged_of
from ctxval.core.distance import Distance
from ctxval.core.floating_base import UntilFall
from ctxval.core.plan import Plan
from ctxval.core.soundness import Flips, InputSaturation, aimed_states, flips, saturation
from ctxval.core.task import COMMAND, Task
from ctxval.core.trial import Trial, Trials
from ctxval.core.validation import Validation
from ctxval.distances import BodyVelocity, CommandError, GoalError, MeanDeviation, StateNorm, TrackingError
from ctxval.errors import CtxvalError, DesignError, InputError, ModelError
from ctxval.searches import Search, by_name

__all__ = ["Aspect1Report", "SimulatedTask", "check", "completion"]

TASKS = 100  # number of simulated tasks, unless another one is given


@dataclass(frozen=True, eq=False)
class SimulatedTask:
    """A task on M, and how far M is from completing it."""

    parameters: dict[str, Any]
    error: float | None
    reason: str = ""  #: why there is no error: no controller could be designed, or M diverges
    fell: bool = False  #: whether the robot of M fell, by the condition that the synthesizer knows


@dataclass(frozen=True, eq=False)
class Aspect1Report:
    """What simulations of M show of its tasks and controllers. The system is never executed."""

    distance: Distance  #: the distance between the trajectory of M and its task; the units are empty if not known
    units: str
    threshold: float | None  #: the largest error with which a task counts as completed; None if there is none
    simulated: tuple[SimulatedTask, ...]  #: all tasks, the worst first, before them those without an error
    verdict: Verdict | None  #: on M against the threshold, with a bound over all tasks; None if there is no threshold
    #: with confidence 0.95 by the independent draws, the largest share of all tasks that M does not complete; None if
    #: there is no threshold
    share: float | None
    distribution: str | None  #: that of tasks, under which the share is a probability, as a text; None if it is uniform
    #: how much controllers of neighbouring tasks differ, and two such tasks; None if no tasks are neighbours
    flips: Flips | None
    flipped: tuple[dict[str, Any], dict[str, Any]] | None
    #: the share of the steps at which each of the ``inputs`` is at a limit; None if there are no inputs
    saturation: InputSaturation | None
    inputs: tuple[str, ...]
    #: the tasks whose design did not converge, and how many designs tell this
    not_converged: tuple[dict[str, Any], ...]
    designs: int

    @property
    def worst(self) -> SimulatedTask:
        """The task that M completes worst."""
        return self.simulated[0]

    @property
    def failed(self) -> tuple[SimulatedTask, ...]:
        """The tasks without an error."""
        return tuple(task for task in self.simulated if task.error is None)

    @property
    def fallen(self) -> tuple[SimulatedTask, ...]:
        """The tasks in which the robot of M fell."""
        return tuple(task for task in self.simulated if task.fell)

    @property
    def exceeding(self) -> int:
        """The number of tasks that M does not complete: above the threshold, with a fall, or without an error."""
        limit = np.inf if self.threshold is None else self.threshold
        return sum(task.error is None or task.error > limit or task.fell for task in self.simulated)

    @property
    def completes(self) -> bool | None:
        """Whether M completed all simulated tasks; None without a threshold, unless a task failed or a robot fell."""
        return None if self.threshold is None and not self.failed + self.fallen else not self.exceeding

    def to_json(self) -> dict[str, Any]:
        """Return all results as plain values."""
        flips, saturation, verdict = self.flips, self.saturation, self.verdict
        return {
            "distance": repr(self.distance),
            **{name: getattr(self, name) for name in ("units", "threshold", "completes", "distribution", "designs")},
            "tasks": len(self.simulated),
            "worst": asdict(self.worst),
            "exceeding": None if self.completes is None else self.exceeding,
            "failed": [asdict(task) for task in self.failed],
            "verdict": verdict and verdict.answer,
            "bound": verdict and verdict.bound,
            "share_at_most": self.share,
            "flips": flips and {**asdict(flips), "example": self.flipped},
            "saturation": saturation and dict(zip(self.inputs, saturation.shares.tolist(), strict=False)),
            "not_converged": list(self.not_converged),
            "fallen": [asdict(task) for task in self.fallen],
        }


@checked
def check(
    validation: Validation,
    *,
    threshold: PositiveFloat | None = None,
    distance: Distance | None = None,
    tasks: Annotated[int, Must("an integer >= 2", lambda value: value >= 2)] = TASKS,
    search: Search | None = None,
    seed: NonNegativeInt = 0,
) -> Aspect1Report:
    """Search for the task that M itself completes worst, and look at the controllers. S is never executed.

    Half of the tasks are independent draws from the distribution of tasks, and the search chooses the others.

    Args:
        threshold: the largest error with which a task counts as completed, in the units of ``distance``.
        distance: how far the trajectory of M is from completing its task; that of :func:`completion` by default.
        search: chooses the tasks; Bayesian optimisation by default.
    """
    measured = completion(validation) if distance is None else distance
    on_model = validation.on_model(measured, units=None if distance is None else "")
    # Learned dynamics could not teach the search anything, because M is known.
    campaign = Campaign(on_model, search=by_name("bayesian-optimisation") if search is None else search, seed=seed)
    if threshold is not None:
        campaign.state_threshold(threshold)
    with stage("simulating tasks on the model", tasks, "tasks"):
        while (done := len(campaign.trials)) < tasks:  # a task without a closed loop counts, too
            with warnings.catch_warnings(), contextlib.suppress(DesignError, ModelError):  # stored with the reason
                warnings.simplefilter("ignore", GoalWarning)  # which is what the report says in detail
                if done < tasks // 2:
                    campaign.audit(tasks // 2, lambda _: advance(), progress=False)
                left = campaign.executions + tasks - len(campaign.trials)
                campaign.run(left, on_trial=lambda _: advance(), explore=True, progress=False)
    return _report(campaign, measured, threshold, seed)


def completion(validation: Validation) -> Distance:
    """Return the distance of M from completing its task that belongs to the distance of a validation.

    It has the norm, the states, the weights and the scales of that distance. For tasks with a goal it is
    :class:`ctxval.distances.GoalError`, and for tasks with a changing reference
    :class:`ctxval.distances.TrackingError`. For a :class:`ctxval.distances.BodyVelocity` and tasks with a command it is
    :class:`ctxval.distances.CommandError`. If the distance compares all states, those are left out that the
    synthesizer does not bring to a goal.

    Raises:
        InputError: if tasks have no goal.
    """
    space, distance = validation.space, validation.distance
    distance = distance.distance if isinstance(distance, UntilFall) else distance
    task = validation.task_at(space.parameters(0.5 * (space.low + space.high)))
    if isinstance(distance, BodyVelocity) and not task.has_goal and COMMAND in task.environment:
        return distance if isinstance(distance, CommandError) else CommandError(**vars(distance))
    if not isinstance(task, Task) or not task.has_goal:
        raise InputError(
            "the tasks have neither a goal nor a reference, so the model has nothing to complete: give a goal, or a "
            "distance that measures how far a trajectory is from completing its task."
        )
    if isinstance(distance, GoalError | TrackingError):
        return distance
    shared: dict[str, Any] = {"norm": 2}
    if isinstance(distance, StateNorm):
        shared = {name: getattr(distance, name) for name in ("norm", "components", "weights", "scales", "angles")}
    n = validation.recorded(task.initial_state).shape[-1]
    aimed = aimed_states(validation, n)
    if all(shared.get(name) is None for name in ("components", "weights", "scales")):
        shared["components"] = tuple(aimed.tolist()) if 0 < len(aimed) < n else None
    if (task.reference == task.goal[..., None, :]).all():
        return GoalError(**shared)
    return TrackingError(**shared, over="mean" if isinstance(distance, MeanDeviation) else "maximum")


def _report(campaign: Campaign, distance: Distance, threshold: float | None, seed: int) -> Aspect1Report:
    validation, share, verdict = campaign.validation, None, None
    if threshold is not None:
        if campaign.completed:
            verdict = campaign.verdict(threshold, certificate=CertificateOptions(DistanceBound()))
        drawn = [trial for trial in campaign.trials if trial.origin == "iid"]
        missed = sum(trial.distance is None or trial.distance > threshold for trial in drawn)
        # The upper bound of Clopper and Pearson (1934).
        share = volume_bound(len(drawn), missed, 1 - CONFIDENCE) if missed < len(drawn) else 1.0
    ordered = sorted(campaign.trials, key=lambda trial: -np.inf if trial.distance is None else -trial.distance)
    done = Trials(ordered).completed.points(validation.space.dimension)
    points = _with_neighbours(done, np.random.default_rng([seed, 1]))
    plans = _planned(validation, points)
    inputs, rows = [plan.model_trajectory.inputs for plan in plans.values()], list(plans)
    flipped = flips(points[rows], inputs) if len(rows) > 1 else None
    where = [validation.space.describe_point(validation.space.from_unit(points[row])) for row in rows]
    converged = [converged_of(plan.controller) for plan in plans.values()]
    return Aspect1Report(
        distance,
        validation.labels.units,
        threshold,
        tuple(map(_simulated, ordered)),
        verdict,
        share,
        campaign.provenance.distribution,
        flipped,
        None if flipped is None else (where[flipped.example[0]], where[flipped.example[1]]),
        saturation(inputs, validation.synthesizer),
        tuple(validation.names(0, inputs[0].shape[-1])[1]) if inputs else (),
        tuple(task for task, ok in zip(where, converged, strict=True) if ok is not None and not ok),
        sum(ok is not None for ok in converged),
    )


def _simulated(trial: Trial) -> SimulatedTask:
    return SimulatedTask(trial.parameters, trial.distance, text_of(trial.failure or ""), trial.note.falls is not None)


def _with_neighbours(points: Array, rng: np.random.Generator) -> Array:
    """Return points of the unit cube ``(N, d)``, the worst first, after neighbours of the worst and of spread ones."""
    if not len(points):
        return points
    chosen = np.concatenate([points[:10], points[:: max(1, len(points) // 10)][:10]])
    directions = rng.normal(size=chosen.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # 0.03 diagonals of the task space; a step that would leave the cube goes the other way.
    step = 0.03 * np.sqrt(points.shape[1]) * directions
    beside = np.where((chosen + step < 0) | (chosen + step > 1), chosen - step, chosen + step)
    return np.concatenate([beside.clip(0, 1), chosen, points])


def _planned(validation: Validation, points: Array) -> dict[int, Plan]:
    """Return the plans of points by row, without those that fail; if designs are slow, only of neighbours."""
    batched = bool(getattr(validation.synthesizer, "batched", False))
    rows = range(len(points) if batched else min(len(points), 40))
    space, plans = validation.space, dict[int, Plan]()
    with contextlib.suppress(CtxvalError):
        return dict(zip(rows, validation.plans(space.from_unit(points[rows])), strict=True)) if rows else {}
    for row in rows:
        with contextlib.suppress(DesignError, ModelError):
            plans[row] = validation.plan(space.from_unit(points[row]))
    return plans
