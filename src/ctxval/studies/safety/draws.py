"""What independent draws of tasks bound: the share that S violates, and the disturbances of one step, with tubes.

For a set of disturbances ``S(x, u) - M(x, u)``, let r_i be the largest residual of one step in task i of N independent
tasks, in units of fixed scales. Discard the k largest; W is the box of the largest one that is left. By the theorem of
sampling and discarding, with a stated confidence at most a stated share of all tasks has any step whose residual leaves
W.

If ``x' = A x + B u + w`` with w in W and ``u = v_t + K_t (x - z_t)``, the error ``e = x - z`` to the closed loop z of a
linear model follows ``e' = (A + B K_t) e + w``, so that it lies in a tube, a sum of images of W. The support function
of a box with half-widths w in direction c is ``|c| w``, and those of the images add up exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, single_threaded
from ctxval._util.checked import NonNegativeFloat, NonNegativeInt, PositiveInt, Probability, checked
from ctxval._util.representation import ShortRepr
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.history import executed_trials
from ctxval.campaign.storage.store import Store
from ctxval.certificates.options import CONFIDENCE
from ctxval.certificates.scenario import volume_bound
from ctxval.core.controller import AffineFeedback, Limits, LimitsLike
from ctxval.core.floating_base import UntilFall
from ctxval.core.model import Model, linearize
from ctxval.core.plan import Plan
from ctxval.core.space import TaskSpace
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.distances import UnsafeMargin
from ctxval.errors import CertificateError, InputError, ShapeError
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


@dataclass(frozen=True, eq=False)
class Disturbance(ShortRepr):
    """The box W of disturbances ``|S(x, u) - M(x, u)| <= half_widths`` of one step.

    It holds for tasks from the distribution of the draws, under the controllers that executed them: after these have
    changed, other states are visited, and fresh draws are needed.
    """

    half_widths: Array  #: one for each state, ``(n,)``
    volume: float  #: the share of the tasks that may have a step outside of W
    confidence: float  #: the probability of this statement
    draws: int  #: the number N of independent tasks
    discarded: int  #: the number k of those that were discarded
    largest: Array  #: the largest residuals of all draws, ``(n,)``, for comparison

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {**vars(self), "half_widths": self.half_widths.tolist(), "largest": self.largest.tolist()}

    @property
    def statement(self) -> str:
        """What W means, in one sentence."""
        return (
            f"With {100 * self.confidence:g} % confidence, at most {100 * self.volume:.3g} % of the tasks have a step "
            f"with a disturbance outside of W ({self.draws} independent draws, {self.discarded} discarded)."
        )


def largest_residuals(model: Model, runs: Sequence[Trajectory]) -> Array:
    """Return the largest residual of one step of each state in each run, ``(N, n)``; infinity where M is not finite."""
    with np.errstate(all="ignore"):
        errors = [run.states[1:] - np.asarray(model.step(run.states[:-1], run.inputs)) for run in runs]
        residuals = np.array([np.abs(each).max(axis=0) for each in errors])
    return np.asarray(np.nan_to_num(residuals, nan=np.inf, posinf=np.inf))


@checked
def disturbance_set(
    source: Campaign | Sequence[Trajectory],
    *,
    model: Model | None = None,
    scales: ArrayLike | None = None,
    discarded: NonNegativeInt = 0,
    confidence: Probability = CONFIDENCE,
) -> Disturbance:
    """Return the box of disturbances of one step, from fresh independent tasks.

    Args:
        source: a campaign, whose independent draws count (:meth:`ctxval.Campaign.audit`); or the trajectories of S in
            independent tasks.
        model: M, which must not have been learned from these draws; that of the campaign by default.
        scales: how large a residual of each state counts as 1, ``(n,)``, chosen without these draws; by default, the
            largest residuals of the campaign's other executions.
        discarded: the number k of tasks that are discarded, chosen before the draws are known.
        confidence: the confidence of the statement.
    """
    others: list[Trajectory] = []
    if isinstance(source, Campaign):
        source.validation.require_states("a disturbance set")
        model = source.validation.model if model is None else model
        draws = [trial for trial in source.trials if trial.origin == "iid"]
        executed = executed_trials(source.store, source.trials)
        runs = [run for trial, run in executed if trial.origin == "iid"]
        others = [run for trial, run in executed if trial.origin != "iid"]
        if len(runs) < len(draws):
            raise CertificateError(
                f"{len(draws) - len(runs)} of {len(draws)} draws have no trajectory, so their disturbances are unknown."
            )
    else:
        runs = list(source)
    if model is None:
        raise InputError("the model is needed, because trajectories alone do not tell it.")
    if len(runs) <= discarded:
        raise CertificateError(
            f"a disturbance set needs more than {discarded} independent draws of tasks, got {len(runs)}: run "
            "Campaign.audit."
        )
    residuals = largest_residuals(model, runs)
    if scales is None:
        if not others:
            raise InputError("scales are needed, one for each state: there are no executions besides the draws.")
        known = largest_residuals(model, others).max(axis=0)
        # A state whose residual was never seen must not make all others infinite.
        unit = np.maximum(known, 1e-6 * max(float(known.max()), 1e-300))
    else:
        unit = as_finite("scales", scales)
        if unit.shape != residuals.shape[1:] or not (unit > 0).all():
            raise ShapeError(f"scales must be {residuals.shape[1]} positive numbers, got {unit.tolist()}.")
    ranked = np.sort((residuals / unit).max(axis=1))
    r = ranked[len(ranked) - 1 - discarded]
    if not np.isfinite(r):
        raise CertificateError("the model is not finite in more tasks than are discarded.")
    volume = volume_bound(len(runs), discarded, 1 - confidence)
    return Disturbance(r * unit, volume, confidence, len(runs), discarded, residuals.max(axis=0))


@dataclass(frozen=True, eq=False)
class Tube(ShortRepr):
    """How far states and inputs of S are from those of M at most, if every disturbance lies in a box."""

    states: Array  #: half-widths of the states at each time, ``(H + 1, n)``
    inputs: Array  #: half-widths of the inputs at each step, ``(H, m)``
    loops: Array  #: the matrices ``A + B K_t`` of the closed loop, ``(H, n, n)``
    half_widths: Array  #: the box of disturbances, ``(n,)``

    def support(self, direction: ArrayLike) -> Array:
        """Return the largest error in a direction ``(n,)`` at each time, ``(H + 1,)``."""
        c = as_finite("direction", direction)
        if c.shape != self.half_widths.shape:
            raise ShapeError(f"direction must have shape {self.half_widths.shape}, got {c.shape}.")
        return np.array([float((np.abs(c @ each) @ self.half_widths).sum()) for each in _transitions(self.loops)])

    def tightened(self, limits: LimitsLike, of: str = "states") -> Limits:
        """Return limits of ``states`` or ``inputs`` of M that keep those of S within limits; refuse empty ones."""
        if of not in ("states", "inputs"):
            raise InputError(f"of must be 'states' or 'inputs', got {of!r}.")
        widths = (self.states if of == "states" else self.inputs).max(axis=0, initial=0.0)
        given = Limits.of(limits, len(widths))
        low, high = given.low + widths, given.high - widths
        if not (low < high).all():
            i = int(np.argmin(high - low))
            raise InputError(
                f"nothing is left between the limits {given.low[i]:g} and {given.high[i]:g} of {of[:-1]} {i}: the tube "
                f"needs {widths[i]:.4g} on each side."
            )
        return Limits(low, high)


@checked
def tube(A: Any, B: Any, gains: Any, half_widths: Any) -> Tube:
    """Return the tube of ``x' = A x + B u + w`` for gains K ``(H, m, n)`` and ``|w| <= half_widths`` ``(n,)``."""
    given = {"A": A, "B": B, "gains": gains, "half_widths": half_widths}
    A, B, K, w = (as_finite(name, value) for name, value in given.items())
    n, m = len(w), B.shape[-1]
    if A.shape != (n, n) or B.shape != (n, m) or K.ndim != 3 or K.shape[1:] != (m, n) or (w < 0).any():
        got = f"{A.shape}, {B.shape}, {K.shape} and {w.tolist()}"
        raise ShapeError(f"a tube needs A (n, n), B (n, m), gains (H, m, n) and half_widths >= 0 (n,), got {got}.")
    loops = A + B @ K
    states, inputs = [], []
    for t, each in enumerate(_transitions(loops)):
        states.append((np.abs(each) @ w).sum(axis=0))
        if t < len(K):
            inputs.append((np.abs(K[t] @ each) @ w).sum(axis=0))
    return Tube(np.array(states), np.array(inputs), loops, w)


def _transitions(loops: Array) -> Iterator[Array]:
    """Yield, for each time t of 0 to H, the products of the matrices from each earlier step to t, ``(t, n, n)``."""
    known, n = loops[:0], loops.shape[-1]
    yield known
    for loop in loops:
        known = np.concatenate([loop @ known, np.eye(n)[None]])
        yield known


@checked
def tube_of(validation: Validation, plan: Plan, disturbance: Disturbance) -> Tube:
    """Return the tube around the closed loop of M in a plan, for a linear model and affine feedback.

    Input limits that are reached are not linear; the tube then does not hold.
    """
    controller, model = plan.controller, validation.model
    if not isinstance(controller, AffineFeedback) or controller.gains.ndim != 3:
        raise InputError("a tube needs the affine feedback of one task, as LQR and iLQR design it.")
    A, B = linearize(model, plan.model_trajectory.states[:-1], plan.model_trajectory.inputs)
    if A.ndim > 2 or B.ndim > 2:
        raise InputError("a tube needs a linear model, whose Jacobian is the same everywhere.")
    return tube(A, B, controller.gains, disturbance.half_widths)
