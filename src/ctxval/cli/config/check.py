"""Checks that the parts of an experiment fit together; the system is executed only on request."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ctxval import Task, TaskSuite, Trajectory, Validation
from ctxval._util.progress import stage
from ctxval._util.representation import task_text
from ctxval._util.texts import reason_of
from ctxval.campaign.costs import ThinkingCosts
from ctxval.certificates.bounds import of_tasks
from ctxval.core.controller import converged_of
from ctxval.core.experiment import Experiment
from ctxval.core.labels import labels_of, names_of
from ctxval.core.plan import Plan, require_repeatable
from ctxval.core.soundness import MISSED, SATURATED, goal_misses
from ctxval.core.trajectory import COMPLETE
from ctxval.errors import ConformanceError, CtxvalError
from ctxval.learning import DynamicsStudy
from ctxval.learning.extended import with_states_of_model
from ctxval.learning.sensitivity import found_sensitivity
from ctxval.learning.stage_costs import Speed, Thinking, ThinkingSettings
from ctxval.models import MuJoCo
from ctxval.models.mujoco import proposed_invariant
from ctxval.specs import Specification
from ctxval.studies.aspect1 import Aspect1Report
from ctxval.testing import check_distance, check_model, check_synthesizer

FindingState = Literal["ok", "noted", "failed", "skipped"]
Findings = Iterator[tuple[FindingState, str]]


@dataclass(frozen=True)
class Checked:
    """The result of one check: a sentence, and whether it is ok, failed, not made, or to be read by the user."""

    check: str
    state: FindingState
    text: str


def check_experiment(
    experiment: Experiment, *, execute: bool = False, seed: int = 0, spec: Specification | None = None
) -> list[Checked]:
    """Check that the parts of an experiment fit together, and what the model says of its specification."""
    validation = experiment.validation
    plans: list[Plan] = []
    findings = _checked({"space": _space(validation), "tasks": _tasks(validation, seed, plans)})
    if not plans:
        return findings
    run = plans[0].model_trajectory
    counts = {"states": run.states.shape[-1], "inputs": run.inputs.shape[-1]}
    of_model = {**counts, "states": plans[0].task.initial_state.shape[-1]}  # others if outputs are recorded
    return findings + _checked(
        {
            "controller on the model": _goals(validation, plans),
            "convergence of the designs": _convergence_of(validation, plans),
            "names": _names(experiment, counts),
            "system": _system(validation, plans[0], counts),
            "model": _model(validation, of_model),
            "model against itself": _itself(validation, plans),
            "small changes": _small_changes(validation),
            "batches": _batches(validation, plans),
            "distance": _distance(experiment, plans),
            "specification": _specification(spec, plans),
            "execution": _executions(validation, plans, execute),
            "cost": _cost(validation, plans),
        }
    )


def _checked(checks: Mapping[str, Findings]) -> list[Checked]:
    """Return the findings of generators, each of which begins to check when it is asked for its first one."""
    findings = list[Checked]()
    for name, check in checks.items():
        try:
            findings += [Checked(name, state, text) for state, text in check]
        except Exception as error:  # a user's own part may raise anything
            reason = str(error) if isinstance(error, CtxvalError) else reason_of(error)
            findings.append(Checked(name, "failed", reason))
    return findings


def _space(validation: Validation) -> Findings:
    space = validation.space
    if isinstance(space, TaskSuite):
        yield "ok", f"{len(space)} tasks with the parameters {', '.join(space.labels)}"
        return
    without = [name for name, label in zip(space.names, space.labels, strict=True) if name == label]
    missing = f"; no unit for {', '.join(without)}" if without else ""
    if len(without) > 1:
        missing += " (if it is one of length, the places of positions are tested before a validation)"
    text = f"{space.dimension} task parameters: {', '.join(space.labels)}{missing}"
    yield "noted" if without else "ok", text


def _tasks(validation: Validation, seed: int, plans: list[Plan]) -> Findings:
    """Plan the lowest, the middle, the highest and eight random tasks; of a suite, eleven of its tasks."""
    space, rng = validation.space, np.random.default_rng(seed)
    plans.extend([validation.plan(point) for point in space.examples(8, rng)])
    task, on_model = plans[0].task, plans[0].model_trajectory
    n, recorded = task.initial_state.shape[-1], on_model.states.shape[-1]
    states = f"{recorded} outputs of {n} states" if validation.outputs.hide_states else f"{n} states"
    sizes = f"{states}, {on_model.inputs.shape[-1]} inputs"
    yield "ok", f"{len(plans)} tasks planned: {sizes}, {task.horizon} steps of {task.dt:g} s"
    require_repeatable(validation, plans[0])


def _goals(validation: Validation, plans: Sequence[Plan]) -> Findings:
    """State how far M ends from its goals: in the worst state if it is known which are to reach them, or in all."""
    if not plans[0].task.has_goal:
        return
    on_model, goals = [plan.model_trajectory for plan in plans], [plan.task.goal for plan in plans]
    missed = goal_misses(validation, on_model, goals)
    if missed is None:
        errors = [np.abs(run.final_state - goal).sum() for run, goal in zip(on_model, goals, strict=True)]
        starts = [np.abs(plan.model_trajectory.states[0] - plan.task.goal).sum() for plan in plans]
        row, reached = int(np.argmax(errors)), max(errors) <= MISSED * max(starts)
        how = f"{errors[row]:.3g} from the goal (1-norm of the states)"
    else:
        (row, state, size), reached = missed.worst, not missed.missed.any()
        names = labels_of(validation.names(on_model[0].states.shape[-1], on_model[0].inputs.shape[-1])[0])
        how = f"{size:.3g} from the goal in {names[state]}"
    text = f"ends at most {how}, at {task_text(validation.space.describe_point(plans[row].parameters.points))}"
    if not reached:
        text += "; a controller that fails on the model itself cannot be expected to work on the system: see --aspect1"
    yield "ok" if reached else "noted", text


def _convergence_of(validation: Validation, plans: Sequence[Plan]) -> Findings:
    known = [(plan, converged) for plan in plans if (converged := converged_of(plan.controller)) is not None]
    failed = [validation.space.describe_point(plan.parameters.points) for plan, converged in known if not converged]
    if known:
        yield from _convergence(failed, len(known))


def _convergence(failed: Sequence[dict[str, Any]], designs: int) -> Findings:
    if not designs:
        yield "skipped", "the controllers do not tell whether they converged"
    elif not failed:
        yield "ok", f"all {designs} designs converged"
    else:
        examples = "; ".join(map(task_text, failed[:3]))
        yield "noted", f"{len(failed)} of {designs} designs did not converge, such as {examples}"


def _names(experiment: Experiment, counts: Mapping[str, int]) -> Findings:
    for kind, labels in (("states", experiment.states), ("inputs", experiment.inputs)):
        if labels and len(labels) != counts[kind]:
            names = f"the number of names is {len(labels)}: {', '.join(labels)}"
            yield "failed", f"there are {counts[kind]} {kind}, but {names}"
    for kind, named in zip(counts, experiment.names(*counts.values()), strict=True):
        bare = [name for name, unit in named.items() if not unit]
        missing = f"; no unit for {', '.join(bare)}" if bare else ""
        yield "noted" if bare else "ok", f"{kind}: {', '.join(labels_of(named)) or 'none'}{missing}"
    if (doubt := experiment.doubt_of_parameters) is not None:
        yield "noted", doubt.removesuffix(".")
    if not experiment.units:
        yield "noted", "the distance has no units"


def _system(validation: Validation, plan: Plan, counts: Mapping[str, int]) -> Findings:
    system, task = validation.system, plan.task
    dt = getattr(system, "dt", None)
    if isinstance(dt, int | float) and not np.isclose(dt, task.dt, rtol=1e-9, atol=0):
        yield "failed", f"the time step of the system is {dt:g} s, that of the task is {task.dt:g} s"
    for kind, count in counts.items():
        names = names_of(system, kind)
        if names and len(names) != count:
            yield "failed", f"the system has {len(names)} {kind}, the model has {count}: {', '.join(names)}"


def _model(validation: Validation, counts: Mapping[str, int]) -> Findings:
    try:
        check_model(validation.model, **counts)
        yield "ok", "batches and single states give the same; the Jacobian, if there is one, is the derivative"
    except ConformanceError:
        check_model(validation.model, **counts, tolerance=1e-5)
        yield "noted", "its results for batches and single states agree only to single precision"
    if isinstance(model := validation.model, MuJoCo) and not model.sites and not model.geometry.invariant:
        proposed = list(proposed_invariant(model.compiled))
        if proposed:
            yield "noted", f"if the ground of S is flat, invariant = {proposed} lets fewer executions teach M's error"


def _small_changes(validation: Validation) -> Findings:
    """State how far small changes move closed loops of M, if these are not smooth."""
    study, settings = DynamicsStudy(validation), ThinkingSettings()
    speed = Speed.measured(study.validation, validation.space.unit_draws(16, np.random.default_rng(0)), settings)
    if speed is not None:
        found = found_sensitivity(study.planner, Thinking(settings.default, settings.default, speed))
        if found is not None:
            yield "noted", found.in_words(validation.labels.units)


def _itself(validation: Validation, plans: Sequence[Plan]) -> Findings:
    """Run M in the place of S with the same controllers, and state d(M, M): no smaller distance means anything."""
    on_model, largest, apart = validation.on_model(validation.distance), 0.0, 0.0
    for plan in plans[:3]:
        again = on_model.system.execute(plan.controller, plan.task)
        again = again.first(min(int(again.lengths), plan.model_trajectory.horizon))
        largest = max(largest, validation.measure(plan, again))
        own = plan.model_trajectory.states[: again.horizon + 1]
        apart = max(apart, float((np.abs(again.states - own) / np.maximum(1.0, np.abs(own).max(axis=0))).max()))
    text = f"the distance between M and M in the place of S is {largest:.3g} in {len(plans[:3])} tasks"
    if apart <= 1e-9:
        yield "ok", text
    else:
        yield (
            "noted",
            f"{text}: two runs of M differ by up to {apart:.2g}, so M or its controller is random or remembers runs",
        )
    if early := [plan for plan in plans if plan.model_trajectory.ended != COMPLETE]:
        where = task_text(validation.space.describe_point(early[0].parameters.points))
        end = f"after {early[0].model_trajectory.times[-1]:.3g} s"
        yield "noted", f"its closed loop ends early in {len(early)} of {len(plans)} tasks, such as {end} at {where}"
    if falls := [plan for plan in plans if validation.falls(plan.model_trajectory)]:
        where = task_text(validation.space.describe_point(falls[0].parameters.points))
        yield "noted", f"its robot falls in {len(falls)} of {len(plans)} tasks, such as at {where}"


def _batches(validation: Validation, plans: Sequence[Plan]) -> Findings:
    points = np.stack([plan.parameters.points for plan in plans])
    batch = None
    with suppress(Exception):
        batch = validation.task_at(validation.space.parameters(points))
    if batch is None or batch.batch_shape != (len(points),):
        yield "noted", "the task function takes one point at a time, so searches are slower"
        return
    for index, plan in enumerate(plans):
        for name in ("reference", "initial_state"):
            values, alone = getattr(batch[index], name), getattr(plan.task, name)
            rounding = 1e-12 * np.abs(alone).max(initial=0)  # algebra of a batch sums in another order
            if values.shape != alone.shape or not np.allclose(values, alone, rtol=0, atol=rounding):
                yield "failed", f"task {index} of a batch differs from the same task alone: check the task function"
                return
    check_synthesizer(with_states_of_model(validation).synthesizer, batch[:4], validation.model)
    yield "ok", "task function and synthesizer give the same results in a batch as alone"


def _distance(experiment: Experiment, plans: Sequence[Plan]) -> Findings:
    validation = experiment.validation
    alike = [plan for plan in plans if plan.task.horizon == plans[0].task.horizon]  # others are no part of a batch
    trajectories = [plan.model_trajectory for plan in alike]
    if (doubt := experiment.doubt_of_units) is not None:
        yield "noted", doubt.removesuffix(".")
    states, inputs = (np.stack([getattr(run, name) for run in trajectories]) for name in ("states", "inputs"))
    model, shifted = (Trajectory(trajectories[0].times, states + shift, inputs) for shift in (0.0, 0.01))
    try:
        check_distance(validation.distance, model, shifted, Task.stacked([plan.task for plan in alike]))
        yield "ok", "finite, not negative, and the same in a batch as alone"
    except Exception:
        for plan in plans:
            validation.measure(plan, plan.model_trajectory)
        yield "noted", "the distance takes one task at a time, so searches are slower"
    largest = max(validation.measure(plan, plan.model_trajectory) for plan in plans)
    if largest > 0:
        yield "noted", f"the distance between a trajectory and itself is up to {largest:.3g}, not 0"


def _specification(spec: Specification | None, plans: Sequence[Plan]) -> Findings:
    if spec is None:
        return
    robustness = [float(spec.robustness(plan.model_trajectory, plan.task)) for plan in plans]
    satisfied, span = sum(rho > 0 for rho in robustness), f"{min(robustness):.3g} to {max(robustness):.3g}"
    text = f"the model satisfies it in {satisfied} of {len(plans)} tasks, with a robustness of {span}"
    yield "ok" if satisfied else "failed", text


def _executions(validation: Validation, plans: Sequence[Plan], execute: bool) -> Findings:
    plan = plans[1]
    if getattr(validation.system, "manual", False):
        yield "skipped", "people execute this system: see `ctxval ask`"
        return
    if not execute:
        yield "skipped", "give --execute to execute one task twice"
        return
    first, second = validation.execute(plan), validation.execute(plan)
    for trajectory in (first, second):
        validation.require(plan, trajectory)  # refuses another start
    gap = max(float(np.abs(run.states[0] - plan.model_trajectory.states[0]).max()) for run in (first, second))
    if gap > 1e-6:
        text = f"executions start up to {gap:.3g} away from the initial state of the task, which the start tolerance"
        yield "noted", f"{text} permits"
    spans = np.ptp(first.states, axis=0), np.ptp(plan.model_trajectory.states, axis=0)
    low, high = np.sort(spans, axis=0)
    for i in np.flatnonzero((low > 1e-9) & (high >= 30 * low))[:1]:
        name = [*validation.names(len(low), first.inputs.shape[-1])[0]][i]
        text = f"{name} changes by {spans[0][i]:.3g} in an execution and by {spans[1][i]:.3g} on the model"
        yield "noted", f"{text}: does the system return it in another unit?"
    noise = float(np.abs(first.states - second.states).max())
    distance, again = validation.measure(plan, first), validation.measure(plan, second)
    if noise == 0:
        yield "ok", f"two executions of one task are the same; the distance is {distance:.4g}"
    else:
        text = f"two executions of one task differ by up to {noise:.3g} in a state and {abs(distance - again):.3g} in "
        text += "the distance: the system is stochastic, and the verdict will allow for that"
        yield "noted", text


def _cost(validation: Validation, plans: Sequence[Plan]) -> Findings:
    with stage("measuring what a suggestion costs"):
        thinking = ThinkingCosts.measured(validation, [plan.parameters.points for plan in plans[:3]])
    text = f"a design takes {thinking.design:.2g} s of CPU, a closed loop on the model {thinking.closed_loop:.2g} s"
    if thinking.choice is not None:
        text += f"; the choice of a task takes about {thinking.choice:.2g} s, and the verdict {thinking.verdict:.2g} s"
        if thinking.choice > (default := ThinkingSettings().default):
            text += f", if `--thinking` does not limit them; by default, it is {default:g} s for a choice"
    if thinking.suggestion is not None:
        text += f"; with --explore, a suggestion takes about {thinking.suggestion:.2g} s if it thinks thoroughly "
        text += f"({thinking.designs} designs) and {thinking.fast:.2g} s if it thinks fast"
    # Seconds for a suggestion that the user should know of.
    yield "noted" if max(thinking.choice or 0.0, thinking.suggestion or 0.0) >= 30.0 else "ok", text


def aspect1_findings(report: Aspect1Report) -> list[Checked]:
    """Return what simulations of M show of its tasks and controllers, as sentences."""
    return _checked(
        {
            "tasks on the model": _completion(report),
            "falls": _falls(report),
            "neighbouring tasks": _flips(report),
            "limits of the inputs": _saturated(report),
            "convergence of the designs": _convergence(report.not_converged, report.designs),
        }
    )


def _completion(report: Aspect1Report) -> Findings:
    count, worst = len(report.simulated), report.worst
    at = task_text(worst.parameters)

    def number(value: float | None) -> str:
        return f"{value:.4g} {report.units}".rstrip()

    if report.failed:
        loops = f"M has no closed loop in {len(report.failed)} of {count} tasks"
        yield "failed", f"{loops}, for example at {at}: {worst.reason}"
        return
    ends = f"the worst of {count} tasks is {at}, with an error of {number(worst.error)}"
    if report.threshold is None:
        yield "noted", f"{ends}; give a threshold to judge it"
    elif report.exceeding:
        limit = number(report.threshold)
        yield "failed", f"M does not complete {report.exceeding} of {count} tasks within {limit}: {ends}"
    else:
        bound = None if report.verdict is None else report.verdict.bound
        held = f"; the error over all tasks is at most {number(bound)}" if bound is not None else ""
        tasks = "of all tasks" if report.distribution is None else of_tasks(report.distribution)
        share = f"; with confidence 0.95 it does not complete at most {100 * (report.share or 0):.3g} % {tasks}"
        yield "ok", f"M completes all of them: {ends}{share}{held}"


def _falls(report: Aspect1Report) -> Findings:
    if report.fallen:
        count, where = len(report.fallen), task_text(report.fallen[0].parameters)
        yield "failed", f"the robot of M falls in {count} of {len(report.simulated)} tasks, such as {where}"


def _flips(report: Aspect1Report) -> Findings:
    flips = report.flips
    if flips is None or report.flipped is None:
        return
    largest = f"{100 * flips.largest:.3g} % of the range of the inputs"
    if not flips.flipped:
        yield "ok", f"the inputs on M of {flips.pairs} pairs of neighbouring tasks differ by at most {largest}"
        return
    text = f"{flips.flipped} of {flips.pairs} pairs of neighbouring tasks have controllers that differ abruptly"
    pair = " and ".join(map(task_text, report.flipped))
    yield "noted", f"{text}, such as {pair}, whose inputs on M differ by {largest}"


def _saturated(report: Aspect1Report) -> Findings:
    if report.saturation is None:
        return
    at_limit = dict(zip(report.inputs, report.saturation.shares.tolist(), strict=True))
    named = [f"{name} in {100 * share:.3g} %" for name, share in at_limit.items() if share >= SATURATED]
    how = "" if report.saturation.known else "; the synthesizer states no limits, so repeated extreme values count"
    if named:
        yield "noted", f"at a limit: {', '.join(named)} of the steps on M{how}"
    else:
        yield "ok", "the inputs stay off their limits on M"
