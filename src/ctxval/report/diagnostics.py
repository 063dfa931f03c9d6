"""Diagnostics of a verdict: what would speak against it, each with a light, and what was not tested."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from ctxval._util.arrays import Array
from ctxval._util.representation import counted
from ctxval.campaign.dynamics import PREDICTION
from ctxval.certificates import RESOLUTION
from ctxval.certificates.bounds import at_most, of_tasks
from ctxval.certificates.covering import bare_corners, farthest_task
from ctxval.certificates.dynamics_diagnostics import ACCURATE, agrees
from ctxval.core.trial import Trial
from ctxval.learning import ExecutionPrediction
from ctxval.report.context import ReportContext, distance_of
from ctxval.report.findings import Finding, Light, Question, findings_of
from ctxval.report.markup import number, percent, quantity

_IMPROVED = 0.01
"""Least increase of the largest distance that counts as an improvement, as a share of it."""

_CALIBRATED, _ROUGH = (0.5, 1.5), 2.5
"""Range of the root mean square of standardised errors that is as expected, and the value above which it is not."""


def diagnostics(context: ReportContext) -> list[Finding]:
    """Return the diagnostics of a campaign, each with a light."""
    return findings_of(_QUESTIONS, context)


def _executions(context: ReportContext) -> Finding | None:
    states = ("failed", "unmeasured", "open")
    listed = {state: [trial.number for trial in context.trials if trial.state == state] for state in states}
    numbers = {"executions": context.executions, **listed}
    without = len(listed["failed"]) + len(listed["unmeasured"])
    if without:
        text = f"{without} of {len(context.trials)} trials have no distance: nothing is known of d at their tasks."
        return Finding("Executions", "bad", text, numbers)
    if listed["open"]:
        waiting = ", ".join(map(str, listed["open"]))
        return Finding("Executions", "attention", f"Trials are open and wait for their results: {waiting}.", numbers)
    if not context.executions:
        return Finding("Executions", "unknown", "Nothing was executed.", numbers)
    return None


def _certificate(context: ReportContext) -> Finding | None:
    verdict, found = context.verdict, context.certificate
    if verdict is None or verdict.answer == "falsified":
        return None
    if found is None:
        return Finding("Certificate", "bad", f"Refused: {verdict.reason}")
    if found.doubt is None:
        return None
    bound = float(found.upper_bound) if np.isfinite(found.upper_bound) else None
    numbers = {"kind": found.kind, "upper_bound": bound, "confidence": found.confidence}
    return Finding("Certificate", "bad", f"Withdrawn: {found.doubt}.", numbers)


def _rests_on_distances(context: ReportContext) -> bool:
    """Return whether the answer depends on where the tasks lie: not a counterexample, not a bound from dynamics."""
    verdict, found = context.verdict, context.certificate
    if verdict is None:
        return True
    return verdict.answer != "falsified" and found is not None and (found.kind != "dynamics" or found.doubt is not None)


def _covering(context: ReportContext) -> Finding | None:
    if not len(context.points) or not _rests_on_distances(context):
        return None
    farthest = farthest_task(context.points)
    share = share_far_from_trials(context.points)
    near = farthest <= RESOLUTION
    text = (
        f"The task farthest from every trial is {number(farthest, 2)} diagonals of the task space away, "
        f"{'within' if near else 'more than'} the resolution of {RESOLUTION:g}; "
        f"{percent(share)} of the tasks are farther than that from every trial."
    )
    light: Light = "good" if near else "attention"
    return Finding("Tasks covered", light, text, {"farthest": farthest, "share_beyond_resolution": share})


def share_far_from_trials(points: Array, resolution: float = RESOLUTION) -> float:
    """Return the share of the tasks farther than a resolution, in diagonals, from all of the points ``(n, d)``."""
    d = points.shape[1]
    gaps, _ = KDTree(points).query(np.random.default_rng(0).random((4096, d)))
    return float(np.mean(gaps / np.sqrt(d) > resolution))


def _converged(context: ReportContext) -> Finding | None:
    distances = context.distances
    if len(distances) < 2 or not _rests_on_distances(context):
        return None
    so_far = np.maximum.accumulate(distances)
    last = int(np.argmax(so_far >= (1 - _IMPROVED) * so_far[-1]))
    quiet = len(distances) - 1 - last
    # Share of the executions without an improvement after which a search is taken to have converged.
    good = quiet >= max(3.0, (1 / 3) * len(distances))
    text = (
        f"The largest distance was within {percent(_IMPROVED)} of its final value after {last + 1} of "
        f"{len(distances)} measured executions; {quiet} followed without an improvement."
    )
    return Finding("Search converged", "good" if good else "attention", text, {"last": last + 1, "after": quiet})


def _smooth(context: ReportContext) -> Finding | None:
    model = context.distance_model
    if model is None or not _rests_on_distances(context):
        return None
    size = model.calibration
    light: Light = "good" if _CALIBRATED[0] <= size <= _CALIBRATED[1] else "attention" if size <= _ROUGH else "bad"
    text = (
        "A Gaussian process of the distance predicts each trial from the others with errors of "
        f"{number(size, 2)} of its own standard deviations (root mean square; about 1 is expected)."
    )
    found = Finding("Distance is smooth over the tasks", light, text, {"standardised_error": size})
    return found.unless(context.designs)


def stored_predictions(context: ReportContext) -> list[tuple[Trial, ExecutionPrediction]]:
    """Return the trials whose execution was predicted beforehand, with the predictions."""
    noted = [(trial, (trial.note or {}).get(PREDICTION)) for trial in context.completed]
    read = [(trial, ExecutionPrediction.from_json(note)) for trial, note in noted if isinstance(note, dict)]
    return [(trial, path) for trial, path in read if path is not None]


def _predictions(context: ReportContext) -> Finding | None:
    found = stored_predictions(context)
    if not found:
        return None
    size = max(float(context.distances.max()), context.bound or 0.0)
    held = sum(agrees(distance_of(trial), one.median, size) for trial, one in found)
    text = (
        f"{held} of {counted(len(found), 'execution')} that were predicted beforehand came out within "
        f"{quantity(ACCURATE * size, context.labels.units)} of the prediction, which is {percent(ACCURATE)} of the "
        "largest distance or of the bound."
    )
    light: Light = "good" if held == len(found) else "attention"
    return Finding("Predictions made beforehand", light, text, {"made": len(found), "held": held})


def _states_covered(context: ReportContext) -> Finding | None:
    found = context.certificate
    if found is None or "beyond_the_records" not in found.details:
        return None
    gap, beyond = found.details["coverage_gap"], found.details["beyond_the_records"]
    text = (
        f"The closed loops of the tasks leave the recorded range of a state or an input by {percent(beyond)} of it or "
        f"less, and are never farther than {percent(gap)} of it from every record."
    )
    light: Light = "good" if found.doubt is None else "attention"
    return Finding("States and inputs covered", light, text, {"beyond": beyond, "gap": gap})


_QUESTIONS: tuple[tuple[str, Question], ...] = (
    ("Executions", _executions),
    ("Certificate", _certificate),
    ("Tasks covered", _covering),
    ("Search converged", _converged),
    ("Distance is smooth over the tasks", _smooth),
    ("Predictions made beforehand", _predictions),
    ("States and inputs covered", _states_covered),
)


def not_tested(context: ReportContext) -> list[str]:
    """Return what was not tested, one sentence each."""
    sentences = []
    certificate = context.certificate
    if certificate is not None and certificate.volume:
        left_out = at_most(100 * certificate.volume, 3)
        sentences.append(f"The certificate leaves out {left_out} % {of_tasks(certificate.distribution)}.")
    if len(context.points):
        share = share_far_from_trials(context.points)
        if share:
            sentences.append(
                f"{percent(share)} of the task space is farther than {RESOLUTION:g} diagonals from every trial; there "
                "the distance is inferred and not executed."
            )
        bare, d = len(bare_corners(context.points, RESOLUTION)), context.space.dimension
        if bare:
            where = "ends of the range" if d == 1 else "corners of the task space"
            sentences.append(f"{bare} of the {2**d} {where} have no trial next to them.")
    for trial in context.failed[:10]:
        where = ", ".join(
            f"{label} = {number(value)}"
            for label, value in zip(context.space.labels, context.coordinates([trial])[0], strict=True)
        )
        ended = "failed" if trial.state == "failed" else "could not be measured"
        sentences.append(f"The distance at the task of trial {trial.number} ({where}), because it {ended}.")
    if len(context.failed) > 10:
        sentences.append(f"The distances of {len(context.failed) - 10} more trials that failed or were not measured.")
    sentences.append(
        "Tasks outside the task space, other controllers, and conditions that the recorded state does not hold, such "
        "as wear, temperature or payload."
    )
    return sentences
