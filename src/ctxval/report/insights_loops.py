"""Insights on the closed loops: which states err and when, and whether the controllers are sound."""

from __future__ import annotations

import numpy as np

from ctxval._util.representation import counted
from ctxval.core import soundness
from ctxval.core.distance import ComposedDistance
from ctxval.report.context import Recording, ReportContext
from ctxval.report.findings import Finding
from ctxval.report.markup import number, percent

_WORST = 5
"""Number of trials with the largest distances that these insights look at."""


def components(context: ReportContext) -> Finding | None:
    """Which states err in the worst trials, and when their errors peak."""
    if not context.recordings:
        return None
    worst = list(context.recordings.values())[:_WORST]
    spans = soundness.ranges([run.system.states for run in context.recordings.values()])
    errors = [np.abs(run.system.states - run.model.states) / spans for run in worst]
    peaks = np.mean([each.max(axis=0) for each in errors], axis=0)
    j = int(peaks.argmax())
    times = [float(run.system.times[error[:, j].argmax()]) for run, error in zip(worst, errors, strict=True)]
    end = float(np.mean([run.system.times[-1] for run in worst]))
    label, when = context.signals[0][j], float(np.median(times))
    text = (
        f"In the {counted(len(worst), 'worst trial')}, S differs from M most in {label}: by {percent(float(peaks[j]))} "
        f"of its range at the peak, which is at {number(when, 3)} s of {number(end, 3)} s."
    )
    shares = _shares(context, worst)
    numbers = {"state": label, "peak": float(peaks[j]), "time": when, "shares": shares}
    if shares:
        largest = sorted(shares.items(), key=lambda item: -item[1])[:3]
        listed = " and ".join(f"{percent(share)} is in {name}" for name, share in largest)
        text += f" Of the error that the distance measures, {listed}."
    return Finding("What errs, and when", "note", text, numbers)


def _shares(context: ReportContext, worst: list[Recording]) -> dict[str, float]:
    """Return the shares of the states in the error that the distance is composed of; empty if they are not known."""
    validation = context.validation
    distance = None if validation is None else validation.distance
    if validation is None or not isinstance(distance, ComposedDistance) or not hasattr(distance, "components"):
        return {}
    compared = distance.components
    labels = context.signals[0]
    names = labels if compared is None else [labels[i] for i in compared]
    tasks = [context.replays[k].task for k in list(context.recordings)[:_WORST] if k in context.replays]
    errors = np.array([distance.error(run.model, run.system, task) for run, task in zip(worst, tasks, strict=False)])
    if errors.ndim != 2 or errors.shape[1] != len(names) or not np.abs(errors).sum() > 0:
        return {}
    sizes = np.abs(errors).mean(axis=0)
    return {name: float(size) for name, size in zip(names, sizes / sizes.sum(), strict=True)}


def flips(context: ReportContext) -> Finding | None:
    """Whether the controllers of neighbouring tasks differ abruptly."""
    if len(context.recordings) < 2:
        return None
    by_number = {trial.number: trial for trial in context.completed}
    numbers = list(context.recordings)
    points = np.array([by_number[k].unit_point for k in numbers])
    found = soundness.flips(points, [run.model.inputs for run in context.recordings.values()])
    if found is None or not found.flipped:
        return None
    i, j = found.example
    values = {"neighbours": found.pairs, "flipped": found.flipped, "largest_change": found.largest}
    text = (
        f"{found.flipped} of {found.pairs} pairs of neighbouring tasks have controllers that differ abruptly, for "
        f"example trials {numbers[i]} and {numbers[j]}: their inputs on M differ by {percent(found.largest)} of the "
        "range of the inputs. A planner that jumps between solutions makes the distance jump, too."
    )
    return Finding("Controllers of neighbouring tasks", "attention", text, values)


def unusual_motion(context: ReportContext) -> Finding | None:
    """Whether M itself makes an unusual motion in the worst trials, such as turning over."""
    if len(context.recordings) < 4:
        return None
    sizes = np.array(
        [np.abs(run.model.states - run.model.states[0]).max(axis=0) for run in context.recordings.values()]
    )
    usual = np.maximum(np.median(sizes, axis=0), 1e-3 * sizes.max(axis=0) + 1e-300)
    ratios = sizes[:_WORST] / usual
    row, j = (int(k) for k in np.unravel_index(int(ratios.argmax()), ratios.shape))
    trial, label, ratio = list(context.recordings)[row], context.signals[0][j], float(ratios[row, j])
    values = {"trial": trial, "state": label, "times_the_median": ratio}
    # A state of M is unusual if it is this many times as large as in the median trial.
    if ratio < 3.0:
        return None
    text = (
        f"In trial {trial} M itself moves {number(float(sizes[row, j]))} in {label}, {number(ratio, 2)} times as far "
        "as in the median trial: the controller asks for an unusual motion, which may explain the distance better "
        "than an error of M."
    )
    return Finding("Motion of M", "attention", text, values)


def saturation(context: ReportContext) -> Finding | None:
    """Whether inputs stay at their limits."""
    synthesizer = None if context.validation is None else context.validation.synthesizer
    found = soundness.saturation([run.system.inputs for run in context.recordings.values()], synthesizer)
    if found is None or found.shares.max() < soundness.SATURATED:
        return None
    share, known = found.shares, found.known
    j = int(share.argmax())
    label = context.signals[1][j]
    values = {"input": label, "share_of_steps": float(share[j]), "limits_known": known}
    text = f"{label} is at its limit in {percent(float(share[j]))} of all steps" + (
        "." if known else " (the limits are taken from the records, in which the extreme value repeats)."
    )
    return Finding("Inputs and their limits", "attention", text, values)


def converged(context: ReportContext) -> Finding | None:
    """Whether the designs of the controllers converged, and whether controllers jump."""
    if context.designs is None:
        return None
    return Finding("Design of the controllers", "attention", f"{context.designs[0].upper()}{context.designs[1:]}.")


def goals(context: ReportContext) -> Finding | None:
    """Whether M itself reaches its goals under the controllers that are designed on it."""
    if context.validation is None:
        return Finding("Goals of M", "unknown", "Not known: it needs the experiment, which is not loaded.")
    if not context.replays:
        return None
    if not any(replay.task.has_goal for replay in context.replays.values()):
        return None
    numbers = list(context.replays)
    on_model = [context.recordings[k].model for k in numbers]
    found = soundness.goal_misses(context.validation, on_model, [context.replays[k].task.goal for k in numbers])
    if found is None or not found.missed.any():
        return None
    missed, (row, j) = found.missed, found.worst
    label, size = context.signals[0][int(found.states[j])], float(found.misses[row, j])
    values = {"missed": int(missed.sum()), "trials": len(numbers), "largest_miss": size, "state": label}
    text = (
        f"In {int(missed.sum())} of {len(numbers)} trials M ends farther than {percent(soundness.MISSED)} of the range "
        f"of a weighted state from its goal; it misses most in {label}, by {number(size)}, in trial {numbers[row]}. A "
        "controller that fails on M cannot be expected to work on S."
    )
    return Finding("Goals of M", "attention", text, values)
