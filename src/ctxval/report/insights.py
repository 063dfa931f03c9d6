"""Insights in words: what the trials show of M, of the controllers and of the tasks, each with its numbers."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import counted
from ctxval._util.texts import enumerated
from ctxval._util.turns import turns
from ctxval.certificates.bounds import state_of
from ctxval.core import soundness
from ctxval.core.distance import ComposedDistance
from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TaskSuite
from ctxval.report.findings import Answer, Question
from ctxval.report.markup import number, percent, quantity

if TYPE_CHECKING:
    from ctxval.report.context import ReportContext, TrajectoryPair

_WORST = 5  # number of trials with the largest distances that the insights on closed loops look at


def weak_region(context: ReportContext) -> Answer | None:
    """Where the distance exceeds the threshold, executed and predicted."""
    tau, units = context.threshold, context.labels.units
    if tau is None or not len(context.distances):
        return None
    above = context.distances > tau
    largest, model = quantity(float(context.distances.max()), units), context.distance_model
    share = 0.0 if model is None else float((model.over_tasks.median > tau).mean())
    numbers = {"executed_above": int(above.sum()), "executed": len(above), "predicted_share_above": share}
    if not above.any():
        text = f"No executed task exceeds {quantity(tau, units)}, but the trials predict that {percent(share)} do."
        return ("attention", text, numbers) if share else None
    # Below a share of 0.002, too few of the random tasks are weak.
    weak = context.points[above] if model is None or share < 0.002 else model.tasks[model.over_tasks.median > tau]
    text = (
        f"{int(above.sum())} of {len(above)} executed tasks exceed {quantity(tau, units)}, the largest with {largest}: "
        f"{region_text(context, weak)}. The trials predict that {percent(share)} of all tasks exceed it."
    )
    return "bad", text, numbers


def region_text(context: ReportContext, points: Array) -> str:
    """Return where points of the unit cube ``(m, d)`` lie, by the parameters in which they differ from all tasks."""
    return _region(context.space, points)


@functools.singledispatch
def _region(space: TaskSpace, points: Array) -> str:
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    width = high - low
    ends = space.from_unit(np.stack([low, high]))
    parts = []
    for j in [int(j) for j in np.argsort(width) if width[j] < 0.7][:3]:  # narrower than this share of the range
        first, last, label = number(ends[0, j], 3), number(ends[1, j], 3), space.labels[j]
        parts.append(f"{label} at {first}" if first == last else f"{label} from {first} to {last}")
    return f"most of them have {' and '.join(parts)}" if parts else "they are spread over the task space"


@_region.register(TaskSuite)
def _(space: TaskSuite, points: Array) -> str:
    return f"they are {enumerated(dict.fromkeys(map(space.name_at, points)), 8)}"


def weak_states(context: ReportContext) -> Answer | None:
    """Which states and inputs the system visits where M is weak, and not elsewhere."""
    if len(context.recordings) < 4:
        return None
    above = np.array([run.distance for run in context.recordings.values()]) > (context.threshold or np.inf)
    weak, which = above, "above the threshold"
    if above.all() or not above.any():
        weak, which = np.arange(len(above)) < max(1, len(above) // 4), "with the largest distances"
    runs = [run.system for run in context.recordings.values()]
    low = np.array([[*run.states.min(axis=0), *run.inputs.min(axis=0)] for run in runs])
    high = np.array([[*run.states.max(axis=0), *run.inputs.max(axis=0)] for run in runs])
    inside_low, inside_high = low[~weak].min(axis=0), high[~weak].max(axis=0)
    span = np.maximum(high.max(axis=0) - low.min(axis=0), 1e-300)
    beyond = np.maximum(high[weak].max(axis=0) - inside_high, inside_low - low[weak].min(axis=0)) / span
    j = int(beyond.argmax())
    if beyond[j] < 0.05:
        return None
    label = [label for labels in context.signals for label in labels][j]
    numbers = {"signal": label, "beyond": float(beyond[j])}
    text = (
        f"{counted(int(weak.sum()), 'trial')} {which}: {label} goes from {number(low[weak, j].min())} to "
        f"{number(high[weak, j].max())}; all others stay within {number(inside_low[j])} and {number(inside_high[j])}."
    )
    return "note", text, numbers


def explained(context: ReportContext) -> Answer | None:
    """Whether the corrected model, learned from the other trials, predicts the distance."""
    if context.validation is None:
        return "unknown", "Not known: it needs the experiment, which is not loaded.", {}
    replays = {k: replay.distance for k, replay in context.replays.items() if np.isfinite(replay.distance)}
    pairs = [(context.recordings[k].distance, distance) for k, distance in replays.items()]
    if len(pairs) < 2:
        return "unknown", "Not known: the trials do not teach a correction of M.", {}
    executed, predicted = np.array(pairs).T
    size = float(np.sqrt((executed**2).mean()))
    error = float(np.sqrt(((executed - predicted) ** 2).mean()))
    left = error / max(size, 1e-300)
    share = 1 - left
    numbers = {"share_explained": share, "error": error, "trials": len(pairs)}
    text = (
        f"M with a residual that is learned from the other trials predicts the distances of {len(pairs)} trials with "
        f"an error of {quantity(error, context.labels.units)} (root mean square), {percent(left)} of the distances."
    )
    estimated = context.validation.outputs.hide_states
    of = f"{'' if estimated else 'the '}{state_of(estimated)}"
    if share >= 0.8:
        difference = f"the difference is a function of {of} and input"
        fitted = "a model that is fitted to these data can remove it"
        return "good", f"{text} It explains the distance: {difference}, and {fitted}.", numbers
    causes = "a state that is not recorded, a contact, dry friction or noise is the likely cause, or too few trials"
    return "attention", f"{text} It does not explain the distance: {causes}.", numbers


def components(context: ReportContext) -> Answer | None:
    """Which states err in the worst trials, and when their errors peak."""
    if not context.recordings:
        return None
    runs = list(context.recordings.values())
    worst, spans = runs[:_WORST], soundness.ranges([run.system.states for run in runs])
    errors = [np.abs(run.system.states - run.model.states) / spans for run in worst]
    peaks = np.mean([error.max(axis=0) for error in errors], axis=0)
    j = int(peaks.argmax())
    times = [float(run.system.times[error[:, j].argmax()]) for run, error in zip(worst, errors, strict=True)]
    end = float(np.mean([run.system.times[-1] for run in worst]))
    label, when = context.signals[0][j], float(np.median(times))
    text = (
        f"In the {counted(len(worst), 'worst trial')}, S differs from M most in {label}: by {percent(float(peaks[j]))} "
        f"of its range at the peak, which is at {number(when, 3)} s of {number(end, 3)} s."
    )
    turn_of_s = turns([run.system.states[:, j] for run in worst])[0]
    if turn_of_s != turns([run.model.states[:, j] for run in worst])[0]:
        text += (
            f" {label} jumps by a whole turn in the loops of {'S' if turn_of_s else 'M'} alone: continue the angle "
            "over turns, or list it in the angles of the distance."
        )
    shares = _shares(context, worst)
    numbers = {"state": label, "peak": float(peaks[j]), "time": when, "shares": shares}
    if shares:
        largest = sorted(shares.items(), key=lambda item: -item[1])[:3]
        listed = " and ".join(f"{percent(share)} is in {name}" for name, share in largest)
        text += f" Of the error that the distance measures, {listed}."
    return "note", text, numbers


def _shares(context: ReportContext, worst: list[TrajectoryPair]) -> dict[str, float]:
    """Return the shares of the states in the error that the distance is composed of; empty if they are not known."""
    distance, labels = getattr(context.validation, "distance", None), context.signals[0]
    if not isinstance(distance, ComposedDistance) or not hasattr(distance, "components"):
        return {}
    names = labels if distance.components is None else [labels[i] for i in distance.components]
    tasks = [context.replays[k].task for k in list(context.recordings)[:_WORST] if k in context.replays]
    errors = np.array([distance.error(run.model, run.system, task) for run, task in zip(worst, tasks, strict=False)])
    if errors.ndim != 2 or errors.shape[1] != len(names) or not np.abs(errors).sum() > 0:
        return {}
    sizes = np.abs(errors).mean(axis=0)
    return {name: float(size) for name, size in zip(names, sizes / sizes.sum(), strict=True)}


def flips(context: ReportContext) -> Answer | None:
    """Whether the controllers of neighbouring tasks differ abruptly."""
    if len(context.recordings) < 2:
        return None
    numbers, runs = list(context.recordings), list(context.recordings.values())
    points = np.array([run.trial.unit_point for run in runs])
    pairs = soundness.flips(points, [run.model.inputs for run in runs])
    if pairs is None or not pairs.flipped:
        return None
    i, j = pairs.example
    values = {"neighbours": pairs.pairs, "flipped": pairs.flipped, "largest_change": pairs.largest}
    text = (
        f"{pairs.flipped} of {pairs.pairs} pairs of neighbouring tasks have controllers that differ abruptly, for "
        f"example trials {numbers[i]} and {numbers[j]}: their inputs on M differ by {percent(pairs.largest)} of the "
        "range of the inputs. A planner that jumps between solutions makes the distance jump, too."
    )
    return "attention", text, values


def saturation(context: ReportContext) -> Answer | None:
    """Whether inputs stay at their limits."""
    synthesizer = None if context.validation is None else context.validation.synthesizer
    limits = soundness.saturation([run.system.inputs for run in context.recordings.values()], synthesizer)
    if limits is None or limits.shares.max() < soundness.SATURATED:
        return None
    j = int(limits.shares.argmax())
    label, share = context.signals[1][j], float(limits.shares[j])
    values = {"input": label, "share_of_steps": share, "limits_known": limits.known}
    guess = "" if limits.known else " (the limits are taken from the records, in which the extreme value repeats)"
    return "attention", f"{label} is at its limit in {percent(share)} of all steps{guess}.", values


def converged(context: ReportContext) -> Answer | None:
    """Whether the designs of the controllers converged, and whether controllers jump."""
    if context.designs is None:
        return None
    return "attention", f"{context.designs[0].upper()}{context.designs[1:]}.", {}


def goals(context: ReportContext) -> Answer | None:
    """Whether M itself reaches its goals under the controllers that are designed on it."""
    if context.validation is None:
        return "unknown", "Not known: it needs the experiment, which is not loaded.", {}
    if not any(replay.task.has_goal for replay in context.replays.values()):
        return None
    numbers = list(context.replays)
    on_model = [context.recordings[k].model for k in numbers]
    misses = soundness.goal_misses(context.validation, on_model, [context.replays[k].task.goal for k in numbers])
    if misses is None or not misses.missed.any():
        return None
    missed, (row, state, size) = int(misses.missed.sum()), misses.worst
    label = context.signals[0][state]
    values = {"missed": missed, "trials": len(numbers), "largest_miss": size, "state": label}
    text = (
        f"In {missed} of {len(numbers)} trials M ends farther than {percent(soundness.MISSED)} of the range "
        f"of a weighted state from its goal; it misses most in {label}, by {number(size)}, in trial {numbers[row]}. A "
        "controller that fails on M cannot be expected to work on S."
    )
    return "attention", text, values


def cause(context: ReportContext) -> Answer | None:
    """What M lacks, if ``ctxval why`` has found it in the present trials."""
    return ("note", context.cause, {}) if context.cause else None


INSIGHTS: dict[str, Question] = {
    "Why M fails": cause,
    "Where M is weak": weak_region,
    "States visited there": weak_states,
    "What errs, and when": components,
    "Controllers of neighbouring tasks": flips,
    "Inputs and their limits": saturation,
    "Design of the controllers": converged,
    "Goals of M": goals,
    "Corrected model": explained,
}
