"""Whether an envelope can be stated, and how far executed distances exceeded what was predicted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctxval.certificates.drawn_distances import FLOOR
from ctxval.certificates.dynamics_diagnostics import (
    PREDICTIONS,
    agrees,
    counted,
    missing_tests,
    tested,
    unlearned,
    untried_parameter,
)
from ctxval.certificates.dynamics_evidence import CheckedPrediction, DynamicsEvidence
from ctxval.certificates.prediction_tests import DRAWN


def rises_of(evidence: DynamicsEvidence, threshold: float) -> list[tuple[float, CheckedPrediction]]:
    """Return the standardised excesses of predictions that count over what was predicted, with the predictions.

    These are the tests that count and the last other predictions. A prediction counts only if the task or its
    prediction is below the threshold: nothing is claimed of the others.
    """
    drawn = [test for test in tested(evidence.predictions, evidence.tests) if test.origin in DRAWN]
    last = {each.trial: each for each in [*drawn, *counted(evidence, threshold)[-PREDICTIONS:]]}.values()
    rises = []
    for each in last:
        if min(each.distance, each.median) <= threshold:
            spread = (each.upper - each.median) / 1.645  # the 0.95 quantile of a normal distribution
            rise = each.excess / max(spread, 2 * FLOOR * threshold) if np.isfinite(each.upper) else 0.0
            rises.append((rise, each))
    return rises


def doubt_of_envelope(evidence: DynamicsEvidence, threshold: float) -> str | None:
    """Return why no envelope can be stated, and what would help; None if one can."""
    # Tasks that cannot be planned are no part of the envelope.
    for doubt in (*unlearned(replace(evidence, unplanned=0.0), threshold), untried_parameter(evidence)):
        if doubt is not None:
            return doubt
    for test in evidence.predictions:
        known = test.explained  # smaller differences raise the factor of the envelope
        if known is None or test.is_noisy or agrees(test.distance, known, threshold):
            continue
        if known <= threshold < test.distance:
            return (
                f"trial {test.trial} has the distance {test.distance:.4g}, and {known:.4g} on the learned dynamics, "
                "which is below the threshold: the next state is no function of what is recorded, or the dynamics "
                "depend on the task; record more states"
            )
    missing = missing_tests(evidence.predictions, evidence.tests)
    if missing:
        return (
            f"{missing} more {'execution' if missing == 1 else 'executions'} must be predicted beforehand, at tasks "
            "drawn over the whole task space (`ctxval run --envelope` executes them)"
        )
    return None
