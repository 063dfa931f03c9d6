"""What a store says to a certificate besides its trials."""

from __future__ import annotations

from ctxval.campaign.storage.other_stores import other_stores
from ctxval.campaign.storage.store import Store
from ctxval.certificates import Provenance


def provenance_of_store(store: Store) -> Provenance:
    """Return what a store says besides its trials. Nothing is written, and no code is imported or run."""
    with store.snapshot():
        description, changes, thresholds = store.description(), store.history(), store.thresholds()
    beside = () if store.path is None else other_stores(store.path)
    return Provenance.of(description, changes, thresholds, beside)
