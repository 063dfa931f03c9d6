"""Checks that the parts of an experiment fit together; the system is executed only on request."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.progress import stage
from ctxval._util.texts import reason_of
from ctxval.campaign.costs import ThinkingCosts
from ctxval.core.controller import converged_of
from ctxval.core.experiment import Experiment, mixed_units_sentence
from ctxval.core.labels import labels_of, names_of
from ctxval.core.plan import Plan
from ctxval.core.soundness import MISSED, goal_misses
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.errors import ConformanceError, CtxvalError
from ctxval.testing import check_distance, check_model, check_synthesizer

FindingState = Literal["ok", "noted", "failed", "skipped"]


@dataclass(frozen=True)
class Checked:
    """The result of one check: a sentence, and whether it is ok, failed, not made, or to be read by the user."""

    check: str
    state: FindingState
    text: str


def check_experiment(experiment: Experiment, *, execute: bool = False, seed: int = 0) -> list[Checked]:
    """Check that the parts of an experiment fit together."""
    validation = experiment.validation
    findings = [_space(validation)]
    plans: list[Plan] = []
    findings += _guarded("tasks", lambda: _tasks(validation, seed, plans))
    if not plans:
        return findings
    checks: list[tuple[str, Callable[[], Iterator[Checked]]]] = [
        ("names", lambda: _names(experiment, plans[0])),
        ("system", lambda: _system(validation, plans[0])),
        ("model", lambda: _model(validation, plans[0])),
        ("batches", lambda: _batches(validation, plans)),
        ("distance", lambda: _distance(validation, plans)),
        ("execution", lambda: _executions(validation, plans[1], execute)),
        ("cost", lambda: _cost(validation, plans)),
    ]
    for name, check in checks:
        findings += _guarded(name, check)
    return findings


def _guarded(name: str, check: Callable[[], Iterator[Checked]]) -> list[Checked]:
    findings: list[Checked] = []
    try:
        findings.extend(check())
    except Exception as error:  # a user's own part may raise anything
        findings.append(Checked(name, "failed", str(error) if isinstance(error, CtxvalError) else reason_of(error)))
    return findings


def _space(validation: Validation) -> Checked:
    space = validation.space
    without = [name for name, label in zip(space.names, space.labels, strict=True) if name == label]
    text = f"{space.dimension} task parameters: {', '.join(space.labels)}"
    if without:
        return Checked("space", "noted", f"{text}; no unit for {', '.join(without)}")
    return Checked("space", "ok", text)


def _tasks(validation: Validation, seed: int, plans: list[Plan]) -> Iterator[Checked]:
    """Plan the lowest, the middle, the highest and random tasks, and check the paper's Aspect 1 on them."""
    space = validation.space
    middle = 0.5 * (space.low + space.high)
    points = np.concatenate(
        [
            np.stack([space.low, middle, space.high]),
            # Number of random tasks that are planned, besides the lowest, the middle and the highest one.
            space.iid(8, np.random.default_rng(seed)),
        ]
    )
    made = [validation.plan(point) for point in points]
    plans.extend(made)
    task = made[0].task
    n, m = made[0].model_trajectory.states.shape[-1], made[0].model_trajectory.inputs.shape[-1]
    yield Checked(
        "tasks",
        "ok",
        f"{len(made)} tasks planned: {n} states, {m} inputs, {task.horizon} steps of {task.dt:g} s",
    )
    yield from _goals(validation, made)
    known = [(plan, converged) for plan in made if (converged := converged_of(plan.controller)) is not None]
    if known:
        failed = [space.describe_point(plan.parameters.points) for plan, converged in known if not converged]
        yield convergence(failed, len(known))


def convergence(failed: Sequence[dict[str, Any]], designs: int) -> Checked:
    """Return how many designs converged."""
    name = "convergence of the designs"
    if not designs:
        return Checked(name, "skipped", "the controllers do not tell whether they converged")
    if not failed:
        return Checked(name, "ok", f"all {designs} designs converged")
    examples = "; ".join(map(task_text, failed[:3]))
    return Checked(name, "noted", f"{len(failed)} of {designs} designs did not converge, such as {examples}")


