"""Commands that read one store: its trials, what they prove, in a certificate and on a page, and what M lacks."""

from __future__ import annotations

import json
import shlex
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval import report as reports
from ctxval._util.checked import PositiveFloat, TimeLimit, require
from ctxval._util.files import write_text
from ctxval.campaign.storage.other_stores import provenance_of_store
from ctxval.campaign.storage.store import CAUSE, Store
from ctxval.certificates import KINDS, CertificateOptions, assess
from ctxval.certificates.envelope import Envelope
from ctxval.cli import base
from ctxval.cli.base import Allowed, command, named_values, out, print_table
from ctxval.cli.config.settings import CertificateTable, ExperimentSettings
from ctxval.cli.config.stored_settings import Limits, open_store, planned_settings, trusted_settings
from ctxval.core.labels import Labels, labels_of
from ctxval.errors import CtxvalError, InputError, StoreError


@command()
def remeasure(store: Path, allowed: Allowed) -> Any:
    before = {trial.number: trial.distance for trial in Store.existing(store).trials()}
    campaign = open_store(store, allowed, remeasure=True).campaign
    trials, worst = campaign.trials, base.summary_of(campaign.trials)["worst"]
    measured = len(campaign.completed)
    changed = [trial.number for trial in trials if trial.distance != before.get(trial.number)]
    unmeasured = [trial.number for trial in campaign.unmeasured]
    if changed:
        count = f"{len(changed)} of {measured}"
        out.say(f"{count} distances have changed. The history of the store keeps the earlier values.")
    else:
        file = "If an experiment file defines the distance, name the file with --experiment."
        out.say(f"no distance has changed. {file}")
    if unmeasured:
        out.say(f"trials without a distance: {', '.join(map(str, unmeasured))}.")
    if worst is not None:
        print_table({"largest distance": worst})
    counts = {"measured": measured, "changed": changed, "unmeasured": unmeasured}
    return {**counts, "worst": worst, "store": str(store)}


@dataclass(frozen=True)
class Asked:
    """Options of the certificate; those that are not given have the values that the campaign was run with."""

    threshold: float | None = None
    confidence: float | None = None
    kind: str | None = None
    volume: float | None = None
    discard: int | None = None
    resolution: float | None = None
    tests: int | None = None
    quantile: float | None = None
    share: float | None = None
    thinking: float | None = None
    option: list[str] | None = None

    def options(self, settings: ExperimentSettings, kind: str | None) -> CertificateOptions:
        given = {name: getattr(self, name) for name in CertificateTable.model_fields if name != "kind"}
        level = settings.confidence if self.confidence is None else self.confidence
        return settings.certificate.options(level, kind=kind, stated=named_values(self.option, **given))

    def seconds(self, settings: ExperimentSettings) -> float | None:
        return base.stated_seconds(self.thinking, settings.thinking)


@command("certify")
def certify_store(store: Path, asked: Asked, allowed: Allowed, audit: int | None = None) -> Any:
    opened, kind = Store.existing(store), asked.kind
    if kind is None:
        kind = "audit" if audit is not None else planned_settings(opened).certificate.kind
        kind = "posterior" if kind == "auto" else kind  # auto would load the experiment, so it must be asked for
    loads = audit is not None or KINDS.find(kind).needs_model
    if not loads and (allowed.trust or allowed.experiment is not None):
        why = "otherwise no code is imported or run"
        raise InputError(f"--trust and --experiment need --audit or a kind that uses the model: {why}.")
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
        options.kind.require_usable(options.confidence, audit, [trial.origin for trial in opened.trials()])
    campaign = open_store(store, allowed).campaign if loads else None
    if campaign is not None and audit is not None:
        if limit is not None:
            campaign.state_threshold(limit)  # before these draws are executed
        campaign.audit(audit)
    known = provenance_of_store(opened)
    if campaign is None:
        assessment = assess(opened.trials(), options, limit, known)
    else:
        assessment = campaign.assessed(limit, options, asked.seconds(settings))
    others, verdict = [str(other.path) for other in known.beside], assessment.verdict
    if verdict is not None:
        base.print_verdict(verdict)
    if assessment.certificate is None:
        out.say(f"no certificate: {assessment.refusal}", wrap=True)
    for row in [] if assessment.certificate is None else str(assessment.certificate).split("\n"):
        head, colon, rest = row.partition(":")
        out.say((head, "bold red" if head == "withdrawn" else ""), f"{colon}{rest}", wrap=True)
    if assessment.certificate is not None:
        base.print_left_out(assessment.certificate.details.get("thinking"))
    if asked.kind is None and kind == "posterior":  # the verdict of the campaign may differ
        auto = "the campaign was run with the kind auto, which may decide earlier."
        how = f"`ctxval certify {shlex.quote(str(store))} --kind auto`"
        out.say(f"{auto} It loads the experiment, so it must be asked for: {how}.", wrap=True)
    base.print_other_stores(others)
    return {**assessment.to_json(), "store": str(store), "other_stores": others}, base.status_of(verdict)


