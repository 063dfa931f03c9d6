"""``ctxval certify`` and ``ctxval report``: what the trials in a store prove, in a certificate and on a page."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctxval import report as reports
from ctxval._util.checked import PositiveFloat, require
from ctxval._util.files import write_text
from ctxval._util.progress import stage
from ctxval.campaign.storage.other_stores import other_stores
from ctxval.campaign.storage.store import Store
from ctxval.certificates import KINDS, CertificateOptions, Provenance, assess
from ctxval.cli.base import FALSIFIED, command, out, print_other_stores, print_verdict
from ctxval.cli.config.settings import Settings
from ctxval.cli.config.stored_settings import planned_settings, trusted_settings
from ctxval.cli.options import named_values, require_outputs
from ctxval.cli.trust import budget_of, limit_of, open_store
from ctxval.core.labels import Labels, labels_of
from ctxval.errors import CtxvalError, InputError
from ctxval.report.context import context_of_campaign, context_of_store


@command("certify")
def certify_store(
    store: Path,
    threshold: float | None = None,
    confidence: float | None = None,
    kind: str | None = None,
    audit: int | None = None,
    volume: float | None = None,
    discard: int | None = None,
    stochastic: bool | None = None,
    resolution: float | None = None,
    tests: int | None = None,
    option: list[str] | None = None,
    experiment: str | None = None,
    trust: bool = False,
    accept_change: str | None = None,
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
    settings = trusted_settings(opened, experiment=experiment, trust=trust) if loads else planned_settings(opened, kind)
    chosen = {"discard": discard, "volume": volume, "stochastic": stochastic, "resolution": resolution, "tests": tests}
    stated = named_values(option, **chosen)
    limit = require("threshold", PositiveFloat | None, settings.threshold if threshold is None else threshold)
    if "volume" in stated and limit is None:
        raise InputError("--volume needs --threshold: it is the share of the task space that may exceed the threshold.")
    level = settings.confidence if confidence is None else confidence
    options = settings.certificate.options(level, kind=kind, stated=stated)
    if audit is not None:
        options.kind.require_audit_helps([trial.origin for trial in opened.trials()])
    campaign = open_store(opened, store, experiment, trust, accept_change).campaign if loads else None
    if campaign is not None and audit is not None:
        campaign.audit(audit)
    with opened.snapshot():
        trials, known = opened.trials(), Provenance.of(opened.description(), opened.history())
    with stage("certifying"):
        assessment = assess(trials, options, limit, known if campaign is None else campaign.provenance)
    others, verdict = [str(other) for other in other_stores(store)], assessment.verdict
    if verdict is not None:
        print_verdict(verdict)
    if assessment.certificate is None:
        out.say(f"no certificate: {assessment.refusal}", wrap=True)
    for row in [] if assessment.certificate is None else str(assessment.certificate).split("\n"):
        head, colon, rest = row.partition(":")
        out.say((head, "bold red" if head == "withdrawn" else ""), f"{colon}{rest}", wrap=True)
    if asked is None and kind == "posterior":  # the verdict of the campaign may differ
        out.say(
            "the campaign was run with the kind auto, which may decide earlier. It loads the experiment, so it must be "
            f"asked for: `ctxval certify {shlex.quote(str(store))} --kind auto`.",
            wrap=True,
        )
    print_other_stores(others)
    report = {**assessment.to_json(), "store": str(store), "other_stores": others}
    return report, FALSIFIED if verdict is not None and verdict.answer == "falsified" else 0


@command("report")
def write_report(
    store: Path,
    page: Path | None = None,
    threshold: float | None = None,
    confidence: float | None = None,
    kind: str | None = None,
    volume: float | None = None,
    option: list[str] | None = None,
    junit: Path | None = None,
    markdown: Path | None = None,
    force: bool = False,
    experiment: str | None = None,
    trust: bool = False,
) -> Any:
    """Write the report of a store: one HTML page with the verdict, insights, charts and trials.

    The system is not executed. The experiment is loaded if its store names no code, or if you made the store or allow
    its code. Otherwise the report says what is missing without it.

    Options that are not given have the values that the campaign was run with.
    """
    opened = Store.existing(store)
    target = page_path(store) if page is None else page
    outputs = {"--out .html": target, "--junit .xml": junit, "--markdown .md": markdown}
    require_outputs(outputs, [store, experiment], force=force)
    require("threshold", PositiveFloat | None, threshold)
    stated = named_values(option, volume=volume)

    def certificate(settings: Settings) -> CertificateOptions:
        planned = settings.confidence if confidence is None else confidence
        return settings.certificate.options(planned, kind=kind, stated=stated)

    try:
        loaded = open_store(opened, store, experiment, trust)
    except CtxvalError as error:
        if experiment is not None or trust:
            raise
        # The experiment may not be loaded, and no code is imported or run.
        settings = planned_settings(opened, kind)
        labels = Labels(labels_of(settings.states), labels_of(settings.inputs), settings.units or "")
        limit = settings.threshold if threshold is None else threshold
        context = context_of_store(opened, limit, certificate=certificate(settings), missing=str(error), labels=labels)
        context = replace(context, budget=settings.budget)
    else:
        settings, made = loaded.settings, loaded.experiment
        context = context_of_campaign(
            loaded.campaign,
            threshold=limit_of(made, settings, threshold),
            certificate=certificate(settings),
            budget=budget_of(made, settings),
        )
    written = {"report": str(reports.write_page(context, target))}
    if junit is not None:
        written["junit"] = str(write_text(junit, reports.junit(context)))
    if markdown is not None:
        written["markdown"] = str(write_text(markdown, reports.markdown(context)))
    out.say(", ".join(written.values()))
    if context.missing:
        out.say(f"without the experiment: {context.missing}", wrap=True)
    falsified = context.verdict is not None and context.verdict.answer == "falsified"
    return {**reports.to_json(context), "files": written}, FALSIFIED if falsified else 0


def page_path(store: Path) -> Path:
    """Return the path of the report of a store."""
    return store.with_suffix(".report.html")
