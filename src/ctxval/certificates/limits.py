"""The limits of the checks that withdraw a bound from learned dynamics, each with its unit and its reason.

They were chosen on development systems; docs/calibration.md reports them on others. Shares are fractions, not percents.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ctxval.core.coverage import UntestedRest


@dataclass(frozen=True)
class CheckLimits:
    """Numbers that decide whether a prediction held and whether a check is passed."""

    # Enough executions
    fewest: int = 3  #: executions for a bound: the data that M was made from are no executions of its controllers
    noisy_fewest: int = 5  #: the same for a noisy system, of which one execution tells less
    predictions: int = 3  #: last predictions that must have held: those that could have failed test the prior
    failing: int = 6  #: last predictions of which at least half must hold, or the dynamics cannot be learned

    # Whether a prediction held
    error: float = 0.05  #: largest error of a prediction, as a share of the bound or of the test's own distance
    small: float = 0.1  #: least predicted distance, as a share of the bound, by which the error of a test is judged
    usual: float = 4.0  #: multiple of the median error of drawn tests up to which an error is usual
    tolerated: float = 0.02  #: share of the bound by which a noisy distance may exceed its prediction
    unlikely: float = 0.01  #: least predicted probability of a noisy distance as large as the executed one
    vague: float = 2.0  #: multiple of the largest executed distance that makes the 0.95 quantile of a test vague

    # The learned residual
    noise: float = 0.01  #: learned variance of noise, as a share of the mean square of the residual
    e_value: float = 20.0  #: evidence of the last noisy predictions against the noise; true noise exceeds it in 1 of 20
    e_value_of: int = 6  #: number of these predictions
    left_out: float = 0.5  #: share of the posterior variance that a draw leaves out between its pivots

    # What the records cover
    gap: float = 0.25  #: gap of the records in a state, an input or an idle parameter, as a share of the visited range
    pair_gap: float = 0.5  #: the same for two coordinates together
    beyond: float = 0.02  #: excess over the records, as a share of their range: contacts and saturation lie there
    noisy_beyond: float = 0.06  #: the same for a noisy system: noise leads a little beyond a few records
    diverged: float = 10.0  #: share of the visited range from which on predicted runs are said to diverge
    corner: float = 0.05  #: distance of the nearest executed task from a corner of a position, as a share of its ranges
    region: float = 0.125  #: radius of a region that predicted runs enter and no execution has, as a share of the range

    # Tests where distances are large
    tested: float = 0.8  #: least share of the largest predicted distance that must have been executed
    noisy_tested: float = 0.75  #: the same, of the median draw, whose noise is that of all executions
    matters: float = 0.3  #: least distance, as a share of the bound, at which a prediction must have held

    # What the final law must explain
    contradicted: float = 5.0  #: e-value of all executions against the noise; true noise exceeds it in 1 of 100
    leverage: float = 0.5  #: least predicted share of the bound from which an execution tells of the threshold
    drifting: float = 0.005  #: p-value below which effects of executions change with their order or with a parameter
    rest_gap: float = UntestedRest.MOST  #: stretch without a test of friction at rest, as a share
    uneven: float = 1.5  #: ratio of a force that a joint at rest withstood to one that moved it elsewhere
    supported: float = 1.0  #: least likelihood ratio of the noise against a share of executions above the threshold

    # The law of the distances of a suite
    freedom: int = 8  #: executions beyond the number of its coefficients: with fewer, its tails are too long to bound

    # Remedies
    near: float = 0.7  #: share of the way from the largest distance to the threshold from which a draw is near it
    repetitions: int = 0  #: executions of a task that are chosen because one execution does not explain it
    noisy_repetitions: int = 4  #: the same for a noisy system; of others, another execution is the same

    # Whether a search can find the maximum
    peak_ratio: float = 0.05  #: share by which a maximum may exceed the median of nearly the same tasks
    jump: float = 0.01  #: jump of the predicted distance between nearly equal tasks, as a share of the bound
    low_dimensional: int = 2  #: task parameters up to which intensified searches find maxima in spite of jumps
    agree: float = 0.05  #: share by which intensified searches may differ, and exceed the usual search

    def of_noise(self) -> Self:
        """Return the limits of a noisy system, whose noise has none, and of which repetitions tell something."""
        fewest, beyond, tested = self.noisy_fewest, self.noisy_beyond, self.noisy_tested
        return replace(
            self, fewest=fewest, beyond=beyond, tested=tested, noise=np.inf, repetitions=self.noisy_repetitions
        )


LIMITS = CheckLimits()
"""The limits in use."""
