"""The three-valued answer: may M be trusted up to a threshold?"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ctxval._util.representation import call, line, lines, shown
from ctxval.certificates import (
    RESOLUTION,
    Certificate,
    Forecast,
    Maxima,
    Sample,
    certify_posterior,
    forecast,
    require_resolution,
    settle_maxima,
)
from ctxval.certificates.base import at_most, require_probability, with_error
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Change, Trial
from ctxval.errors import CertificateError, InputError

Answer = Literal["validated", "falsified", "undecided"]

CONFIDENCE = 0.95
"""Of a validation, unless said otherwise."""

LEAST_CONFIDENCE = 0.5
"""Below it a statement is wrong as often as right."""

MOST_VOLUME = 0.5
"""Above it a statement leaves out most of what it is about."""

_NAMED = 3
"""Task parameters whose resolution is told one by one."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the trials say about d* <= tau.

    Attributes:
        answer: falsified is an executed fact, validated a statement with a confidence, undecided the rest.
        threshold: tau.
        reason: one sentence.
        witness: the executed trial with d(p) > tau, if falsified.
        certificate: what validates, or failed to.
        expected: what is expected of further executions, if undecided and it can be told.
        rests_on: one sentence on what must hold for it, if validated.
    """

    answer: Answer
    threshold: float
    reason: str
    witness: Trial | None = None
    certificate: Certificate | None = None
    expected: Forecast | None = None
    rests_on: str | None = None

    def __str__(self) -> str:
        return f"{self.answer}: {self.reason}"

    def __repr__(self) -> str:
        found = {"witness": self.witness, "certificate": self.certificate, "expected": self.expected}
        rows = [f"{name}: {shown(part)}" for name, part in found.items() if part is not None]
        return lines(call(self, self.answer, threshold=self.threshold), f"reason: {line(self.reason)}", *rows)


def remarks_on(changes: Iterable[Change]) -> tuple[str, ...]:
    """Return sentences on what was changed in a store after it was written, for a certificate's assumptions."""
    found = []
    for change in changes:
        if change.what == "accepted":
            different = "; ".join(change.content.get("differences", [])[:1]) or "nothing that is described"
            found.append(
                f"what was changed after {change.content.get('trials', 'some')} trials makes no difference to them, as "
                f"you state: {change.why!r} ({different})"
            )
        elif change.what == "remeasured":
            found.append(f"the distances are those measured anew: {change.why!r}")
    return tuple(found)


def require_threshold(threshold: float) -> float:
    """Return a threshold tau.

    Raises:
        InputError: it is not a positive number.
    """
    if not isinstance(threshold, int | float) or not threshold > 0 or threshold == float("inf"):
        raise InputError(f"the threshold must be a positive number, got {threshold!r}.")
    return float(threshold)


def require_confidence(confidence: float) -> float:
    """Return the confidence of a verdict.

    Raises:
        CertificateError: it is no probability.
        InputError: it is below 0.5.
    """
    if require_probability("the confidence", confidence) < LEAST_CONFIDENCE:
        raise InputError(
            f"a verdict with confidence {confidence:g} would be wrong more often than right; state at least "
            f"{LEAST_CONFIDENCE:g}, and {CONFIDENCE:g} is usual."
        )
    return float(confidence)


def require_volume(volume: float) -> float:
    """Return the share of the task space that may exceed a threshold.

    Raises:
        InputError: it is negative, or above 0.5.
    """
    if not 0 <= volume <= MOST_VOLUME:
        raise InputError(
            f"the volume must be a share of the task space from 0 to {MOST_VOLUME:g}, got {volume!r}: more would leave "
            "out most of the tasks."
        )
    return float(volume)


def counterexample(trials: Sequence[Trial], threshold: float) -> Verdict | None:
    """Return the verdict that an executed distance above the threshold makes, None where there is none.

    Raises:
        InputError: the threshold is not a positive number.
    """
    tau = require_threshold(threshold)
    above = [trial for trial in trials if trial.distance is not None and trial.distance > tau]
    if not above:
        return None
    worst = max(above, key=lambda trial: trial.distance or 0.0)
    distance, limit = _told_apart(worst.distance or 0.0, tau)
    reason = f"trial {worst.number} was executed and its distance {distance} exceeds {limit}."
    return Verdict("falsified", tau, reason, worst)


