"""A task before the execution of S and after it, and what is checked before an execution is spent."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_floats
from ctxval._util.representation import ShortRepr, counted
from ctxval._util.texts import reason_of
from ctxval.core.controller import Controller, started
from ctxval.core.space import Parameters
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, Trajectory, require_times
from ctxval.errors import CtxvalError, DesignError, DistanceError, ExecutionError, InputError, ShapeError

if TYPE_CHECKING:
    from ctxval.core.validation import Validation


@dataclass(frozen=True, eq=False)
class Plan(ShortRepr):
    """What is known of a task g_p, or a batch, before S is executed: its controller and the closed loop on M."""

    parameters: Parameters
    task: Task
    controller: Controller
    model_trajectory: Trajectory

    def of(self, index: int, parameters: Parameters) -> Plan:
        """Return the plan of one task of a batch, whose parameters are given."""
        controller: Any = self.controller
        return Plan(parameters, self.task[index], controller[index], self.model_trajectory[index])


@dataclass(frozen=True, eq=False)
class Outcome(ShortRepr):
    """A plan after the execution of S."""

    plan: Plan
    system_trajectory: Trajectory
    distance: float


def require_execution(plan: Plan, trajectory: Trajectory, start_tolerance: float) -> None:
    """Check that a complete trajectory belongs to the task of a plan; see :class:`Validation` for the tolerance."""
    expected = plan.model_trajectory
    require_times(trajectory, plan.task.times[: expected.horizon + 1])
    if trajectory.states.shape != expected.states.shape or trajectory.inputs.shape != expected.inputs.shape:
        wanted = f"states {expected.states.shape} and inputs {expected.inputs.shape}"
        got = f"{trajectory.states.shape} and {trajectory.inputs.shape}"
        raise ShapeError(f"the trajectory must have {wanted}, got {got}.")
    start = expected.states[0]  # the initial state of the task, or its outputs
    ranges = np.ptp(expected.states, axis=0)
    scale = np.maximum(np.maximum(ranges, np.abs(start)), max(0.05 * ranges.max(), 1e-6))
    # Noise in the first record shows in second differences, whose variance is six times as large.
    noise = np.abs(np.diff(trajectory.states, 2, axis=0)) / (0.6745 * np.sqrt(6))
    scatter = 4 * np.median(noise, axis=0) if len(noise) > 8 else 0.0
    within = np.maximum(start_tolerance * scale, scatter)
    near = np.abs(trajectory.states[0] - start) <= within
    if not near.all():
        i = int(np.argmin(near))
        wanted = f"{start[i]:g} within {within[i]:.3g}, got {trajectory.states[0, i]:g}"
        advice = "Check that it belongs to this trial; if it does, a larger start_tolerance permits it."
        if trajectory.horizon and ranges.any() and not np.ptp(trajectory.states, axis=0).any():
            advice = (
                "All its states are equal: if the system's code changes one array in each step, record copies of it."
            )
        raise InputError(f"the trajectory starts elsewhere: state {i} must start at {wanted}. {advice}")


def require_complete(plan: Plan, trajectory: Trajectory) -> None:
    """Refuse a trajectory that ended early or is not finite, and one of a task in which M alone ended early."""
    expected = plan.model_trajectory
    if trajectory.ended != COMPLETE:
        raise ExecutionError(trajectory.ended)
    if expected.ended != COMPLETE:
        end = f"the model's closed loop ended after {expected.times[-1] - expected.times[0]:.3g} s"
        raise ExecutionError(f"{end}, and the execution did not: repair the model (`ctxval check` with --aspect1)")
    if not trajectory.finite.all():
        unknown, what = np.argwhere(~np.isfinite(trajectory.states)), "an input"
        if len(unknown):
            place = tuple(unknown[0])  # of a batch, too, which is refused later if it is finite
            what = f"state {place[-1]} is {trajectory.states[place]:g} at step {place[-2]}"
        raise ExecutionError(f"the system's trajectory is not finite: {what}")


def ended_early(plan: Plan, trajectory: Trajectory) -> bool:
    """Return whether the closed loop of a trajectory itself ended early, by its reason or without a state as M."""
    if trajectory.ended != COMPLETE or plan.model_trajectory.ended == COMPLETE or trajectory.batch_shape:
        return trajectory.is_outcome
    return bool(trajectory.predicts and not trajectory.finite)


def recorded_until_end(plan: Plan, trajectory: Trajectory, start_tolerance: float) -> Trajectory:
    """Return the steps of a closed loop that ended early, by a fall or an instability; refuse another task's."""
    expected = plan.model_trajectory
    if (trajectory.states.ndim, trajectory.states.shape[-1], trajectory.inputs.shape[-1]) != (
        (2, expected.states.shape[-1], expected.inputs.shape[-1])
    ):
        wanted = f"{expected.states.shape[-1]} states and {expected.inputs.shape[-1]} inputs"
        raise ShapeError(
            f"the trajectory must have {wanted}, got {trajectory.states.shape} and {trajectory.inputs.shape}."
        )
    recorded = trajectory.first(int(trajectory.lengths))
    common, compared = min(recorded.horizon, expected.horizon), recorded
    if not common:  # it ended in its first step, so only its start can be compared
        states = np.stack([trajectory.states[0], expected.states[1]])
        common, compared = 1, Trajectory(trajectory.times[:2], states, expected.inputs[:1])
    require_execution(replace(plan, model_trajectory=expected.first(common)), compared.first(common), start_tolerance)
    return recorded


