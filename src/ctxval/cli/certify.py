"""``ctxval certify``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.campaign.campaign import Campaign
from ctxval.certificates import KINDS, Assessment, Certificate, Provenance, TheoremConstants, assess
from ctxval.certificates.verdict import require_threshold
from ctxval.cli.base import (
    FALSIFIED,
    RESOLUTION_HELP,
    AsJson,
    app,
    command,
    out,
    print_other_stores,
    print_verdict,
    progress,
)
from ctxval.cli.trust import AcceptChange, Named, Trust, open_store, settings_of
from ctxval.config.settings import planned_settings
from ctxval.errors import CertificateError, InputError
from ctxval.storage.other_stores import other_stores
from ctxval.storage.store import Store

Stored = Annotated[Path, typer.Argument(metavar="STORE", help="File of a campaign's trials.")]
Threshold = Annotated[float | None, typer.Option(help="Largest distance that you can accept.")]
Confidence = Annotated[float | None, typer.Option(help="Confidence level of the certificate (default: 0.95).")]
Kind = Annotated[
    str | None,
    typer.Option(help=f"Kind of certificate: {', '.join(KINDS.built_in)}, or one of an installed package."),
]
Draws = Annotated[
    int | None,
    typer.Option(help="First execute independent draws of tasks, until the store has this many of them in all."),
]
Volume = Annotated[float | None, typer.Option(help="Share of the task space that may exceed the threshold.")]
Discard = Annotated[
    int | None,
    typer.Option(help="sampling-discarding: how many distances are discarded; choose it before you know them."),
]
Constant = Annotated[
    float | None,
    typer.Option(help="convergence: the constant C, in the distance's units. A bound by it validates nothing."),
]
Theorem = Annotated[
    str | None, typer.Option(help="convergence: SCALE,NOISE,A,B,GAIN, from which C is computed (see docs/theory.md).")
]
Stochastic = Annotated[
    bool | None, typer.Option("--stochastic", help="posterior: two executions of one task may differ.")
]
Resolution = Annotated[float | None, typer.Option(help=f"posterior: {RESOLUTION_HELP[0].lower()}{RESOLUTION_HELP[1:]}")]
OfKind = Annotated[
    list[str] | None,
    typer.Option("--option", metavar="NAME=VALUE", help="Option of a kind of certificate, such as one of a plug-in."),
]


@app.command("certify")
@command
def certify_store(
    store: Stored,
    threshold: Threshold = None,
    confidence: Confidence = None,
    kind: Kind = None,
    audit: Draws = None,
    volume: Volume = None,
    discard: Discard = None,
    constant: Constant = None,
    theorem: Theorem = None,
    stochastic: Stochastic = None,
    resolution: Resolution = None,
    option: OfKind = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Compute a certificate from the trials in a store; only --audit executes anything.

    An option that is not given has the value in the store's experiment file, if there is one.
    """
    opened = Store.existing(store)
    if audit is None and (trust or experiment is not None):
        raise InputError("--trust and --experiment are for an --audit; nothing is imported or run without one.")
    settings = planned_settings(opened, kind) if audit is None else settings_of(opened, experiment, trust)
    stated = {"discard": discard, "constant": constant, "theorem": _theorem(theorem), "volume": volume}
    stated |= {"stochastic": stochastic, "resolution": resolution, **_named_values(option or [])}
    given = {name: value for name, value in stated.items() if value is not None}
    limit = settings.threshold if threshold is None else require_threshold(threshold)
    _require_together(given, limit)
    options = settings.certificate.options(
        settings.confidence if confidence is None else confidence,
        kind="audit" if kind is None and audit is not None else kind,
        stated=given,
    )
    if audit is not None:
        options.kind.require_audit_helps([trial.origin for trial in opened.trials()])
        _audit(open_store(opened, store, experiment, trust, accept_change).campaign, audit, show=not as_json)
    found = assess(opened.trials(), options, limit, Provenance.of(opened.description(), opened.history()))
    others = [str(other) for other in other_stores(store)]
    if not as_json:
        _print_assessment(found)
        print_other_stores(others)
    report = {**found.to_json(), "store": str(store), "other_stores": others}
    return report, FALSIFIED if found.verdict is not None and found.verdict.answer == "falsified" else 0


def _theorem(text: str | None) -> TheoremConstants | None:
    return None if text is None else TheoremConstants.parse(text)


def _named_values(given: list[str]) -> dict[str, Any]:
    """Return values by name; what is no JSON is a text."""
    found: dict[str, Any] = {}
    for one in given:
        name, equals, value = one.partition("=")
        if not (name and equals):
            raise InputError(f"--option must be NAME=VALUE, got {one!r}.")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


def _require_together(given: dict[str, Any], threshold: float | None) -> None:
    if "volume" in given and threshold is None:
        raise InputError("--volume is a share of the task space that may exceed a threshold; say --threshold too.")
    if "constant" in given and "theorem" in given:
        raise InputError("of --constant and --theorem only one can be given.")


def _audit(campaign: Campaign, draws: int, *, show: bool) -> None:
    _require_closed(campaign)
    drawn = sum(trial.origin == "iid" for trial in campaign.trials)
    with progress(campaign, campaign.executions + max(0, draws - drawn), show=show) as on_trial:
        campaign.audit(draws, on_trial)


def _require_closed(campaign: Campaign) -> None:
    """Refuse trials that people are executing; those that were interrupted are executed again by the audit itself."""
    if getattr(campaign.validation.system, "manual", False):
        return  # nothing can be executed at all, which the audit says
    waiting = [str(trial.number) for trial in campaign.trials if trial.state == "open" and not trial.attempts]
    if waiting:
        raise CertificateError(f"trials are open: {', '.join(waiting)}; tell how they ended before auditing.")


def _print_assessment(found: Assessment) -> None:
    if found.verdict is not None:
        print_verdict(found.verdict)
    if found.certificate is None:
        out.say(f"no certificate: {found.refusal}", wrap=True)
    else:
        _print_certificate(found.certificate)


def _print_certificate(certificate: Certificate) -> None:
    for line in str(certificate).split("\n"):
        head, colon, rest = line.partition(":")
        out.say((head, "bold red" if head == "withdrawn" else ""), f"{colon}{rest}", wrap=True)
