"""The stopping rule of a campaign that runs until its verdict, and the tasks that it executes before it stops.

A campaign does not stop as soon as the upper bound on d* keeps the threshold. It first executes tasks that are far
from all trials, then tasks at which the largest draws of d* lie. docs/calibration.md states how often the verdict is
wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import NonNegativeInt, PositiveFloat, checked
from ctxval._util.representation import ShortRepr
from ctxval.certificates.covering import RESOLUTION, covering, most_contested
from ctxval.certificates.maxima import Maxima, draw_maxima, settle_maxima
from ctxval.certificates.options import CONFIDENCE, Confidence
from ctxval.certificates.posterior import DistanceBound, instantaneous_bound
from ctxval.certificates.sample import Sample
from ctxval.certificates.verdict import counterexample
from ctxval.core.trial import Trial, Trials
from ctxval.errors import CertificateError


@dataclass(frozen=True, eq=False)
class StoppingDecision(ShortRepr):
    """Whether a campaign stops, and the next task that the rule asks for."""

    decided: bool = False  #: whether it stops: the verdict is reached, or will be if the open trials show nothing new
    next_point: Array | None = None  #: the point of the unit cube ``(d,)`` to execute next; None if the search chooses


_SCREENINGS = ((8, 0.3), (32, 0.05))
"""Cheap tests whether the bound is clearly above the threshold: how many draws of the hyperparameters, and a margin
that allows for the error of so few draws, in the probability that d* keeps the threshold."""


@checked
@dataclass(frozen=True)
class StoppingRule(ShortRepr):
    """The rule by which a campaign stops when its verdict on a threshold is reached by the posterior bound."""

    threshold: PositiveFloat  #: tau, in the distance's units
    confidence: Confidence = CONFIDENCE  #: that of the bound
    resolution: PositiveFloat = RESOLUTION  #: as for the posterior bound
    #: number of trials, where the largest draws of d* lie, after the bound first keeps the threshold; it must still
    #: keep it after them. They mostly correct a bound that is too low.
    confirmations: NonNegativeInt = 2

    def decide(self, trials: Sequence[Trial], left: int) -> StoppingDecision:
        """Return whether a campaign with so many executions left stops and, if not, which task must be executed next.

        Open trials count for the coverage of the task space, but their distances are not waited for.
        """
        if counterexample(trials, self.threshold) is not None:
            return StoppingDecision(decided=True)
        try:
            sample, points = Sample.of(Trials(trials).ended), np.array([trial.unit_point for trial in trials])
            missing = covering(points, self.resolution, left)
            if missing is None or self._is_surely_too_high(sample):
                return StoppingDecision()
            if len(missing):
                return StoppingDecision(next_point=missing[0])
            # The trials cover the task space, open ones included, so only the threshold is left to check.
            drawn, kept = self._is_kept(sample)
            if not kept:
                return StoppingDecision()
            contested = None
            if left and not self._has_stood(trials[: -self.confirmations or None]):
                highest = drawn.points[-max(1, round((1 - self.confidence) * len(drawn.points))) :]
                contested = most_contested(highest, points, self.resolution)
            return StoppingDecision(decided=contested is None, next_point=contested)
        except CertificateError:
            return StoppingDecision()

    def _has_stood(self, trials: Sequence[Trial]) -> bool:
        """Return whether the earlier trials already covered the task space with a bound that kept the threshold."""
        points = np.array([trial.unit_point for trial in trials])
        if not trials or covering(points, self.resolution, 0) is None:
            return False
        with suppress(CertificateError):
            return self._is_kept(Sample.of(Trials(trials).ended))[1]
        return False

    def _is_kept(self, sample: Sample) -> tuple[Maxima, bool]:
        drawn = settle_maxima(sample, self.threshold, self.confidence)
        # Coverage is left aside: its resolution is the whole task space.
        certificate = DistanceBound(resolution=1.0).certify_drawn(sample, drawn, self.confidence)
        return drawn, certificate.covers(self.threshold)

    def _is_surely_too_high(self, sample: Sample) -> bool:
        """Return whether the bound is clearly above the threshold, by tests that cost less than the bound."""
        instantaneous = None if sample.repeats_differ else instantaneous_bound(sample)
        if instantaneous is not None and instantaneous["max_ucb"] > self.threshold:
            return True
        return any(
            draw_maxima(sample, draws=draws).probability(self.threshold) < self.confidence - margin
            for draws, margin in _SCREENINGS
        )
