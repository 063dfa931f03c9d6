"""How far a campaign is from its verdict, and which task must be executed before it may be validated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval.certificates import (
    RESOLUTION,
    Maxima,
    Sample,
    certify_posterior,
    covering,
    draw_maxima,
    instantaneous_bound,
    most_contested,
    require_resolution,
    settle_maxima,
)
from ctxval.certificates.verdict import CONFIDENCE, counterexample, require_confidence
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError

_GLANCES = ((8, 0.3), (32, 0.05))
"""Draws of d* that tell whether all of them are worth their cost, and by how much their probability may be wrong."""

_TESTS = 2
"""Executions where the highest draws of d* are, after which the bound must still keep the threshold: they mostly find
what made it too low (docs/calibration.md)."""


@dataclass(frozen=True, eq=False)
class Standing:
    """How far a campaign is from its verdict.

    Attributes:
        decided: whether it is reached, or will be if what is being executed shows nothing new.
        uncovered: the point of the unit cube ``(d,)`` to execute where the bound keeps the threshold: a task that
            nothing came near to, then where the highest draws of d* are, so as to put the bound to the test.
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
        confidence, stochastic, resolution: as of :func:`ctxval.certificates.verdict.judge`.

    Raises:
        InputError: the threshold is not a positive number, or the confidence is below 0.5.
        CertificateError: the confidence is not a probability, or the resolution not positive.
    """
    require_confidence(confidence)
    require_resolution(resolution)
    if counterexample(trials, threshold) is not None:
        return Standing(decided=True)
    try:
        sample = Sample.of([trial for trial in trials if trial.state != "open"])
        points = np.array([trial.unit_point for trial in trials])
        missing = covering(points, resolution, left)
        if missing is None or _surely_too_high(sample, threshold, confidence, stochastic):
            return Standing()
        if len(missing):
            return Standing(uncovered=missing[0])
        # The open trials count as near to their tasks, so coverage is no doubt here any more.
        drawn, kept = _is_kept(sample, threshold, confidence, stochastic)
        if not kept:
            return Standing()
        contested = None
        if left and not _has_stood(trials[:-_TESTS], threshold, confidence, stochastic, resolution):
            highest = drawn.points[-max(1, round((1 - confidence) * len(drawn.points))) :]
            contested = most_contested(highest, points, resolution)
        return Standing(decided=contested is None, uncovered=contested)
    except CertificateError:
        return Standing()


def _has_stood(
    trials: Sequence[Trial], threshold: float, confidence: float, stochastic: bool, resolution: float
) -> bool:
    """Return whether the bound of the trials before the last ones kept the threshold already, near to every task."""
    if not trials or covering(np.array([trial.unit_point for trial in trials]), resolution, 0) is None:
        return False
    try:
        sample = Sample.of([trial for trial in trials if trial.state != "open"])
        return _is_kept(sample, threshold, confidence, stochastic)[1]
    except CertificateError:
        return False


def _is_kept(sample: Sample, threshold: float, confidence: float, stochastic: bool) -> tuple[Maxima, bool]:
    """Return draws of d*, and whether the bound keeps the threshold wherever the trials came near to."""
    drawn = settle_maxima(sample, threshold, confidence, stochastic=stochastic)
    certificate = certify_posterior(sample, confidence, stochastic=stochastic, resolution=1.0, found=drawn)
    return drawn, certificate.covers(threshold)


def _surely_too_high(sample: Sample, threshold: float, confidence: float, stochastic: bool) -> bool:
    """Return whether the posterior bound is above the threshold, by what costs less and nearly always tells."""
    instantaneous = None if stochastic else instantaneous_bound(sample)
    if instantaneous is not None and instantaneous["max_ucb"] > threshold:
        return True
    return any(
        draw_maxima(sample, draws=draws, stochastic=stochastic).probability(threshold) < confidence - margin
        for draws, margin in _GLANCES
    )
