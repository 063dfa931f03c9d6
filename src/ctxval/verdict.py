"""The three-valued answer: may M be trusted up to a threshold?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctxval.arrays import Array
from ctxval.certificates import (
    RESOLUTION,
    Certificate,
    Forecast,
    Maxima,
    Sample,
    certify_posterior,
    covering,
    draw_maxima,
    forecast,
    instantaneous_bound,
    require_resolution,
)
from ctxval.certificates.base import at_most, require_probability
from ctxval.errors import CertificateError, InputError
from ctxval.trial import Trial

_GLANCES = ((8, 0.3), (32, 0.05))
"""Draws of d* that tell whether all of them are worth their cost, and by how much their probability may be wrong."""

Answer = Literal["validated", "falsified", "undecided"]

CONFIDENCE = 0.95
"""Of a validation, unless said otherwise."""


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
    """

    answer: Answer
    threshold: float
    reason: str
    witness: Trial | None = None
    certificate: Certificate | None = None
    expected: Forecast | None = None

    def __str__(self) -> str:
        return f"{self.answer}: {self.reason}"


def require_threshold(threshold: float) -> float:
    """Return a threshold tau.

    Raises:
        InputError: it is not a positive number.
    """
    if not isinstance(threshold, int | float) or not threshold > 0 or threshold == float("inf"):
        raise InputError(f"the threshold must be a positive number, got {threshold!r}.")
    return float(threshold)


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


def judge_by(certificate: Certificate, trials: Sequence[Trial], threshold: float, *, volume: float = 0.0) -> Verdict:
    """Return the verdict of the trials and a certificate.

    Args:
        certificate: of any kind.
        trials: all of them.
        threshold: tau.
        volume: the share of the task space that may exceed the threshold; 0 accepts bounds on d* alone.

    Raises:
        InputError: the threshold is not a positive number.
    """
    tau = require_threshold(threshold)
    found = counterexample(trials, tau)
    if found is not None:
        return Verdict("falsified", tau, found.reason, found.witness, certificate)
    if certificate.covers(tau, volume):
        but = f", but for {at_most(100 * certificate.volume, 3)} % of the task space" if certificate.volume else ""
        upper, limit = _told_apart(certificate.upper_bound, tau)
        reason = (
            f"the {certificate.kind} bound of {certificate.trials} trials is {upper}, at most {limit}, with confidence "
            f"{certificate.confidence}{but}."
        )
        return Verdict("validated", tau, reason, certificate=certificate)
    return Verdict("undecided", tau, _why_not(certificate, tau, volume), certificate=certificate)


def _why_not(certificate: Certificate, tau: float, volume: float) -> str:
    if certificate.doubt is not None:
        return f"{certificate.doubt}."
    if certificate.upper_bound > tau:
        upper, limit = _told_apart(certificate.upper_bound, tau)
        return f"no distance above {limit} was executed, but d* may be up to {upper}."
    return (
        f"the {certificate.kind} bound leaves out {at_most(100 * certificate.volume, 3)} % of the task space, "
        f"more than the {100 * volume:.3g} % that are acceptable; it is no bound on d*."
    )


def judge(
    trials: Sequence[Trial],
    threshold: float,
    confidence: float = CONFIDENCE,
    *,
    stochastic: bool = False,
    resolution: float = RESOLUTION,
) -> Verdict:
    """Return the verdict by an executed counterexample or the posterior bound; undecided says what more would take.

    Args:
        trials: all of them.
        threshold: tau, in the distance's units.
        confidence: of a validation.
        stochastic: whether two executions of one task may differ.
        resolution: how far from every trial a task may be, in diagonals of the task space.

    Raises:
        InputError: the threshold is not a positive number.
        CertificateError: the confidence is not a probability, or the resolution not positive.
    """
    require_probability("confidence", confidence)
    require_resolution(resolution)
    found = counterexample(trials, threshold)
    if found is not None:
        return found
    try:
        sample = Sample.of(trials)
        drawn = draw_maxima(sample, stochastic=stochastic)
        certificate = certify_posterior(sample, confidence, stochastic=stochastic, resolution=resolution, found=drawn)
    except CertificateError as error:
        return Verdict("undecided", threshold, str(error))
    verdict = judge_by(certificate, trials, threshold)
    return verdict if verdict.answer == "validated" else _with_forecast(verdict, sample, drawn, confidence)


def _with_forecast(verdict: Verdict, sample: Sample, drawn: Maxima, confidence: float) -> Verdict:
    if verdict.certificate is not None and verdict.certificate.doubt is not None:
        return verdict  # futures of a process that the trials speak against say nothing
    expected = forecast(sample, drawn, verdict.threshold, confidence)
    reason = f"{verdict.reason.removesuffix('.')}; {expected}."
    return Verdict("undecided", verdict.threshold, reason, certificate=verdict.certificate, expected=expected)


@dataclass(frozen=True, eq=False)
class Standing:
    """How far a campaign is from its verdict.

    Attributes:
        decided: whether it is reached, or will be if what is being executed shows nothing new.
        uncovered: the point of the unit cube ``(d,)`` to execute where the bound keeps the threshold, and only tasks
            that nothing came near to stand in the way.
    """

    decided: bool = False
    uncovered: Array | None = None


def standing(
    trials: Sequence[Trial],
    threshold: float,
    left: int,
    confidence: float = CONFIDENCE,
    *,
    stochastic: bool = False,
    resolution: float = RESOLUTION,
) -> Standing:
    """Return whether the verdict is reached, for less than it costs where it is far away, and what else is missing.

    Args:
        trials: all of them; what is open is not waited for.
        threshold: tau, in the distance's units.
        left: how many more executions there can be.
        confidence, stochastic, resolution: as of :func:`judge`.

    Raises:
        InputError: the threshold is not a positive number.
        CertificateError: the confidence is not a probability, or the resolution not positive.
    """
    require_probability("confidence", confidence)
    require_resolution(resolution)
    if counterexample(trials, threshold) is not None:
        return Standing(decided=True)
    try:
        sample = Sample.of([trial for trial in trials if trial.state != "open"])
        missing = covering(np.array([trial.unit_point for trial in trials]), resolution, left)
        if missing is None or _surely_too_high(sample, threshold, confidence, stochastic):
            return Standing()
        if len(missing):
            return Standing(uncovered=missing[0])
        # The open trials count as near to their tasks, so coverage is no doubt here any more.
        certificate = certify_posterior(sample, confidence, stochastic=stochastic, resolution=1.0)
        return Standing(decided=certificate.covers(threshold))
    except CertificateError:
        return Standing()


def _surely_too_high(sample: Sample, threshold: float, confidence: float, stochastic: bool) -> bool:
    """Return whether the posterior bound is above the threshold, by what costs less and nearly always tells."""
    instantaneous = None if stochastic else instantaneous_bound(sample)
    if instantaneous is not None and instantaneous["max_ucb"] > threshold:
        return True
    return any(
        draw_maxima(sample, draws=draws, stochastic=stochastic).probability(threshold) < confidence - margin
        for draws, margin in _GLANCES
    )