def _told_apart(value: float, tau: float) -> tuple[str, str]:
    """Return two numbers as texts of as many digits as tell which one is larger."""
    for digits in range(4, 17):
        texts = at_most(value, digits) if value <= tau else f"{value:.{digits}g}", f"{tau:.{max(digits, 6)}g}"
        if np.sign(float(texts[0]) - float(texts[1])) == np.sign(value - tau):
            return texts
    return repr(value), repr(tau)


def judge_by(
    certificate: Certificate,
    trials: Sequence[Trial],
    threshold: float,
    *,
    volume: float = 0.0,
    space: TaskSpace | None = None,
) -> Verdict:
    """Return the verdict of the trials and a certificate.

    Args:
        certificate: of any kind.
        trials: all of them.
        threshold: tau.
        volume: the share of the task space that may exceed the threshold; 0 accepts bounds on d* alone.
        space: the tasks, to tell a resolution in their units.

    Raises:
        InputError: the threshold is not a positive number, the volume is above 0.5, or the certificate's confidence is
            below 0.5.
    """
    tau = require_threshold(threshold)
    require_confidence(certificate.confidence)
    found = counterexample(trials, tau)
    if found is not None:
        return Verdict("falsified", tau, found.reason, found.witness, certificate)
    if certificate.covers(tau, require_volume(volume)):
        but = f", but for {at_most(100 * certificate.volume, 3)} % of the task space" if certificate.volume else ""
        upper, limit = _bound_and_limit(certificate, tau)
        reason = (
            f"the {certificate.kind} bound of {certificate.trials} trials is {upper}, at most {limit}, with confidence "
            f"{certificate.confidence}{but}{_unusual_resolution(certificate, space)}."
        )
        return Verdict("validated", tau, reason, certificate=certificate, rests_on=_rests_on(certificate, space))
    return Verdict("undecided", tau, _why_not(certificate, tau, volume), certificate=certificate)


def _bound_and_limit(certificate: Certificate, tau: float) -> tuple[str, str]:
    """Return a bound and the threshold as texts, the bound with its error if it has one."""
    upper = with_error(certificate.upper_bound, certificate.error)
    return (upper, f"{tau:.6g}") if "±" in upper else _told_apart(certificate.upper_bound, tau)


def _why_not(certificate: Certificate, tau: float, volume: float) -> str:
    if certificate.doubt is not None:
        return f"{certificate.doubt}."
    upper, limit = _bound_and_limit(certificate, tau)
    if certificate.upper_bound > tau:
        return f"no distance above {limit} was executed, but d* may be up to {upper}."
    if not certificate.covers(tau, certificate.volume):
        return (
            f"the {certificate.kind} bound is {upper}, and {limit} is too near to it for the random draws that it is "
            "computed from; more executions tighten it."
        )
    missing = certificate.details.get("not_counted")
    why = f"; {missing} draws do not count, as their number was changed after they were known" if missing else ""
    return (
        f"the {certificate.kind} bound of {certificate.trials} trials leaves out "
        f"{at_most(100 * certificate.volume, 3)} % of the task space, more than the {100 * volume:.3g} % that are "
        f"acceptable{why}; it is no bound on d*."
    )


def _unusual_resolution(certificate: Certificate, space: TaskSpace | None) -> str:
    """Return what a verdict says of a resolution that is not the usual one."""
    resolution = certificate.details.get("resolution")
    if resolution is None or resolution["diagonals"] == RESOLUTION:
        return ""
    diagonals = f"{resolution['diagonals']:g} diagonals; usual: {RESOLUTION:g}"
    if resolution["of_each_range"] >= 1:
        return f", whole regions without a trial taken to be like the rest ({diagonals})"
    return f", to a resolution of {_lengths(resolution, space)}, {_share(resolution)} of the task space ({diagonals})"


