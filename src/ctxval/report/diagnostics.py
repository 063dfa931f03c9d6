"""Diagnostics of a verdict: what would speak against it, each with a light, and what was not tested."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial import KDTree

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr, counted
from ctxval._util.texts import reason_of
from ctxval.campaign.dynamics import PREDICTION
from ctxval.certificates import RESOLUTION
from ctxval.certificates.bounds import at_most, of_tasks
from ctxval.certificates.covering import bare_corners, farthest_task
from ctxval.certificates.dynamics_diagnostics import ACCURATE, agrees
from ctxval.core.trial import Trial
from ctxval.learning import ExecutionPrediction
from ctxval.report.context import ReportContext, distance_of
from ctxval.report.markup import number, percent, quantity

Light = Literal["good", "note", "attention", "bad", "unknown"]
"""A traffic light: nothing speaks against M or the verdict; neither good nor bad; read it; it speaks against it; it is
not known."""

# The word of each light stands beside its colour.
WORDS: dict[Light, str] = {
    **{"good": "good", "note": "note", "attention": "attention"},
    **{"bad": "problem", "unknown": "not known"},
}


@dataclass(frozen=True)
class Finding(ShortRepr):
    """One thing that the trials show.

    Attributes:
        name: what it is about, in a few words.
        light: how it is to be taken.
        text: one or more sentences with the numbers.
        numbers: the same numbers for JSON, by name.
    """

    name: str
    light: Light
    text: str
    numbers: dict[str, Any] = field(default_factory=dict)

    def unless(self, doubt: str | None) -> Finding:
        """Return this finding, which is not good if there is a doubt about what it concludes."""
        if self.light != "good" or doubt is None:
            return self
        text = f"{self.text} But {doubt}: tasks between the executed ones may be unlike them."
        return replace(self, light="attention", text=text)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes, ready for JSON."""
        return vars(self)


Question = Callable[[ReportContext], Finding | None]
"""A function that looks for one thing; it returns None if there is nothing to say."""


def findings_of(questions: Iterable[tuple[str, Question]], context: ReportContext) -> list[Finding]:
    """Return what questions find; a question that fails is a finding that is not known."""
    findings: list[Finding | None] = []
    for name, question in questions:
        try:
            findings.append(question(context))
        except Exception as error:  # one question about odd data must not hide the answers to the others
            findings.append(Finding(name, "unknown", f"This could not be computed: {reason_of(error)}."))
    return [finding for finding in findings if finding is not None]


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
    return None if context.executions else Finding("Executions", "unknown", "Nothing was executed.", numbers)


def _certificate(context: ReportContext) -> Finding | None:
    verdict, certificate = context.verdict, context.certificate
    if verdict is None or verdict.answer == "falsified":
        return None
    if certificate is None:
        return Finding("Certificate", "bad", f"Refused: {verdict.reason}")
    if certificate.doubt is None:
        return None
    bound = certificate.upper_bound if np.isfinite(certificate.upper_bound) else None
    numbers = {"kind": certificate.kind, "upper_bound": bound, "confidence": certificate.confidence}
    return Finding("Certificate", "bad", f"Withdrawn: {certificate.doubt}.", numbers)


def _rests_on_distances(context: ReportContext) -> bool:
    """Return whether the answer depends on where the tasks lie: not a counterexample, not a bound from dynamics."""
    verdict, certificate = context.verdict, context.certificate
    if verdict is None or verdict.answer == "falsified" or certificate is None:
        return verdict is None
    return certificate.kind != "dynamics" or certificate.doubt is not None


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
    """Return the share of the tasks that are farther than a resolution from every trial."""
    d = points.shape[1]
    gaps, _ = KDTree(points).query(np.random.default_rng(0).random((4096, d)))
    return float(np.mean(gaps / np.sqrt(d) > resolution))


