"""Insights on the distance over the tasks: where M is weak, how biased it is, and whether dynamics explain it."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import counted
from ctxval.report.context import ReportContext, distance_of
from ctxval.report.findings import Finding
from ctxval.report.markup import number, percent, quantity


def weak_region(context: ReportContext) -> Finding | None:
    """Where the distance exceeds the threshold, executed and predicted."""
    tau, units = context.threshold, context.labels.units
    if tau is None or not len(context.distances):
        return None
    above = context.distances > tau
    largest = quantity(float(context.distances.max()), units)
    model = context.distance_model
    share = 0.0 if model is None else float((model.over_tasks.median > tau).mean())
    numbers = {"executed_above": int(above.sum()), "executed": len(above), "predicted_share_above": share}
    if not above.any():
        text = f"No executed task exceeds {quantity(tau, units)}, but the trials predict that {percent(share)} do."
        return Finding("Where M is weak", "attention", text, numbers) if share else None
    # Below this share of weak tasks the random tasks hold too few of them, and the executed ones describe the region.
    weak = context.points[above] if model is None or share < 0.002 else model.tasks[model.over_tasks.median > tau]
    text = (
        f"{int(above.sum())} of {len(above)} executed tasks exceed {quantity(tau, units)}, the largest with {largest}: "
        f"{region_text(context, weak)}. The trials predict that {percent(share)} of all tasks exceed it."
    )
    return Finding("Where M is weak", "bad", text, numbers)


def region_text(context: ReportContext, points: Array) -> str:
    """Return where points of the unit cube ``(m, d)`` lie, by the parameters in which they differ from all tasks."""
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    width = high - low
    # At most three parameters describe a region: those in which it is clearly narrower than their ranges.
    narrow = [int(j) for j in np.argsort(width) if width[j] < 0.7][:3]
    if not narrow:
        return "they are spread over the task space"
    ends = context.space.from_unit(np.stack([low, high]))
    parts = []
    for j in narrow:
        first, last = number(ends[0, j], 3), number(ends[1, j], 3)
        between = f"at {first}" if first == last else f"from {first} to {last}"
        parts.append(f"{context.space.labels[j]} {between}")
    return f"most of them have {' and '.join(parts)}"


def weak_states(context: ReportContext) -> Finding | None:
    """Which states and inputs the system visits where M is weak, and not elsewhere."""
    if len(context.recordings) < 4:
        return None
    # Recordings above the threshold are weak, or else the quarter with the largest distances.
    by_number, tau = {trial.number: distance_of(trial) for trial in context.completed}, context.threshold
    weak = np.array([by_number[number] for number in context.recordings]) > (np.inf if tau is None else tau)
    which = "above the threshold"
    if not weak.any() or weak.all():
        weak, which = np.arange(len(weak)) < max(1, len(weak) // 4), "with the largest distances"
    runs = [recording.system for recording in context.recordings.values()]
    low, high = (
        np.array([np.concatenate([end(run.states, axis=0), end(run.inputs, axis=0)]) for run in runs])
        for end in (np.min, np.max)
    )
    inside_low, inside_high = low[~weak].min(axis=0), high[~weak].max(axis=0)
    span = np.maximum(high.max(axis=0) - low.min(axis=0), 1e-300)
    beyond = np.maximum(high[weak].max(axis=0) - inside_high, inside_low - low[weak].min(axis=0)) / span
    j = int(beyond.argmax())
    label = [label for labels in context.signals for label in labels][j]
    numbers = {"signal": label, "beyond": float(beyond[j])}
    if beyond[j] < 0.05:
        return None
    text = (
        f"{counted(int(weak.sum()), 'trial')} {which}: {label} goes from {number(low[weak, j].min())} to "
        f"{number(high[weak, j].max())}; all others stay within {number(inside_low[j])} and {number(inside_high[j])}."
    )
    return Finding("States visited there", "note", text, numbers)


def bias(context: ReportContext) -> Finding | None:
    """How the distance of a typical task compares with the largest one, and whether S errs to one side of M."""
    model = context.distance_model
    if model is None or not context.distances.max() > 0:
        return None
    typical = float(np.mean(model.over_tasks.median))
    share = typical / float(context.distances.max())
    text = (
        f"The mean distance over all tasks is predicted to be {quantity(typical, context.labels.units)}, "
        f"{percent(share)} of the largest executed one: "
        + ("M errs nearly everywhere." if share > 0.6 else "M errs in a part of the tasks." if share > 0.2 else
           "M errs in few tasks.")
    )  # fmt: skip
    numbers = {"mean_distance": typical, "share_of_largest": share}
    if len(context.recordings) >= 4:
        # The state with the largest final error, and the share of trials whose error has the usual sign.
        ends = np.array([recording.system.final_state for recording in context.recordings.values()])
        errors = ends - np.array([recording.model.final_state for recording in context.recordings.values()])
        j = int((np.abs(errors) / np.maximum(np.ptp(ends, axis=0), 1e-300)).mean(axis=0).argmax())
        label, same = context.signals[0][j], float(max((errors[:, j] > 0).mean(), (errors[:, j] < 0).mean()))
        text += (
            f" At the end of the executed tasks S lies on the same side of M in {label} in {percent(same, 3)} of the "
            "trials" + (", so the error is systematic." if same > 0.9 else ".")
        )
        numbers |= {"one_sided_share": same}
    return Finding("Bias across the tasks", "note", text, numbers)


def explained(context: ReportContext) -> Finding | None:
    """Whether the corrected model, learned from the other trials, predicts the distance."""
    if context.validation is None:
        return Finding("Corrected model", "unknown", "Not known: it needs the experiment, which is not loaded.")
    by_number = {trial.number: distance_of(trial) for trial in context.completed}
    pairs = [(by_number[k], replay.distance) for k, replay in context.replays.items() if np.isfinite(replay.distance)]
    if len(pairs) < 2:
        return Finding("Corrected model", "unknown", "Not known: the trials do not teach a correction of M.")
    executed, predicted = np.array(pairs).T
    size = float(np.sqrt((executed**2).mean()))
    error = float(np.sqrt(((executed - predicted) ** 2).mean()))
    share = 1 - error / max(size, 1e-300)
    numbers = {"share_explained": share, "error": error, "trials": len(pairs)}
    said = (
        f"M with a residual that is learned from the other trials predicts the distances of {len(pairs)} trials with "
        f"an error of {quantity(error, context.labels.units)} (root mean square), "
        f"{percent(error / max(size, 1e-300))} of the distances."
    )
    # Least share of the distance that a corrected model must predict to explain it.
    if share >= 0.8:
        return Finding(
            "Corrected model", "good",
            f"{said} It explains the distance: the difference is a function of the recorded state and input, and a "
            "model that is fitted to these data can remove it.", numbers,
        )  # fmt: skip
    return Finding(
        "Corrected model", "attention",
        f"{said} It does not explain the distance: a state that is not recorded, a contact, dry friction or noise is "
        "the likely cause, or too few trials.", numbers,
    )  # fmt: skip
