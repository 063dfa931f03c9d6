"""Findings: what the trials show, each a sentence with its numbers and a light, which all outputs of a report share.

The diagnostics are those that would speak against the verdict; ``report/insights.py`` has the others.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import scipy

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr, counted
from ctxval._util.texts import enumerated, reason_of
from ctxval.campaign.dynamics import prediction_in
from ctxval.certificates import RESOLUTION
from ctxval.certificates.bounds import at_most, of_tasks
from ctxval.certificates.covering import bare_corners, farthest_task
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.predictions import agrees
from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TaskSuite
from ctxval.core.trial import Trial, Trials
from ctxval.learning import ExecutionPrediction
from ctxval.report.distance_model import distance_of
from ctxval.report.markup import number, percent, quantity

if TYPE_CHECKING:
    from ctxval.report.context import ReportContext

Light = Literal["good", "note", "attention", "bad", "unknown"]
"""A traffic light: nothing speaks against M or the verdict; neither good nor bad; read it; it speaks against it; it is
not known."""

# The word of each light stands beside its colour.
WORDS: dict[Light, str] = {light: light for light in get_args(Light)} | {"bad": "problem", "unknown": "not known"}


@dataclass(frozen=True)
class Finding(ShortRepr):
    """One thing that the trials show."""

    name: str  #: what it is about, in a few words
    light: Light  #: how it is to be taken
    text: str  #: one or more sentences with the numbers
    numbers: dict[str, Any] = field(default_factory=dict)  #: the same numbers for JSON, by name


Answer = tuple[Light, str, dict[str, Any]]
"""The light, the text and the numbers of a finding."""

Question = Callable[["ReportContext"], Answer | None]
"""A function that looks for one thing; it returns None if there is nothing to say."""


def findings_of(context: ReportContext, questions: Mapping[str, Question]) -> list[Finding]:
    """Return what questions find. One that fails is not known, because odd data must not hide the other answers."""
    findings = list[Finding]()
    for name, question in questions.items():
        try:
            answer = question(context)
        except Exception as error:
            answer = "unknown", f"This could not be computed: {reason_of(error)}.", {}
        if answer is not None:
            findings.append(Finding(name, *answer))
    return findings


# Diagnostics


def executions(context: ReportContext) -> Answer | None:
    """Whether executions have no distance, or are open."""
    trials = Trials(context.trials)
    failed, unmeasured, waiting = (trials.in_state(state).numbers for state in ("failed", "unmeasured", "open"))
    numbers = {"executions": context.executions, "failed": failed, "unmeasured": unmeasured, "open": waiting}
    if context.failed:
        text = f"{len(context.failed)} of {len(trials)} trials have no distance: nothing is known of d at their tasks."
        return "bad", text, numbers
    if waiting:
        text = f"Trials are open and wait for their results: {', '.join(map(str, waiting))}."
        return "attention", text, numbers
    return None if context.executions else ("unknown", "Nothing was executed.", numbers)


def certificate_stands(context: ReportContext) -> Answer | None:
    """Whether the certificate is refused or withdrawn."""
    verdict, certificate = context.verdict, context.certificate
    if verdict is None or verdict.answer == "falsified" or (certificate is not None and certificate.doubt is None):
        return None
    if certificate is None:
        return "bad", f"Refused: {verdict.reason}", {}
    bound = certificate.upper_bound if np.isfinite(certificate.upper_bound) else None
    numbers = {"kind": certificate.kind, "upper_bound": bound, "confidence": certificate.confidence}
    return "bad", f"Withdrawn: {certificate.doubt}.", numbers


def _rests_on_distances(context: ReportContext) -> bool:
    """Return whether the answer depends on where the tasks lie: not a counterexample, not a bound from dynamics."""
    verdict, certificate = context.verdict, context.certificate
    if verdict is None or verdict.answer == "falsified" or certificate is None:
        return verdict is None
    return certificate.kind != "dynamics" or certificate.doubt is not None


def tasks_covered(context: ReportContext) -> Answer | None:
    """How far tasks are from every trial."""
    return _covered(context.space, context)


@functools.singledispatch
def _covered(space: TaskSpace, context: ReportContext) -> Answer | None:
    if not len(context.points) or not _rests_on_distances(context):
        return None
    farthest, share = farthest_task(context.points), share_far_from_trials(context.points)
    near = farthest <= RESOLUTION
    text = (
        f"The task farthest from every trial is {number(farthest, 2)} diagonals of the task space away, "
        f"{'within' if near else 'more than'} the resolution of {RESOLUTION:g}; "
        f"{percent(share)} of the tasks are farther than that from every trial."
    )
    return "good" if near else "attention", text, {"farthest": farthest, "share_beyond_resolution": share}


@_covered.register(TaskSuite)
def _(space: TaskSuite, context: ReportContext) -> Answer:
    executed, tasks = int((space.executions(context.points) > 0).sum()), len(space)
    text = f"{executed} of the {tasks} tasks of the suite were executed."
    return "good" if executed == tasks else "attention", text, {"executed": executed, "tasks": tasks}


def share_far_from_trials(points: Array) -> float:
    """Return the share of the tasks that are farther than the resolution from every trial."""
    d = points.shape[1]
    gaps, _ = scipy.spatial.KDTree(points).query(np.random.default_rng(0).random((4096, d)))
    return float(np.mean(gaps / np.sqrt(d) > RESOLUTION))


def search_converged(context: ReportContext) -> Answer | None:
    """Whether many executions followed without a larger distance."""
    distances = context.distances
    if len(distances) < 2 or not _rests_on_distances(context):
        return None
    last = int(np.argmax(distances >= 0.99 * distances.max()))
    quiet = len(distances) - 1 - last
    text = (
        f"The largest distance was within 1 % of its final value after {last + 1} of {len(distances)} measured "
        f"executions; {quiet} followed without an improvement."
    )
    good = quiet >= max(3.0, len(distances) / 3)
    return "good" if good else "attention", text, {"last": last + 1, "after": quiet}


def smooth(context: ReportContext) -> Answer | None:
    """Whether a Gaussian process predicts each distance from the others."""
    model = context.distance_model
    if model is None or not _rests_on_distances(context):
        return None
    size = model.calibration
    light: Light = "good" if 0.5 <= size <= 1.5 else "attention" if size <= 2.5 else "bad"
    text = (
        "A Gaussian process of the distance predicts each trial from the others with errors of "
        f"{number(size, 2)} of its own standard deviations (root mean square; about 1 is expected)."
    )
    if light == "good" and context.designs is not None:
        light, text = "attention", f"{text} But {context.designs}: tasks between the executed ones may be unlike them."
    return light, text, {"standardised_error": size}


def stored_predictions(context: ReportContext) -> list[tuple[Trial, ExecutionPrediction]]:
    """Return the trials whose execution was predicted beforehand, with the predictions."""
    read = [(trial, prediction_in(trial.note)) for trial in context.completed]
    return [(trial, prediction) for trial, prediction in read if prediction is not None]


def predictions_held(context: ReportContext) -> Answer | None:
    """Whether executions came out as they had been predicted."""
    predicted = stored_predictions(context)
    if not predicted:
        return None
    size = max(float(context.distances.max()), context.bound or 0.0)
    held = sum(agrees(distance_of(trial), prediction.median, size) for trial, prediction in predicted)
    made, within = len(predicted), quantity(LIMITS.error * size, context.labels.units)
    text = (
        f"{held} of {counted(made, 'execution')} that were predicted beforehand came out within {within} of the "
        f"prediction, which is {percent(LIMITS.error)} of the largest distance or of the bound."
    )
    return "good" if held == made else "attention", text, {"made": made, "held": held}


def states_covered(context: ReportContext) -> Answer | None:
    """How far the closed loops leave the recorded states and inputs."""
    certificate = context.certificate
    if certificate is None or "beyond_the_records" not in certificate.details:
        return None
    gap, beyond = certificate.details["coverage_gap"], certificate.details["beyond_the_records"]
    text = (
        f"The closed loops of the tasks leave the recorded range of a state or an input by {percent(beyond)} of it or "
        f"less, and are never farther than {percent(gap)} of it from every record."
    )
    return "good" if certificate.doubt is None else "attention", text, {"beyond": beyond, "gap": gap}


DIAGNOSTICS: dict[str, Question] = {
    "Executions": executions,
    "Certificate": certificate_stands,
    "Tasks covered": tasks_covered,
    "Search converged": search_converged,
    "Distance is smooth over the tasks": smooth,
    "Predictions made beforehand": predictions_held,
    "States and inputs covered": states_covered,
}


@functools.singledispatch
def _without_trials(space: TaskSpace, points: Array) -> list[str]:
    if not len(points):
        return []
    share, d, sentences = share_far_from_trials(points), space.dimension, list[str]()
    if share:
        far = f"{percent(share)} of the task space is farther than {RESOLUTION:g} diagonals from every trial"
        sentences.append(f"{far}; there the distance is inferred and not executed.")
    if bare := len(bare_corners(points, RESOLUTION)):
        where = "ends of the range" if d == 1 else "corners of the task space"
        sentences.append(f"{bare} of the {2**d} {where} have no trial next to them.")
    return sentences


@_without_trials.register(TaskSuite)
def _(space: TaskSuite, points: Array) -> list[str]:
    names = [space.task_names[row] for row in np.flatnonzero(space.executions(points) == 0)]
    return [f"Tasks of the suite without a distance: {enumerated(names, 20)}."] if names else []


def not_tested(context: ReportContext) -> list[str]:
    """Return what was not tested, one sentence each."""
    sentences, certificate = list[str](), context.certificate
    if certificate is not None and certificate.volume:
        left_out = at_most(100 * certificate.volume, 3)
        sentences.append(f"The certificate leaves out {left_out} % {of_tasks(certificate.distribution)}.")
    sentences += _without_trials(context.space, context.points)
    for trial in context.failed[:10]:
        values = zip(context.task_labels, context.tasks_of([trial])[0], strict=True)
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