def recorded_before_failure(plan: Plan, trajectory: object, start_tolerance: float) -> Trajectory:
    """Return the steps of a plan that were recorded before its execution failed; refuse what has none of them."""
    expected = plan.model_trajectory
    if not isinstance(trajectory, Trajectory):
        raise InputError("nothing was recorded.")
    shapes = [(run.states.ndim, run.states.shape[-1], run.inputs.shape[-1]) for run in (trajectory, expected)]
    if shapes[0] != shapes[1]:
        _, states, inputs = shapes[1]
        raise ShapeError(f"it must have {states} states and {inputs} inputs, got {shapes[0][1]} and {shapes[0][2]}.")
    unknown = ~np.isfinite(np.concatenate([trajectory.states[1:], trajectory.inputs], axis=1)).all(axis=1)
    steps = min([trajectory.horizon, expected.horizon, *np.flatnonzero(unknown)[:1].tolist()])
    if not steps:
        raise InputError("its first step is not finite.")
    recorded = trajectory.first(steps)
    require_execution(replace(plan, model_trajectory=expected.first(steps)), recorded, start_tolerance)
    return recorded


def least_distance(validation: Validation, point: ArrayLike, model: Trajectory, recorded: Trajectory) -> float | None:
    """Return what the distance of an execution is at least that failed after some steps; None if nothing is known.

    It is the distance if S had followed M from there on. Numbers that diverge are cut off where it is not finite.
    """
    if not getattr(validation.distance, "monotone", False):
        return None
    if model.ended != COMPLETE:
        with suppress(DistanceError):
            return validation.remeasure(point, model, recorded)
        return None
    for steps in range(recorded.horizon, 0, -1):
        states = np.concatenate([recorded.states[: steps + 1], model.states[steps + 1 :]])
        inputs = np.concatenate([recorded.inputs[:steps], model.inputs[steps:]])
        with suppress(DistanceError), np.errstate(all="ignore"):
            return validation.remeasure(point, model, Trajectory(model.times, states, inputs))
    return None


def inputs_along(controller: Controller, task: Task, states: Array) -> Iterator[Array]:
    """Yield the inputs ``(m,)`` that a controller gives at states ``(H, n)``, each when it is asked for."""
    pi = started(controller, task)
    for t, x in enumerate(states):
        yield as_floats("inputs of a controller", pi(t, x.copy()))


def gives_inputs(plan: Plan, trajectory: Trajectory, tolerance: float) -> bool:
    """Return whether the controller of a plan gives the recorded inputs at the recorded states.

    The execution is then also one of this controller: a deterministic system cannot tell the two apart. A controller
    with memory runs along the recorded states from the first one. The tolerance is a share of the largest magnitude of
    each input.
    """
    states, inputs = trajectory.states, trajectory.inputs
    if plan.model_trajectory.states.shape != states.shape or plan.model_trajectory.inputs.shape != inputs.shape:
        return False
    nearest = tolerance * np.maximum(np.abs(inputs).max(axis=0, initial=0.0), 1e-300)
    try:
        with np.errstate(all="ignore"):
            pairs = zip(inputs_along(plan.controller, plan.task, states[:-1]), inputs, strict=True)
            return all(bool((np.abs(given - u) <= nearest).all()) for given, u in pairs)
    except Exception:  # the user's controller, at states that it never reached by itself
        return False