def _goals(validation: Validation, made: Sequence[Plan]) -> Iterator[Checked]:
    """State how far M ends from its goals: in the worst state if it is known which are to reach them, or in all."""
    if not made[0].task.has_goal:
        return
    on_model, goals = [plan.model_trajectory for plan in made], [plan.task.goal for plan in made]
    found = goal_misses(validation, on_model, goals)
    if found is None:
        errors = [np.abs(one.final_state - goal).sum() for one, goal in zip(on_model, goals, strict=True)]
        starts = [np.abs(plan.task.initial_state - plan.task.goal).sum() for plan in made]
        row, reached = int(np.argmax(errors)), max(errors) <= MISSED * max(starts)
        how = f"{errors[row]:.3g} from the goal (1-norm of the states)"
    else:
        (row, column), reached = found.worst, not found.missed.any()
        names = labels_of(validation.names(on_model[0].states.shape[-1], on_model[0].inputs.shape[-1])[0])
        how = f"{found.misses[row, column]:.3g} from the goal in {names[int(found.states[column])]}"
    text = f"ends at most {how}, at {task_text(validation.space.describe_point(made[row].parameters.points))}"
    if not reached:
        text += "; a controller that fails on the model itself cannot be expected to work on the system: see --aspect1"
    yield Checked("controller on the model", "ok" if reached else "noted", text)


def task_text(parameters: dict[str, Any]) -> str:
    """Return the parameters of a task as a text."""
    return ", ".join(f"{name} = {_short(value)}" for name, value in parameters.items())


def _cost(validation: Validation, plans: Sequence[Plan]) -> Iterator[Checked]:
    """State what designs, closed loops on M and a suggestion of ``auto`` cost in CPU time."""
    with stage("measuring what a suggestion costs"):
        # Number of executions after which the cost of a suggestion is estimated.
        thinking = ThinkingCosts.measured(validation, [plan.parameters.points for plan in plans[:3]])
    text = f"a design takes {thinking.design:.2g} s of CPU, a closed loop on the model {thinking.closed_loop:.2g} s"
    if thinking.choice is not None:
        text += f"; the choice of a task takes about {thinking.choice:.2g} s, and the verdict {thinking.verdict:.2g} s"
    if thinking.suggestion is not None:
        text += (
            f"; with --explore, a suggestion takes about {thinking.suggestion:.2g} s if it thinks thoroughly "
            f"({thinking.designs} designs) and {thinking.fast:.2g} s if it thinks fast"
        )
    # Seconds for a suggestion that the user should know of.
    yield Checked("cost", "noted" if max(thinking.choice or 0.0, thinking.suggestion or 0.0) >= 30.0 else "ok", text)


def _short(value: Any) -> str:
    return "[" + ", ".join(f"{v:.4g}" for v in value) + "]" if isinstance(value, list) else f"{value:.4g}"


def _names(experiment: Experiment, plan: Plan) -> Iterator[Checked]:
    counts = plan.model_trajectory.states.shape[-1], plan.model_trajectory.inputs.shape[-1]
    for kind, labels, count in zip(("states", "inputs"), (experiment.states, experiment.inputs), counts, strict=True):
        if labels and len(labels) != count:
            sentence = f"there are {count} {kind}, but the number of names is {len(labels)}: {', '.join(labels)}"
            yield Checked("names", "failed", sentence)
    for kind, named in zip(("states", "inputs"), experiment.names(*counts), strict=True):
        bare = [name for name, unit in named.items() if not unit]
        text = ", ".join(labels_of(named)) or "none"
        missing = f"; no unit for {', '.join(bare)}" if bare else ""
        yield Checked("names", "noted" if bare else "ok", f"{kind}: {text}{missing}")
    if experiment.mixed_units:
        yield Checked("distance", "noted", mixed_units_sentence(experiment.mixed_units).removesuffix("."))
    if not experiment.units:
        yield Checked("names", "noted", "the distance has no units")


def _system(validation: Validation, plan: Plan) -> Iterator[Checked]:
    """Compare the time step, the states and the inputs of the system with those of the task and the model."""
    system, task = validation.system, plan.task
    dt = getattr(system, "dt", None)
    if isinstance(dt, int | float) and not np.isclose(dt, task.dt, rtol=1e-9, atol=0):
        yield Checked("system", "failed", f"the time step of the system is {dt:g} s, that of the task is {task.dt:g} s")
    counts = plan.model_trajectory.states.shape[-1], plan.model_trajectory.inputs.shape[-1]
    for kind, count in zip(("states", "inputs"), counts, strict=True):
        own = names_of(system, kind)
        if own and len(own) != count:
            text = f"the system has {len(own)} {kind}, the model has {count}: {', '.join(own)}"
            yield Checked("system", "failed", text)