@command("report")
def write_report(
    store: Path,
    asked: Asked,
    allowed: Allowed,
    page: Path | None = None,
    junit: Path | None = None,
    markdown: Path | None = None,
    card: Path | None = None,
    origin: str = "",
    force: bool = False,
) -> Any:
    opened = Store.existing(store)
    target = store.with_suffix(".report.html") if page is None else page
    beside = None if card is None else card.with_suffix(".json")
    outputs = {"--out .html": target, "--junit .xml": junit, "--markdown .md": markdown, "--card .md": card}
    outputs["--card .json"] = beside
    base.require_outputs(outputs, [store, allowed.experiment], force=force)
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
        limit, budget = Limits(asked.threshold).completed_by(loaded.settings, loaded.experiment)
        options = asked.options(loaded.settings, asked.kind)
        context = reports.context_of_campaign(
            loaded.campaign,
            threshold=limit,
            certificate=options,
            budget=budget,
            thinking=asked.seconds(loaded.settings),
        )
    written = {"report": str(reports.write_page(context, target))}
    if junit is not None:
        written["junit"] = str(write_text(junit, reports.junit(context)))
    if markdown is not None:
        written["markdown"] = str(write_text(markdown, reports.markdown(context)))
    if card is not None and beside is not None:
        made = reports.card(context, origin)
        written["card"] = str(write_text(card, made.markdown()))
        written["card as JSON"] = str(write_text(beside, json.dumps(made.to_json(), indent=1) + "\n"))
    out.say(", ".join(written.values()))
    if context.missing:
        out.say(f"without the experiment: {context.missing}", wrap=True)
    return {**reports.to_json(context), "files": written}, base.status_of(context.verdict)


@command("envelope")
def state_envelope(
    store: Path,
    allowed: Allowed,
    threshold: float | None = None,
    confidence: float | None = None,
    tests: int | None = None,
    quantile: float | None = None,
    thinking: float | None = None,
    out_: Path | None = None,
    force: bool = False,
) -> Any:
    base.require_outputs({"--out .py": out_}, [store, allowed.experiment], force=force)
    loaded = open_store(store, allowed)
    limit, _ = Limits(threshold).completed_by(loaded.settings, loaded.experiment)
    if limit is None:
        raise InputError("an envelope needs --threshold: it is the largest acceptable distance.")
    asked = Asked(confidence=confidence, tests=tests, quantile=quantile, thinking=thinking)
    options = asked.options(loaded.settings, loaded.settings.certificate.kind)
    seconds = asked.seconds(loaded.settings)
    envelope = loaded.campaign.envelope(limit, options.confidence, certificate=options, thinking=seconds)
    print_envelope(envelope)
    written = None if out_ is None or not envelope.share else str(envelope.save(out_))
    if written is not None:
        out.say(f"the function trusted(task) is in {written}", wrap=True)
    elif out_ is not None:
        out.say(f"{out_} is not written, because no task is trusted", wrap=True)
    return {**envelope.to_json(), "store": str(store), "file": written}


def print_envelope(envelope: Envelope) -> None:
    if envelope.doubt is None:
        out.say(("envelope", "bold"), f": {envelope.statement}", wrap=True)
    out.say(envelope.words, wrap=True)
    if envelope.doubt is None:
        if envelope.share:
            out.say(f"It assumes: {'; '.join(envelope.assumptions)}.", wrap=True)
        print_table({"executions": f"{envelope.executions}, of which {envelope.tests} were predicted at drawn tasks"})
    base.print_left_out(envelope.thinking)


@command()
def why(store: Path, allowed: Allowed, most: int = 2, thinking: float | None = None) -> Any:
    from ctxval.studies.causes import find_causes  # imported here: the other commands do not need it

    require("thinking", TimeLimit | None, thinking)
    campaign = open_store(store, allowed).campaign
    digest = campaign.store.digest()
    causes = find_causes(campaign, most=most, thinking=thinking)
    with suppress(StoreError):  # a store that cannot be written has no report with it
        campaign.store.keep_computed(CAUSE, causes.sentence, digest)
    out.say((causes.sentence, "bold" if causes.named else ""), wrap=True)
    if causes.separating_sentence is not None:
        out.say(causes.separating_sentence, wrap=True)
    base.print_left_out({"replaced": causes.replaced})
    rows = [] if causes.python is None else ["", *causes.python.splitlines()]
    for row in (*rows, *causes.mjcf):
        out.say(row)
    return {**causes.to_json(), "store": str(store)}
