"""``ctxval certify``: compute a certificate from the trials in a store."""

from __future__ import annotations

import shlex
from typing import Annotated, Any

import typer

from ctxval._util.checked import PositiveFloat, require
from ctxval._util.progress import stage
from ctxval.certificates import KINDS, Provenance, assess
from ctxval.cli.base import FALSIFIED, command, out, print_other_stores, print_verdict
from ctxval.cli.commands import app
from ctxval.cli.options import (
    AsJson,
    Confidence,
    Resolution,
    Stochastic,
    StoreArgument,
    Threshold,
    named_values,
)
from ctxval.cli.trust import AcceptChange, Named, Trust, open_store, settings_of
from ctxval.config.stored_settings import planned_settings
from ctxval.errors import InputError
from ctxval.storage.other_stores import other_stores
from ctxval.storage.store import Store

Kind = Annotated[
    str | None,
    typer.Option(
        help=f"Kind of the certificate: {', '.join(KINDS.built_in)}, or a kind from an installed package (default: "
        "audit if --audit is given, otherwise that of the campaign, and posterior if that is auto). The kinds auto, "
        "dynamics, mean and region load the experiment."
    ),
]
Draws = Annotated[
    int | None,
    typer.Option(help="Execute independent random tasks first, until the store contains this number of them."),
]
Volume = Annotated[
    float | None,
    typer.Option(
        help="Share of the task space, from 0 to 0.5, that may exceed the threshold (default: 0). Only for "
        "--kind anytime, audit, region, scenario and sampling-discarding."
    ),
]
Discard = Annotated[
    int | None,
    typer.Option(
        help="Number of largest distances to discard, or for --kind region of largest errors of the prediction. Choose "
        "it before the distances are known. Only for --kind region and sampling-discarding, which needs it."
    ),
]
KindOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="Option of the kind of certificate, for example of a kind from an installed package. Repeat --option to "
        "set several.",
    ),
]


@app.command("certify")
@command
def certify_store(
    store: StoreArgument,
    threshold: Threshold = None,
    confidence: Confidence = None,
    kind: Kind = None,
    audit: Draws = None,
    volume: Volume = None,
    discard: Discard = None,
    stochastic: Stochastic = None,
    resolution: Resolution = None,
    option: KindOptions = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Compute a certificate from the trials in a store. The system is executed only if --audit is given.

    A kind that uses what the experiment's model predicts loads the experiment; other kinds run no code.

    Options that are not given have the values that the campaign was run with. If its kind was auto, --kind is
    posterior, because auto loads the experiment.
    """
    opened = Store.existing(store)
    asked = kind
    if kind is None:
        kind = "audit" if audit is not None else planned_settings(opened).certificate.kind
        kind = "posterior" if kind == "auto" else kind  # auto would load the experiment, so it must be asked for
    loads = audit is not None or KINDS.find(kind).needs_model
    if not loads and (trust or experiment is not None):
        raise InputError(
            "--trust and --experiment need --audit or a kind that uses the model: otherwise no code is imported or run."
        )
    settings = settings_of(opened, experiment, trust) if loads else planned_settings(opened, kind)
    given = named_values(option, discard=discard, volume=volume, stochastic=stochastic, resolution=resolution)
    limit = require("threshold", PositiveFloat | None, settings.threshold if threshold is None else threshold)
    if "volume" in given and limit is None:
        raise InputError("--volume needs --threshold: it is the share of the task space that may exceed the threshold.")
    options = settings.certificate.options(
        settings.confidence if confidence is None else confidence,
        kind=kind,
        stated=given,
    )
    if audit is not None:
        options.kind.require_audit_helps([trial.origin for trial in opened.trials()])
    campaign = open_store(opened, store, experiment, trust, accept_change).campaign if loads else None
    if campaign is not None and audit is not None:
        campaign.audit(audit)
    with opened.snapshot():
        trials, known = opened.trials(), Provenance.of(opened.description(), opened.history())
    with stage("certifying"):
        found = assess(trials, options, limit, known if campaign is None else campaign.provenance)
    others = [str(other) for other in other_stores(store)]
    if not as_json:
        if found.verdict is not None:
            print_verdict(found.verdict)
        if found.certificate is None:
            out.say(f"no certificate: {found.refusal}", wrap=True)
        for row in [] if found.certificate is None else str(found.certificate).split("\n"):
            head, colon, rest = row.partition(":")
            out.say((head, "bold red" if head == "withdrawn" else ""), f"{colon}{rest}", wrap=True)
        if asked is None and kind == "posterior":  # the verdict of the campaign may differ
            out.say(
                "the campaign was run with the kind auto, which may decide earlier. It loads the experiment, so it "
                f"must be asked for: `ctxval certify {shlex.quote(str(store))} --kind auto`.",
                wrap=True,
            )
        print_other_stores(others)
    report = {**found.to_json(), "store": str(store), "other_stores": others}
    return report, FALSIFIED if found.verdict is not None and found.verdict.answer == "falsified" else 0
