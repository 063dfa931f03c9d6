r"""A region bound: the distance is at most a prediction plus a margin q, but for a share of the tasks.

Let d_hat be a prediction of the distance that is fixed before N independent tasks are drawn, and let q be the
(k+1)-th largest of d(p_i) - d_hat(p_i). The scenario bound holds for any function of the task, so also for the excess
d - d_hat: with V = Pr(d(p) > d_hat(p) + q),

    Pr(V > eps) <= sum_{i=0}^{k} binom(N, i) eps^i (1 - eps)^(N - i).

A task whose distance is not known, or cannot be predicted, has an infinite excess. Split conformal prediction computes
the same margin (Vovk 2012, "training-conditional" validity; Campi and Garatti 2011 for k > 0).

The tasks with d_hat(p) + q <= tau are a map of where tau is kept. Its share is estimated from predicted tasks, which
need no execution: of M tasks, j lie outside the map, and the Clopper-Pearson bound of their share is the same function
of M, j and the confidence. The volume above tau is at most eps and this bound together.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import NonNegativeInt, PositiveInt, Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.bounds import at_most, of_tasks
from ctxval.certificates.sample import Sample, advice_to_remeasure, require_learned
from ctxval.certificates.scenario import countable_draws, require_more, volume_bound
from ctxval.certificates.sentences.statements import ABOUT_DRAWS, FROZEN, ONE_CAMPAIGN, how_drawn, margin_and_map
from ctxval.core.trial import Origin
from ctxval.errors import CertificateError

_OF_MAP = 0.05
"""Share of beta for the volume of the map; the rest is for the draws. Predictions cost no execution, draws do."""


@part("region")
@dataclass(frozen=True, repr=False)
class Region(CertificateKind):
    """Bound on the distance by a prediction and a margin, but for a share of the tasks; a map of where tau is kept."""

    name: ClassVar[str] = "region"
    bounds_maximum: ClassVar[bool] = False
    uses_threshold: ClassVar[bool] = True
    needs_model: ClassVar[bool] = True
    sorts_draws: ClassVar[bool] = True

    #: how many of the largest excesses are discarded; it must be chosen before the draws are known
    discard: NonNegativeInt = 0
    #: number M of tasks that are predicted to estimate the share of the tasks that keep the threshold
    predictions: PositiveInt = 1000

    @checked
    def certify(self, sample: Sample, confidence: Probability = 0.95) -> Certificate:
        """Bound the distance by a prediction plus a margin from independent draws, but for a share of the tasks.

        With a threshold, the bound is the threshold, and the volume left out is that of the draws plus that of the
        tasks at which the prediction plus the margin exceeds the threshold. Without one, the bound is the largest
        predicted one.

        More draws than are discarded must have a distance and a prediction; else a CertificateError is raised.
        """
        threshold = sample.threshold
        beta = 1 - confidence
        learned, drawn = require_learned(sample, "region"), countable_draws(sample, "a region bound")
        before = min(drawn.numbers)  # the prediction is learned from the trials before the draws
        margin, unpredicted = _margin(drawn, learned.expected(drawn.points, before), before, self.discard)
        volume = volume_bound(len(drawn), self.discard, (1 - _OF_MAP) * beta)
        bounds = learned.expected(learned.tasks(self.predictions, before), before) + margin
        count, unknown = len(bounds), int(np.isnan(bounds).sum())
        limit = float(bounds[~np.isnan(bounds)].max(initial=-np.inf)) if threshold is None else float(threshold)
        outside = int((~(bounds <= limit)).sum())
        if outside == count:
            outside_volume = 1.0
        elif threshold is not None:
            outside_volume = volume_bound(count, outside, _OF_MAP * beta)
        else:
            # The tasks without a prediction, and those above the largest of the others, which the draws did not fix.
            half = _OF_MAP * beta / 2
            outside_volume = volume_bound(count, unknown, half) + volume_bound(count - unknown, 0, half)
        total, share = min(1.0, volume + outside_volume), 1 - outside / count
        smoothed = (outside + 1) / (count + 2)  # one more task on either side, so that the error is never zero
        error = float(np.sqrt(smoothed * (1 - smoothed) / count))
        kept = f"this prediction is at most {at_most(limit)} on each of {count} predicted tasks that it covers"
        if threshold is not None:
            tasks = f"{100 * share:.4g} ± {at_most(100 * error, 2)} % {of_tasks(sample.distribution)}"
            kept = f"this prediction keeps {limit:.6g} on {tasks} (an estimate from {count} predicted tasks)"
        return Certificate(
            kind=self.name,
            statement=margin_and_map(sample, margin, volume, total, confidence, at_most(limit), kept),
            upper_bound=limit,
            confidence=confidence,
            volume=total,
            trials=len(drawn),
            assumptions=(
                *how_drawn(sample, drawn),
                "the number discarded was chosen before the draws were known",
                FROZEN,
                *ABOUT_DRAWS,
                *sample.remarks,
                ONE_CAMPAIGN,
            ),
            details={
                "margin": margin,
                "discarded": self.discard,
                "volume_of_draws": volume,
                "learned_before": before,
                "predictions": count,
                "share_kept": share,
                "share_error": error,
                "unpredicted_draws": unpredicted,
                "unpredicted_tasks": unknown,
                "largest_drawn": drawn.best if np.isfinite(drawn.best) else None,
                "not_counted": len(sample.only("iid")) - len(drawn),
                "failed": sample.failed,
                "failures": sample.failures,
            },
            distribution=sample.distribution,
        )

    def require_usable(self, confidence: float, executions: int, beside: Iterable[Origin] = ()) -> None:
        """Require more trials than are discarded."""
        require_more(executions, self.discard, "draws")


def _margin(drawn: Sample, predicted: Array, before: int, discard: int) -> tuple[float, int]:
    """Return q, the (k+1)-th largest excess d - d_hat of draws, and how many of them cannot be predicted."""
    if np.isnan(predicted).all():
        raise CertificateError(
            f"nothing can be predicted from the trials before trial {before}, the first of these draws: execute tasks "
            "of a search before the audit, or say --kind audit, which needs no prediction."
        )
    require_more(len(drawn), discard, "draws")
    excess = np.sort(np.nan_to_num(drawn.distances - predicted, nan=np.inf))
    unpredicted = int((np.isnan(predicted) & ~np.isnan(drawn.distances)).sum())
    if not np.isfinite(excess[-1 - discard]):
        raise CertificateError(
            f"{drawn.failed} of {len(drawn)} draws have no distance and {unpredicted} have no prediction, more than "
            f"the {discard} discarded; nothing bounds the distance there.{advice_to_remeasure(drawn)}"
        )
    return float(excess[-1 - discard]), unpredicted