def _model(validation: Validation, plan: Plan) -> Iterator[Checked]:
    states, inputs = plan.model_trajectory.states.shape[-1], plan.model_trajectory.inputs.shape[-1]
    try:
        check_model(validation.model, states=states, inputs=inputs)
        yield Checked(
            "model", "ok", "batches and single states give the same; the Jacobian, if there is one, is the derivative"
        )
    except ConformanceError:
        check_model(validation.model, states=states, inputs=inputs, tolerance=1e-5)
        yield Checked("model", "noted", "its results for batches and single states agree only to single precision")


def _batches(validation: Validation, plans: Sequence[Plan]) -> Iterator[Checked]:
    points = np.stack([plan.parameters.points for plan in plans])
    try:
        batch = validation.task(validation.space.parameters(points))
        same = isinstance(batch, Task) and batch.batch_shape == (len(points),)
    except Exception:
        same = False
    if not same:
        yield Checked("batches", "noted", "the task function takes one point at a time, so --truth is slower")
        return
    for index, plan in enumerate(plans):
        one = batch[index]
        if _differ(one.reference, plan.task.reference) or _differ(one.initial_state, plan.task.initial_state):
            yield Checked(
                "batches",
                "failed",
                f"task {index} of a batch differs from the same task alone: check the task function",
            )
            return
    starts, references = batch.initial_state[:4], batch.reference[:4]
    few = Task(starts, horizon=batch.horizon, dt=batch.dt, reference=references)
    check_synthesizer(validation.synthesizer, few, validation.model)
    yield Checked("batches", "ok", "task function and synthesizer give the same results in a batch as alone")


def _differ(one: Array, other: Array) -> bool:
    """Return whether two arrays differ by more than rounding: algebra of a batch sums in another order."""
    return one.shape != other.shape or not np.allclose(
        # Largest difference of a task in a batch, relative to the largest value of the task alone.
        one,
        other,
        rtol=0,
        atol=1e-12 * np.abs(other).max(initial=0),
    )


def _distance(validation: Validation, plans: Sequence[Plan]) -> Iterator[Checked]:
    trajectories = [plan.model_trajectory for plan in plans]
    model = _stacked(trajectories, 0.0)
    task = Task(
        np.stack([plan.task.initial_state for plan in plans]),
        horizon=plans[0].task.horizon,
        dt=plans[0].task.dt,
        reference=np.stack([plan.task.reference for plan in plans]),
    )
    try:
        check_distance(validation.distance, model, _stacked(trajectories, 0.01), task)
        yield Checked("distance", "ok", "finite, not negative, and the same in a batch as alone")
    except Exception:
        for plan, trajectory in zip(plans, trajectories, strict=True):
            validation.measure(plan, trajectory)
        yield Checked("distance", "noted", "the distance takes one task at a time, so --truth is slower")
    own = [validation.measure(plan, trajectory) for plan, trajectory in zip(plans, trajectories, strict=True)]
    if max(own) > 0:
        yield Checked(
            "distance", "noted", f"the distance between a trajectory and itself is up to {max(own):.3g}, not 0"
        )


def _stacked(trajectories: Sequence[Trajectory], shift: float) -> Trajectory:
    states: Array = np.stack([trajectory.states for trajectory in trajectories])
    return Trajectory(
        trajectories[0].times, states + shift, np.stack([trajectory.inputs for trajectory in trajectories])
    )


def _executions(validation: Validation, plan: Plan, execute: bool) -> Iterator[Checked]:
    """Execute one task twice, and check the initial state and the repeatability."""
    if getattr(validation.system, "manual", False):
        yield Checked("execution", "skipped", "people execute this system: see `ctxval ask`")
        return
    if not execute:
        yield Checked("execution", "skipped", "give --execute to execute one task twice")
        return
    first, second = validation.execute(plan), validation.execute(plan)
    for trajectory in (first, second):
        gap = float(np.abs(trajectory.states[0] - plan.task.initial_state).max())
        # Largest error of the initial state of an execution, in each state.
        if gap > 1e-6:
            yield Checked(
                "execution", "failed", f"the execution starts {gap:.3g} away from the initial state of the task"
            )
    noise = float(np.abs(first.states - second.states).max())
    distances = [validation.measure(plan, trajectory) for trajectory in (first, second)]
    if noise == 0:
        yield Checked("execution", "ok", f"two executions of one task are the same; the distance is {distances[0]:.4g}")
        return
    yield Checked(
        "execution",
        "noted",
        f"two executions of one task differ by up to {noise:.3g} in a state and {abs(distances[0] - distances[1]):.3g} "
        "in the distance: the system is stochastic; give --stochastic, or stochastic = true in [certificate]",
    )
