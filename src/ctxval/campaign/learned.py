"""Predictions of the distance for certificates, learned from the trials before a given one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.dynamics import CampaignDynamics
from ctxval.campaign.history import executed_trials
from ctxval.campaign.trials import TrialRecorder
from ctxval.certificates import DynamicsEvidence, Provenance
from ctxval.core.preflight import start_offset
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CertificateError
from ctxval.searches import Prediction


@dataclass(frozen=True, eq=False, repr=False)
class LearnedFromTrials:
    """The :class:`ctxval.certificates.LearnedDistance` of a campaign. The system is never executed.

    Attributes:
        validation: the map p -> d(p).
        trials: all trials of the campaign.
        study: what the trajectories teach of the dynamics.
    """

    validation: Validation
    trials: Sequence[Trial]
    study: CampaignDynamics
    _predictions: dict[int, Prediction | None] = field(default_factory=dict, init=False)

    def expected(self, points: Array, before: int) -> Array:
        """Return predicted distances ``(m,)`` at points ``(m, d)``, learned from the trials with smaller numbers.

        They are NaN if a task cannot be predicted, or if the trials teach nothing.
        """
        if before not in self._predictions:
            earlier = [trial for trial in self.trials if trial.number < before]
            self._predictions[before] = self.study.prediction(earlier)
        prediction = self._predictions[before]
        return np.full(len(points), np.nan) if prediction is None else prediction.expected(points)[0]

    def dynamics(self, confidence: float) -> DynamicsEvidence | None:
        """Return what the dynamics learned from all trials say about d*; None if nothing can be learned."""
        evidence = self.study.evidence(self.trials, confidence)
        if evidence is None and self.study.failure is not None:
            raise CertificateError(f"no dynamics can be learned: {self.study.failure.rstrip('.')}.")
        return evidence

    def tasks(self, count: int, seed: int) -> Array:
        """Return independent draws of tasks, points of the unit cube ``(count, d)``."""
        # This random stream is none of those of trials.
        return self.validation.space.unit_draws(count, np.random.default_rng([seed, 0x7461]))


def provenance_of(recorder: TrialRecorder) -> Provenance:
    """Return what a certificate needs besides the trials of a campaign."""
    store, space, trials = recorder.store, recorder.validation.space, recorder.trials
    with store.snapshot():
        known = Provenance.of(store.description(), store.history())
    offsets = [
        (start_offset(recorder.validation, space.point(trial.parameters), executed), trial.number)
        for trial, executed in executed_trials(store, trials)
    ]
    start = max(((offset.size, f"{offset.text} (trial {number})") for offset, number in offsets), default=None)
    learned = LearnedFromTrials(recorder.validation, trials, recorder.dynamics)
    return replace(known, space=space, learned=learned, start=start)
