"""``replay``: what recordings show of a model, and what they predict of the tasks of an experiment, as one value."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.boxes import separated_rows
from ctxval._util.checked import Must, require
from ctxval._util.columns import unit_advice
from ctxval._util.describe import plain_json
from ctxval._util.representation import ShortRepr, counted, task_text
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.validation import Validation
from ctxval.data.recordings import Recordings
from ctxval.data.sampling import Break
from ctxval.errors import InputError
from ctxval.learning import DynamicsStudy
from ctxval.learning.closed_loops import loop_pairs
from ctxval.studies.replay import causes
from ctxval.studies.replay.accuracy import RegionalError, StepError, regions, step_errors, useless
from ctxval.studies.replay.causes import Fault, ResidualShare, Suggestion
from ctxval.studies.replay.units import in_units_of

STEPS = (1, 5, 20, 100)  #: numbers of steps after which errors are computed, unless others are given


@dataclass(frozen=True, eq=False)
class PredictedTask(ShortRepr):
    """The predicted distance of one task."""

    parameters: dict[str, Any]
    median: float  #: median, 0.05 and 0.95 quantile of the distance over posterior samples of the dynamics
    low: float
    high: float
    resolved: float | None = None  #: share of the variance of worst tasks that it and proposals before it resolve


@dataclass(frozen=True, eq=False)
class PredictedTasks(ShortRepr):
    """What recordings predict of the tasks of an experiment. No execution has tested it."""

    worst: tuple[PredictedTask, ...]  #: tasks with large predicted distances, the largest first
    median: float  #: median and 0.95 quantile of the largest distance over all tasks, over posterior samples
    upper: float
    executions: tuple[PredictedTask, ...]  #: the executions that would tell most of the largest distance, in this order
    draws: int  #: number of posterior samples of the dynamics
    unplanned: float  #: share of the tasks for which no controller can be designed, or on which the model diverges
    #: how far closed loops lead beyond all records of a state or input, as a share of their range, and its index
    beyond: float
    beyond_of: int


def predicted_tasks(validation: Validation, runs: list[Trajectory], count: int, seed: int) -> PredictedTasks | None:
    """Return what recordings predict of tasks; None if the model explains them, or if no task can be planned."""
    study = DynamicsStudy(validation, seed)
    learned = study.learn([], runs)
    if learned is None:
        return None
    with single_threaded():
        worst, pool = learned.worst_case_of(1), study.search.pool
        random = pool[np.random.default_rng([seed, 3]).permutation(len(pool))[:96]]
        together = np.concatenate([worst.local_maxima[:24], worst.points, random])
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
    chosen, resolved = _informative(drawn, count)
    maxima, space, beyond = worst.maxima, validation.space, learned.coverage.beyond

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
        beyond.size,
        learned.labels.index(beyond.coordinates[0]),
    )


def _informative(drawn: Array, count: int) -> tuple[Rows, Array]:
    """Return the tasks whose execution tells most of the worst tasks, and the share that they resolve, one by one.

    The distances of tasks are taken as jointly normal, with the covariance of the draws. The weight of a task is the
    share of the draws in which it is worst. Each choice resolves the largest part of the weighted variance left.
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


@dataclass(frozen=True)
class RecordedData(ShortRepr):
    """The recordings that were compared with the model."""

    sources: tuple[str, ...]  #: the files and episodes
    recordings: int  #: the numbers of recordings and of steps
    steps: int
    dt: float
    states: dict[str, str]  #: the names of the states and inputs with their units
    inputs: dict[str, str]
    breaks: tuple[Break, ...]  #: where logs were split and why, and sentences on how they were read
    notes: tuple[str, ...]
    seen: int  #: number of those from which the model was learned; left out of the errors, unless all are


@dataclass(frozen=True, eq=False)
class ReplayReport(ShortRepr):
    """What recordings show of a model."""

    data: RecordedData
    errors: tuple[StepError, ...]  #: the error of each state after each number of steps
    regions: tuple[RegionalError, ...]  #: the one-step error in ranges of each state and input
    residuals: tuple[ResidualShare, ...]  #: how much of the one-step residual of each state can be explained
    suggestions: tuple[Suggestion, ...]  #: changes of timing, and faults of the recordings, that explain errors
    faults: tuple[Fault, ...]
    tasks: PredictedTasks | None  #: None without an experiment, or if the recordings teach nothing
    insights: tuple[str, ...]  #: what follows, in sentences, the most important one first

    def to_json(self) -> dict[str, Any]:
        """Return all results as plain values; numbers that are not finite are None."""
        return plain_json(vars(self))


