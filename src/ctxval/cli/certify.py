"""``ctxval certify`` and ``ctxval report``: what the trials in a store prove, in a certificate and on a page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval import report as reports
from ctxval._util.checked import PositiveFloat, require
from ctxval._util.files import write_text
from ctxval._util.progress import stage
from ctxval.campaign.provenance import provenance_of_store
from ctxval.campaign.storage.store import Store
from ctxval.certificates import KINDS, CertificateOptions, assess
from ctxval.cli.base import command, out, print_other_stores, print_verdict, status_of
from ctxval.cli.config.settings import Settings
from ctxval.cli.config.stored_settings import budget_of, limit_of, open_store, planned_settings, trusted_settings
from ctxval.cli.options import Allowed, named_values, require_outputs
from ctxval.core.labels import Labels, labels_of
from ctxval.errors import CtxvalError, InputError


@dataclass(frozen=True)
class Asked:
    """Options of the certificate; those that are not given have the values that the campaign was run with."""

    threshold: float | None = None
    confidence: float | None = None
    kind: str | None = None
    volume: float | None = None
    discard: int | None = None
    stochastic: bool | None = None
    resolution: float | None = None
    tests: int | None = None
    quantile: float | None = None
    option: list[str] | None = None

    def options(self, settings: Settings, kind: str | None) -> CertificateOptions:
        """Return the kind, the options and the confidence of the certificate."""
        names = ("discard", "volume", "stochastic", "resolution", "tests", "quantile")
        given = {name: getattr(self, name) for name in names}
        level = settings.confidence if self.confidence is None else self.confidence
        return settings.certificate.options(level, kind=kind, stated=named_values(self.option, **given))


@command("certify")
def certify_store(store: Path, asked: Asked, allowed: Allowed, audit: int | None = None) -> Any:
    opened, kind = Store.existing(store), asked.kind
    if kind is None:
        kind = "audit" if audit is not None else planned_settings(opened).certificate.kind
        kind = "posterior" if kind == "auto" else kind  # auto would load the experiment, so it must be asked for
    loads = audit is not None or KINDS.find(kind).needs_model
    if not loads and (allowed.trust or allowed.experiment is not None):
        raise InputError(
            "--trust and --experiment need --audit or a kind that uses the model: otherwise no code is imported or run."
        )
    if loads:
        settings = trusted_settings(opened, experiment=allowed.experiment, trust=allowed.trust)
    else:
        settings = planned_settings(opened, kind)
    limit = settings.threshold if asked.threshold is None else asked.threshold
    require("threshold", PositiveFloat | None, limit)
    if asked.volume is not None and limit is None:
        raise InputError("--volume needs --threshold: it is the share of the task space that may exceed the threshold.")
    options = asked.options(settings, kind)
    if audit is not None:
        options.kind.require_audit_helps([trial.origin for trial in opened.trials()])
    campaign = open_store(store, allowed).campaign if loads else None
    if campaign is not None and audit is not None:
        if limit is not None:
            campaign.state_threshold(limit)  # before these draws are executed
        campaign.audit(audit)
    with stage("certifying"):
        known = provenance_of_store(opened) if campaign is None else campaign.provenance
        assessment = assess(opened.trials(), options, limit, known)
    others, verdict = [str(other.path) for other in known.beside], assessment.verdict
    if verdict is not None:
        print_verdict(verdict)
    if assessment.certificate is None:
        out.say(f"no certificate: {assessment.refusal}", wrap=True)
    for row in [] if assessment.certificate is None else str(assessment.certificate).split("\n"):
        head, colon, rest = row.partition(":")
        out.say((head, "bold red" if head == "withdrawn" else ""), f"{colon}{rest}", wrap=True)
    if asked.kind is None and kind == "posterior":  # the verdict of the campaign may differ
        out.say(
            "the campaign was run with the kind auto, which may decide earlier. It loads the experiment, so it must be "
            f"asked for: `ctxval certify {shlex.quote(str(store))} --kind auto`.",
            wrap=True,
        )
    print_other_stores(others)
    return {**assessment.to_json(), "store": str(store), "other_stores": others}, status_of(verdict)


@command("report")
def write_report(
    store: Path,
    asked: Asked,
    allowed: Allowed,
    page: Path | None = None,
    junit: Path | None = None,
    markdown: Path | None = None,
    force: bool = False,
) -> Any:
    opened = Store.existing(store)
    target = page_path(store) if page is None else page
    outputs = {"--out .html": target, "--junit .xml": junit, "--markdown .md": markdown}
    require_outputs(outputs, [store, allowed.experiment], force=force)
    require("threshold", PositiveFloat | None, asked.threshold)
    try:
        loaded = open_store(store, allowed)
    except CtxvalError as error:
        if allowed != Allowed():
            raise
        # The experiment may not be loaded, and no code is imported or run.
        settings = planned_settings(opened, asked.kind)
        labels = Labels(labels_of(settings.states), labels_of(settings.inputs), settings.units or "")
        limit = settings.threshold if asked.threshold is None else asked.threshold
        known: dict[str, Any] = {"missing": str(error), "labels": labels, "budget": settings.budget}
        context = reports.context_of_store(opened, limit, certificate=asked.options(settings, asked.kind), **known)
    else:
        settings, experiment = loaded.settings, loaded.experiment
        context = reports.context_of_campaign(
            loaded.campaign,
            threshold=limit_of(experiment, settings, asked.threshold),
            certificate=asked.options(settings, asked.kind),
            budget=budget_of(experiment, settings),
        )
    written = {"report": str(reports.write_page(context, target))}
    if junit is not None:
        written["junit"] = str(write_text(junit, reports.junit(context)))
    if markdown is not None:
        written["markdown"] = str(write_text(markdown, reports.markdown(context)))
    out.say(", ".join(written.values()))
    if context.missing:
        out.say(f"without the experiment: {context.missing}", wrap=True)
    return {**reports.to_json(context), "files": written}, status_of(context.verdict)


def page_path(store: Path) -> Path:
    """Return the path of the report of a store."""
    return store.with_suffix(".report.html")