def observation_delay(runs: Sequence[tuple[Controller, Task, Trajectory]], most: int = 12) -> int:
    """Return the steps by which the states are old at which controllers gave the recorded inputs; 0 if they are not.

    They are old if the controllers give these inputs to a third of the difference at the latest states. Before an old
    state is known, it is the first one. Controllers that cannot be run tell nothing.
    """

    def gap(steps: int) -> float:
        squares = 0.0
        for controller, task, run in runs:
            seen = run.states[np.maximum(np.arange(run.horizon) - steps, 0)]
            sizes = np.maximum((run.inputs**2).mean(axis=0), 1e-300)
            gaps = np.array(list(inputs_along(controller, task, seen))) - run.inputs
            squares += float(((gaps**2).mean(axis=0) / sizes).sum())
        return squares

    try:
        with np.errstate(all="ignore"):
            latest = gap(0)
            if not latest > 1e-3**2 * len(runs):
                return 0
            longest = min(most, min(run.horizon for *_, run in runs) // 3)
            gaps = [latest, *(gap(steps) for steps in range(1, longest + 1))]
    except Exception:  # the user's controller, at states that it never reached by itself
        return 0
    best = int(np.nanargmin(gaps))
    return best if gaps[best] < latest / 9 else 0


def input_difference(
    controller: Controller, task: Task, trajectory: Trajectory, names: Mapping[str, str]
) -> str | None:
    """Return how recorded inputs, with their names and units, differ from those of a controller at the recorded states.

    Returns None if they differ by at most a third, as the root mean square of each input over the steps: sensors,
    clocks and drives make such differences, and a recording of another run makes larger ones. Inputs that the
    controller gives at older states are named in any case. It is also None if the controller cannot be run along these
    states.
    """
    states, inputs = trajectory.states, trajectory.inputs
    if old := observation_delay([(controller, task, trajectory)]):
        return f"they are those at states that are {counted(old, 'step')} old"
    try:
        with np.errstate(all="ignore"):
            given = np.array(list(inputs_along(controller, task, states[:-1])))
            gaps = np.abs(given - inputs)
    except Exception:  # the user's controller, at states that it never reached by itself
        return None
    sizes = np.sqrt(np.maximum(np.mean(given**2, axis=0), np.mean(inputs**2, axis=0)))
    least = 1e-9 * np.abs(given).max(initial=0.0)  # rounding is no difference
    apart = np.sqrt(np.mean(gaps**2, axis=0)) > np.maximum(sizes / 3, least)
    if not apart.any():
        return None
    t, i = np.unravel_index(np.argmax(np.where(apart, gaps / np.maximum(sizes, 1e-300), -1.0)), gaps.shape)
    name, unit = list(names.items())[i]
    return f"{name} is {inputs[t, i]:.3g} {unit}".rstrip() + f" at {trajectory.times[t]:.3g} s, not {given[t, i]:.3g}"


class DistanceWarning(UserWarning):
    """The distance between a trajectory and itself is not 0."""


def try_distance(validation: Validation, plan: Plan) -> None:
    """Measure the model's trajectory of a plan against itself; warn if the distance is not 0.

    A distance to the task has the attribute ``to_task = True``.
    """
    value = validation.measure(plan, plan.model_trajectory)
    if value > 1e-9 and not (validation.is_on_model or getattr(validation.distance, "to_task", False)):
        where = validation.space.describe_point(plan.parameters.points)
        warnings.warn(
            f"the distance between the trajectory of the model and itself is {value:.3g}, not 0, for the task {where}. "
            "If it measures how S completes its task, give it the attribute to_task = True; otherwise correct it.",
            DistanceWarning,
            stacklevel=2,
        )


def require_repeatable(validation: Validation, plan: Plan) -> None:
    """Refuse a task that differs if it is made again, and a closed loop on M that differs if it runs again.

    A controller that remembers steps in itself goes on from the run on M when S is executed, and a difference that the
    system does not have would be measured. Solvers that begin at their last solution differ by less than is permitted.
    """
    task, first = validation.task_at(plan.parameters), plan.model_trajectory
    if any(
        not np.array_equal(getattr(task, name), getattr(plan.task, name)) for name in ("initial_state", "reference")
    ):
        raise InputError(
            "the task function must make the same task of the same parameters, and it made two: it is random, or it "
            "depends on more than the parameters."
        )
    try:
        again = validation.closed_loop(plan.controller, plan.task)
        again = again.first(min(int(again.lengths), first.horizon))
    except CtxvalError:
        raise
    except Exception as error:
        raise DesignError(f"the controller failed when it ran a second time: {reason_of(error)}.") from error
    for kind, before, after in (("input", first.inputs, again.inputs), ("state", first.states, again.states)):
        same = np.abs(after - before) <= 1e-3 * np.abs(before).max(axis=0, initial=0.0)  # of each magnitude
        if not same.all():
            t, i = np.argwhere(~same)[0]
            raise DesignError(
                f"the closed loop on the model must be the same if it runs again, and {kind} {i} at step {t} is "
                f"{after[t, i]:.4g}, was {before[t, i]:.4g}: the controller or the model remembers the first run, or "
                "is random. Keep the memory of a controller in `start` and `step`, or begin it anew at step 0, with a "
                "fixed seed if it draws numbers; `models.Expected` is the expected step of a random model."
            )


@dataclass(frozen=True)
class StartOffset:
    """How far an execution starts from the initial state of its task."""

    size: float  #: as the distance measures differences of states, or the largest of all states if that is unknown
    text: str  #: the largest offset of a state, with the name of the state


def start_offset(validation: Validation, point: ArrayLike, trajectory: Trajectory) -> StartOffset:
    """Return how far an execution of the task at ``(d,)`` starts from the initial state of the task."""
    start = validation.recorded(validation.task(validation.space.parameters(point)).initial_state)
    gap = np.abs(trajectory.states[0] - start)
    size, state = float(gap.max()), int(gap.argmax())
    if hasattr(validation.distance, "difference"):
        compared = validation.distance.difference(trajectory.states[0], start)
        size = float(np.linalg.norm(compared, getattr(validation.distance, "norm", 1), axis=-1))
    name, unit = list(validation.names(len(gap), trajectory.inputs.shape[-1])[0].items())[state]
    return StartOffset(size, f"{gap[state]:.2g} {unit}".rstrip() + f" in {name}")