def replay(
    model: Model,
    recordings: Recordings,
    *,
    steps: Sequence[int] = STEPS,
    validation: Validation | None = None,
    executions: int = 10,
    seed: int = 0,
) -> ReplayReport:
    """Compare a model with recordings of its system. Nothing is executed.

    Args:
        steps: numbers of steps after which errors are computed.
        validation: an experiment with this model, whose tasks are then judged too; its system is never executed.
        executions: number of executions of the experiment that are proposed.

    Raises:
        InputError: if tasks and recordings differ in states or dt.
    """
    positive = Must("positive integers", lambda steps: len(steps) > 0 and min(steps) >= 1)
    require("steps", Annotated[Sequence[int], positive], steps)
    if validation is not None:
        validation.require_states("a replay")
        space = validation.space
        task = validation.task_at(space.parameters(0.5 * (space.low + space.high)))
        if task.initial_state.shape[-1] != len(recordings.states):
            raise InputError(
                f"the tasks have {task.initial_state.shape[-1]} states and the recordings have "
                f"{len(recordings.states)}: {', '.join(recordings.states)}."
            )
        if not np.isclose(task.dt, recordings.dt, rtol=1e-3, atol=0):
            raise InputError(
                f"the tasks have steps of {task.dt:g} s and the recordings have steps of {recordings.dt:g} s: "
                f"{unit_advice(recordings.dt, task.dt) or f'give dt = {task.dt:g} in the mapping of the recordings'}."
            )
    recordings = in_units_of(model, recordings)
    new = unseen(model, recordings)
    used = new or list(range(len(recordings.runs)))
    recorded = replace(recordings, runs=tuple(recordings.runs[number] for number in used))
    with single_threaded():
        errors = step_errors(model, recorded, sorted(set(steps)))
        where = regions(model, recorded)
        residuals = causes.residual_shares(model, recorded, seed)
        wrong = causes.faults(model, recordings, used)
        # What is wrong with the recordings must not look like a mistake of timing.
        changes = () if any(fault.explains for fault in wrong) else causes.suggestions(model, recorded)
    tasks = None
    if validation is not None:
        logged = [run.trajectory for run in recordings.runs]
        tasks = predicted_tasks(validation, logged, executions, seed)
    sources, count = tuple(dict.fromkeys(run.source for run in recordings.runs)), len(recordings.runs)
    about = recordings.steps, recordings.dt, recordings.states, recordings.inputs, recordings.breaks, recordings.notes
    data = RecordedData(sources, count, *about, count - len(new))
    report = ReplayReport(data, errors, where, residuals, changes, wrong, tasks, ())
    sentences = [*_insights(report, len(used)), *_insights_of_tasks(report)]
    if validation is not None and tasks is None:
        sentences.append(
            "nothing is predicted of the tasks: the model explains the recordings, or no controller can be designed "
            "for a task"
        )
    return replace(report, insights=tuple(sentences))


def unseen(model: Model, recordings: Recordings) -> list[int]:
    """Return the recordings most of whose steps are not in the data from which the model was learned."""
    data, sizes = getattr(model, "data", None), (len(recordings.states), len(recordings.inputs))
    if not isinstance(data, Transitions) or (data.x.shape[1], data.u.shape[1]) != sizes:
        return list(range(len(recordings.runs)))

    def rows(transitions: Transitions) -> list[bytes]:  # equal if the numbers agree to single precision
        whole = np.concatenate([transitions.x, transitions.u, transitions.x_next], axis=1)
        return [row.tobytes() for row in (whole.astype(np.float32) + np.float32(0.0))]

    known = set(rows(data))
    recorded = [rows(run.trajectory.transitions()) for run in recordings.runs]
    return [k for k, steps in enumerate(recorded) if sum(step in known for step in steps) <= len(steps) / 2]


# What follows, in sentences