def _converged(context: ReportContext) -> Finding | None:
    distances = context.distances
    if len(distances) < 2 or not _rests_on_distances(context):
        return None
    so_far = np.maximum.accumulate(distances)
    last = int(np.argmax(so_far >= 0.99 * so_far[-1]))
    quiet = len(distances) - 1 - last
    good = quiet >= max(3.0, len(distances) / 3)
    text = (
        f"The largest distance was within 1 % of its final value after {last + 1} of {len(distances)} measured "
        f"executions; {quiet} followed without an improvement."
    )
    return Finding("Search converged", "good" if good else "attention", text, {"last": last + 1, "after": quiet})


def _smooth(context: ReportContext) -> Finding | None:
    model = context.distance_model
    if model is None or not _rests_on_distances(context):
        return None
    size = model.calibration
    light: Light = "good" if 0.5 <= size <= 1.5 else "attention" if size <= 2.5 else "bad"
    text = (
        "A Gaussian process of the distance predicts each trial from the others with errors of "
        f"{number(size, 2)} of its own standard deviations (root mean square; about 1 is expected)."
    )
    return Finding("Distance is smooth over the tasks", light, text, {"standardised_error": size}).unless(
        context.designs
    )


def stored_predictions(context: ReportContext) -> list[tuple[Trial, ExecutionPrediction]]:
    """Return the trials whose execution was predicted beforehand, with the predictions."""
    notes = [(trial, (trial.note or {}).get(PREDICTION)) for trial in context.completed]
    read = [(trial, ExecutionPrediction.from_json(note)) for trial, note in notes if isinstance(note, dict)]
    return [(trial, prediction) for trial, prediction in read if prediction is not None]


def _predictions(context: ReportContext) -> Finding | None:
    predicted = stored_predictions(context)
    if not predicted:
        return None
    size = max(float(context.distances.max()), context.bound or 0.0)
    held = sum(agrees(distance_of(trial), one.median, size) for trial, one in predicted)
    text = (
        f"{held} of {counted(len(predicted), 'execution')} that were predicted beforehand came out within "
        f"{quantity(ACCURATE * size, context.labels.units)} of the prediction, which is {percent(ACCURATE)} of the "
        "largest distance or of the bound."
    )
    light: Light = "good" if held == len(predicted) else "attention"
    return Finding("Predictions made beforehand", light, text, {"made": len(predicted), "held": held})


def _states_covered(context: ReportContext) -> Finding | None:
    certificate = context.certificate
    if certificate is None or "beyond_the_records" not in certificate.details:
        return None
    gap, beyond = certificate.details["coverage_gap"], certificate.details["beyond_the_records"]
    text = (
        f"The closed loops of the tasks leave the recorded range of a state or an input by {percent(beyond)} of it or "
        f"less, and are never farther than {percent(gap)} of it from every record."
    )
    light: Light = "good" if certificate.doubt is None else "attention"
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
        share, d = share_far_from_trials(context.points), context.space.dimension
        if share:
            sentences.append(
                f"{percent(share)} of the task space is farther than {RESOLUTION:g} diagonals from every trial; there "
                "the distance is inferred and not executed."
            )
        bare = len(bare_corners(context.points, RESOLUTION))
        where = "ends of the range" if d == 1 else "corners of the task space"
        if bare:
            sentences.append(f"{bare} of the {2**d} {where} have no trial next to them.")
    for trial in context.failed[:10]:
        values = zip(context.space.labels, context.coordinates([trial])[0], strict=True)
        where = ", ".join(f"{label} = {number(value)}" for label, value in values)
        ended = "failed" if trial.state == "failed" else "could not be measured"
        sentences.append(f"The distance at the task of trial {trial.number} ({where}), because it {ended}.")
    if len(context.failed) > 10:
        sentences.append(f"The distances of {len(context.failed) - 10} more trials that failed or were not measured.")
    sentences.append(
        "Tasks outside the task space, other controllers, and conditions that the recorded state does not hold, such "
        "as wear, temperature or payload."
    )
    return sentences
