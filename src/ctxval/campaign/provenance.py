"""What a certificate needs besides trials: from a store alone, or from a campaign whose experiment is loaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ctxval.campaign.dynamics import CampaignDynamics, LearnedFromTrials
from ctxval.campaign.history import executed_trials
from ctxval.campaign.storage.other_stores import other_stores
from ctxval.campaign.storage.store import Store
from ctxval.certificates import Provenance
from ctxval.core.plan import start_offset
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation


def provenance_of_store(store: Store) -> Provenance:
    """Return what a store says besides its trials. Nothing is written, and no code is imported or run."""
    with store.snapshot():
        description, changes, thresholds = store.description(), store.history(), store.thresholds()
    beside = () if store.path is None else other_stores(store.path)
    return Provenance.of(description, changes, thresholds, beside)


def provenance_of(
    store: Store, validation: Validation, trials: Sequence[Trial], dynamics: CampaignDynamics
) -> Provenance:
    """Return what a certificate needs besides the trials of a campaign."""
    known = provenance_of_store(store)
    offsets = [
        (start_offset(validation, validation.space.point(trial.parameters), executed), trial.number)
        for trial, executed in executed_trials(store, trials)
    ]
    start = max(((offset.size, f"{offset.text} (trial {number})") for offset, number in offsets), default=None)
    learned = LearnedFromTrials(validation, trials, dynamics)
    return replace(known, space=validation.space, learned=learned, start=start, units=validation.labels.units)