def _insights(report: ReplayReport, used: int) -> Iterator[str]:
    """Yield what follows for the model from so many recordings, the most important sentence first."""
    data, errors, single = report.data, report.errors, [error for error in report.errors if error.steps == 1]
    if data.breaks:
        places = {(gap.source, gap.time): gap.seconds for gap in data.breaks}  # several fields may lack one time
        yield (
            f"the logs were split at {counted(len(places), 'place')}, and {sum(places.values()):.3g} s are left out; "
            f"the first is {data.breaks[0]}"
        )
    if data.seen == data.recordings:
        yield "the model was learned from all of these recordings, so its errors on others are larger"
    elif data.seen:
        yield f"the model was learned from {data.seen} of these recordings; the errors are those of the others"
    yield from (fault.sentence for fault in report.faults if fault.explains)
    yield from (change.sentence for change in report.suggestions)
    if not single:
        yield "no recording has a single step, so nothing can be compared"
        return
    worst, fault = max(single, key=lambda error: error.relative), useless(errors)
    if fault is not None and fault.steps == 1:
        yield (
            f"the model predicts {fault.state} no better than no change at all: its one-step error is "
            f"{100 * fault.relative:.0f} % of the recorded change"
        )
    steps = max(error.steps for error in errors)
    late = ", ".join(error.state for error in errors if error.steps == steps and error.relative >= 1)
    if late and worst.relative < 1:
        yield f"after {steps} steps the model predicts {late} no better than no change at all"
    diverged = max(errors, key=lambda error: error.diverged)
    if diverged.diverged > 0:
        yield f"{100 * diverged.diverged:.2g} % of the predictions of {diverged.steps} steps diverge"
    if used == 1:
        yield "only one recording is compared, so the spread is that over five parts of it"
    if any(fault.explains for fault in report.faults):
        return
    # Causes of an error that is small, as a share of the change, are not named.
    not_small = {error.state for error in single if not error.relative < 1e-3}
    for residual in report.residuals:
        if residual.state in not_small:
            yield from _causes(residual)
    if not_small:
        for region in sorted(report.regions, key=lambda region: -region.ratio)[:3]:
            if region.ratio >= 1.5:
                yield (
                    f"the one-step error is {region.ratio:.2g} times as large as on average where {region.variable} is "
                    f"between {region.low:.3g} and {f'{region.high:.3g} {region.unit}'.rstrip()}"
                )


def _causes(residual: ResidualShare) -> Iterator[str]:
    """Yield the causes of the residual of a state: an explanation is named if it is at least half of it."""
    left = f"{residual.rest:.3g} {residual.unit}".rstrip()
    if residual.explained >= causes.EXPLAINS:
        how = "an affine function" if residual.linear > 0.9 * residual.explained else "a function"
        yield (
            f"{100 * residual.explained:.0f} % of the residual of {residual.state} is {how} of state and input: a "
            f"better model can be learned from these recordings, with {left} of one-step error left"
        )
    elif residual.history < causes.EXPLAINS:
        yield (
            f"no cause explains half of the residual of {residual.state}: state and input explain "
            f"{100 * residual.explained:.0f} % of it, and the step before {100 * residual.history:.0f} % of the rest; "
            f"what is left, {left}, may be noise, something that is not recorded, or a function that this check is too "
            "coarse for"
        )
    if residual.history >= causes.EXPLAINS and residual.rest > 0.05 * residual.rms:
        yield (
            f"the step before explains {100 * residual.history:.0f} % of what state and input leave of the residual of "
            f"{residual.state}: the system has a state that is not recorded, a delay, or filtered measurements; "
            "lags = 1 in the mapping, or a rate as { derivative_of = ... }, gives the model a past"
        )


def _insights_of_tasks(report: ReplayReport) -> Iterator[str]:
    tasks, names = report.tasks, [*report.data.states, *report.data.inputs]
    if tasks is None or not tasks.worst:
        return
    worst = tasks.worst[0]
    yield (
        f"of all tasks, {task_text(worst.parameters)} has the largest predicted distance, {worst.median:.3g} (between "
        f"{worst.low:.3g} and {worst.high:.3g}); no execution has tested it"
    )
    if tasks.beyond > 0.05:
        yield (
            f"predicted runs of the tasks leave the recorded range of {names[tasks.beyond_of]} by "
            f"{100 * tasks.beyond:.0f} %: predictions are extrapolated there"
        )