def _lengths(resolution: dict[str, float], space: TaskSpace | None) -> str:
    """Return a resolution in the units of the task parameters, if they are few and known."""
    share = resolution["of_each_range"]
    if space is None or space.dimension > _NAMED:
        return f"{share:.2g} of each parameter's range"
    return " and ".join(
        f"{share * width:.2g} {space.units[name.partition('[')[0]]}".rstrip() + f" in {name}"
        for name, width in zip(space.names, space.high - space.low, strict=True)
    )


def _share(resolution: dict[str, float]) -> str:
    percent = 100 * resolution["of_the_space"]
    return f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"


def _rests_on(certificate: Certificate, space: TaskSpace | None) -> str:
    """Return what a validation rests on, in one sentence."""
    if certificate.kind == "posterior":
        said = _of_the_distance(certificate.details, space)
    elif certificate.volume:
        said = [
            "tasks that were drawn independently, and from which M was not learned (how large the distance is in the "
            f"{at_most(100 * certificate.volume, 3)} % that are left out is not known)"
        ]
    else:
        said = ["the theorem's assumptions, with the constants that you stated"]
    made_good = certificate.details.get("failures", {}).get("made_good", [])
    if made_good:
        numbers = ", ".join(str(one["trial"]) for one in made_good)
        said.append(f"your word that what made trial {numbers} fail is removed for good")
    return f"It rests on {'; on '.join([*said, 'this campaign not being chosen among several'])}."


def _of_the_distance(details: dict[str, Any], space: TaskSpace | None) -> list[str]:
    """Return what the posterior bound needs of the distance."""
    resolution = details.get("resolution")
    smooth = "the distance being as smooth between the trials as at them, also in regions without any trial"
    if resolution is not None and resolution["of_each_range"] < 1:
        smooth = (
            f"the distance being as smooth between the trials as at them, to a resolution of "
            f"{_lengths(resolution, space)} (a peak inside a gap of that radius, {_share(resolution)} of the task "
            "space, may be missed)"
        )
    if details.get("stochastic"):
        return [
            smooth,
            "the noise that you declared being normal and alike everywhere (it is the expected distance that is "
            "bounded: single executions may exceed it)",
        ]
    return [smooth, "each task having one distance, however often it is executed"]


def judge(
    trials: Sequence[Trial],
    threshold: float,
    confidence: float = CONFIDENCE,
    *,
    stochastic: bool = False,
    resolution: float = RESOLUTION,
    space: TaskSpace | None = None,
    remarks: Sequence[str] = (),
) -> Verdict:
    """Return the verdict by an executed counterexample or the posterior bound; undecided says what more would take.

    Args:
        trials: all of them.
        threshold: tau, in the distance's units.
        confidence: of a validation, at least 0.5.
        stochastic: whether two executions of one task may differ.
        resolution: how far from every trial a task may be, in diagonals of the task space.
        space: the tasks, to tell the resolution in their units.
        remarks: sentences that the certificate lists among its assumptions, such as what was changed on the system.

    Raises:
        InputError: the threshold is not a positive number, or the confidence is below 0.5.
        CertificateError: the confidence is not a probability, or the resolution not positive.
    """
    require_confidence(confidence)
    require_resolution(resolution)
    found = counterexample(trials, threshold)
    if found is not None:
        return found
    try:
        sample = Sample.of(trials)
        drawn = settle_maxima(sample, threshold, confidence, stochastic=stochastic)
        certificate = certify_posterior(sample, confidence, stochastic=stochastic, resolution=resolution, found=drawn)
    except CertificateError as error:
        return Verdict("undecided", threshold, str(error))
    verdict = judge_by(certificate.with_remarks(remarks), trials, threshold, space=space)
    return verdict if verdict.answer == "validated" else _with_forecast(verdict, sample, drawn, confidence)


def _with_forecast(verdict: Verdict, sample: Sample, drawn: Maxima, confidence: float) -> Verdict:
    certificate = verdict.certificate
    if certificate is not None and (certificate.doubt is not None or certificate.upper_bound <= verdict.threshold):
        return verdict  # futures of a process that the trials speak against say nothing, nor does a bound that is kept
    expected = forecast(sample, drawn, verdict.threshold, confidence)
    reason = f"{verdict.reason.removesuffix('.')}; {expected}."
    return Verdict("undecided", verdict.threshold, reason, certificate=verdict.certificate, expected=expected)
