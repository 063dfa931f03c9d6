"""``ctxval why``: what a model lacks, by the executions in a store."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from ctxval.campaign.storage.store import CAUSE
from ctxval.cli.base import command, out
from ctxval.cli.config.stored_settings import open_store
from ctxval.cli.options import Allowed
from ctxval.errors import StoreError
from ctxval.studies.causes import find_causes


@command()
def why(store: Path, allowed: Allowed, most: int = 2) -> Any:
    """``ctxval why``."""
    campaign = open_store(store, allowed).campaign
    digest = campaign.store.digest()
    found = find_causes(campaign, most=most)
    with suppress(StoreError):  # a store that cannot be written has no report with it
        campaign.store.keep_computed(CAUSE, found.sentence, digest)
    out.say((found.sentence, "bold" if found.named else ""), wrap=True)
    if found.separating_sentence is not None:
        out.say(found.separating_sentence, wrap=True)
    if found.python is not None:
        out.say("")
        for row in found.python.splitlines():
            out.say(row)
    for row in found.mjcf:
        out.say(row)
    return {**found.to_dict(), "store": str(store)}
