"""``ctxval envelope``: on which tasks the distance stays below a threshold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ctxval.certificates.envelope import Envelope
from ctxval.cli.base import command, out, print_table
from ctxval.cli.certify import Asked
from ctxval.cli.config.stored_settings import limit_of, open_store
from ctxval.cli.options import Allowed, require_outputs
from ctxval.errors import InputError


@command("envelope")
def state_envelope(
    store: Path,
    allowed: Allowed,
    threshold: float | None = None,
    confidence: float | None = None,
    tests: int | None = None,
    quantile: float | None = None,
    out_: Path | None = None,
    force: bool = False,
) -> Any:
    """``ctxval envelope``."""
    suffix = ".onnx" if out_ is not None and out_.suffix == ".onnx" else ".py"
    require_outputs({f"--out {suffix}": out_}, [store, allowed.experiment], force=force)
    loaded = open_store(store, allowed)
    limit = limit_of(loaded.experiment, loaded.settings, threshold)
    if limit is None:
        raise InputError("an envelope needs --threshold: it is the largest acceptable distance.")
    asked = Asked(confidence=confidence, tests=tests, quantile=quantile)
    options = asked.options(loaded.settings, loaded.settings.certificate.kind)
    envelope = loaded.campaign.envelope(limit, options.confidence, certificate=options)
    print_envelope(envelope)
    written = None if out_ is None or not envelope.share else str(envelope.save(out_))
    if written is not None:
        out.say(f"the function trusted(task) is in {written}", wrap=True)
    return {**envelope.to_json(), "store": str(store), "file": written}


def print_envelope(envelope: Envelope) -> None:
    """Print what an envelope says, in words and in numbers."""
    if envelope.doubt is None:
        out.say(("envelope", "bold"), f": {envelope.statement}", wrap=True)
    out.say(envelope.words, wrap=True)
    if envelope.doubt is None:
        print_table({"executions": f"{envelope.executions}, of which {envelope.tests} were predicted at drawn tasks"})
