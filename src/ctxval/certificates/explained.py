r"""Whether the law that all executions teach explains every one of them, and what they say for a threshold.

An execution has p-values under this law: of its distance, and of statistics of its trajectory. Each kind makes an
e-process over all executions, which never begins anew: the mean over shares s and levels l of

.. math:: \prod_k \left(1 - s + s\,\frac{[p_k \le l]}{l}\right),

bets that a share s of the executions has p-values of at most l (Vovk and Wang 2021). Few executions that noise does not
explain are found among many that it does.

For the threshold tau, the law is compared with the hypothesis that a share 1 - q of the executions exceeds tau, by the
likelihood ratio ``(1 - pi_k) / q`` of each execution that stays below and ``pi_k / (1 - q)`` of each that exceeds,
where pi_k, at most 1 - q, is the chance of an excess under the law. Executions that are far below tau by prediction
tell nothing of it and do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.certificates.limits import LIMITS
from ctxval.core.quantiles import chance_of_more

_SHARES = (0.05, 0.1, 0.2, 0.4)
_LEVELS = (0.005, 0.02, 0.1)


@dataclass(frozen=True)
class ExplainedExecution(ShortRepr):
    """An execution beside the law that all executions teach."""

    trial: int  #: the number of the trial
    point: tuple[float, ...]  #: the task, a point of the unit cube ``(d,)``
    distance: float  #: the executed distance
    expected: float  #: the distance on the posterior mean, with noise its median; infinity if the loop diverges
    quantiles: tuple[float, ...] = ()  #: those of the distance at ``quantiles.LEVELS``; empty without noise
    runs: int = 0  #: the number of distances that these are of
    p_values: tuple[float, ...] = ()  #: of statistics of the trajectory; empty without noise

    def chance_of_more(self, distance: float) -> float:
        """Return the probability that an execution of the task exceeds a distance; it is never 0."""
        return chance_of_more(self.quantiles, distance, self.runs)

    @property
    def p_value(self) -> float:
        """The probability of a distance as large as the executed one."""
        return self.chance_of_more(self.distance)


def evidence_against(executions: Sequence[ExplainedExecution]) -> float:
    """Return the e-value of all noisy executions against the law: half by distances, half by trajectories."""
    known = [each for each in executions if each.quantiles]
    if not known:
        return 1.0
    kinds = np.array([[each.p_value, *each.p_values] for each in known]).T
    values = [_e_value(p) for p in kinds]
    return float(0.5 * values[0] + 0.5 * np.mean(values[1:] or values))


def _e_value(p: Array) -> float:
    bets = [np.prod(1 - share + share * (p <= level) / level) for share, level in product(_SHARES, _LEVELS)]
    return float(np.mean(bets))


def least_explained(executions: Sequence[ExplainedExecution]) -> ExplainedExecution | None:
    """Return the noisy execution with the smallest p-value; None if there is none."""
    known = [each for each in executions if each.quantiles]
    return min(known, key=lambda each: min(each.p_value, *each.p_values), default=None)


def support_of(executions: Sequence[ExplainedExecution], level: float, bound: float, quantile: float) -> float:
    """Return the likelihood ratio of the law against the hypothesis that a share ``1 - quantile`` exceeds a level."""
    ratio = 1.0
    for each in executions:
        if not each.quantiles or (each.distance <= level and each.expected < LIMITS.leverage * bound):
            continue
        chance = min(each.chance_of_more(level), 1 - quantile)
        ratio *= chance / (1 - quantile) if each.distance > level else (1 - chance) / quantile
    return ratio


def share_supported(executions: int, above: int, confidence: float) -> float:
    """Return the share that stays below with the confidence if some of independent executions are above.

    It is the bound of Clopper and Pearson (1934): 29 executions support 90 %, and 14 support 81 %.
    """
    if above >= executions:
        return 0.0
    return float(scipy.special.betaincinv(executions - above, above + 1, 1 - confidence))
