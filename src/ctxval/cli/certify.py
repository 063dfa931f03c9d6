"""``ctxval certify``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.campaign.campaign import Campaign
from ctxval.certificates import (
    KINDS,
    Certificate,
    Options,
    Sample,
    TheoremConstants,
    certify,
    require_possible,
    require_resolution,
    require_use,
)
from ctxval.certificates.verdict import (
    Verdict,
    counterexample,
    judge,
    judge_by,
    remarks_on,
    require_confidence,
    require_threshold,
    require_volume,
)
from ctxval.cli.base import (
    FALSIFIED,
    RESOLUTION_HELP,
    AsJson,
    app,
    certificate_of,
    command,
    out,
    print_other_stores,
    print_table,
    print_verdict,
    progress,
)
from ctxval.cli.trust import AcceptChange, Named, Trust, open_store, settings_of
from ctxval.config.settings import CertificateTable, Settings, stored_settings
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError, InputError, UnknownNameError
from ctxval.storage.other_stores import other_stores
from ctxval.storage.store import Store


@app.command("certify")
@command
def certify_store(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="File of a campaign's trials.")],
    threshold: Annotated[float | None, typer.Option(help="Largest distance that you can accept.")] = None,
    confidence: Annotated[float | None, typer.Option(help="Of the certificate; 0.95 if nothing else was said.")] = None,
    kind: Annotated[str | None, typer.Option(help=f"One of {', '.join(KINDS)}.")] = None,
    audit: Annotated[
        int | None, typer.Option(help="Execute independent draws of tasks first, until there are so many in all.")
    ] = None,
    volume: Annotated[float | None, typer.Option(help="Share of the task space that may exceed the threshold.")] = None,
    discard: Annotated[int | None, typer.Option(help="sampling-discarding: how many; chosen beforehand.")] = None,
    constant: Annotated[
        float | None, typer.Option(help="convergence: C, in the distance's units; it validates nothing.")
    ] = None,
    theorem: Annotated[
        str | None, typer.Option(help="convergence: SCALE,NOISE,A,B,GAIN that C is computed from (see the manual).")
    ] = None,
    stochastic: Annotated[
        bool | None, typer.Option("--stochastic", help="posterior: executions of one task may differ.")
    ] = None,
    resolution: Annotated[
        float | None,
        typer.Option(help=f"posterior: {RESOLUTION_HELP[0].lower()}{RESOLUTION_HELP[1:]}"),
    ] = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Say what the trials of a store prove, and with what confidence; nothing is executed but for an audit.

    What is not said here is as the experiment's file says it, where the store is of one.
    """
    given = {"discard": discard, "constant": constant, "theorem": theorem, "volume": volume}
    given |= {"stochastic": stochastic, "resolution": resolution}
    opened = Store.existing(store)
    if audit is None and (trust or experiment is not None):
        raise InputError("--trust and --experiment are for an --audit; nothing is imported or run without one.")
    planned = _planned(opened) if audit is None else settings_of(opened, experiment, trust)
    confidence = _first(confidence, planned.confidence)
    table = planned.certificate
    volume = _first(volume, table.volume)
    stochastic = _first(stochastic, table.stochastic)
    if kind is None and audit is None:
        kind, discard, constant = table.kind, _first(discard, table.discard), _first(constant, table.constant)
    threshold = _first(threshold, planned.threshold)
    limit = None if threshold is None else require_threshold(threshold)
    chosen = kind or "audit"
    resolution = _first(resolution, table.resolution)
    options = Options(stochastic, discard, constant, _theorem(theorem), _search_of(opened), resolution)
    # All of it before an audit is paid for.
    _require_shares(confidence, volume)
    require_resolution(resolution)
    if chosen not in KINDS:
        raise UnknownNameError.among("certificate", chosen, KINDS)
    require_use(chosen, [name for name, value in given.items() if value is not None])
    _require_together(given, limit)
    if audit is not None:
        require_possible([trial.origin for trial in opened.trials()], chosen, options)
        made = open_store(opened, store, experiment, trust, accept_change)
        _run_audit(made.campaign, audit, show=not as_json)
    trials, space, remarks = opened.trials(), _space_of(opened), remarks_on(opened.history())
    options = replace(options, remarks=remarks)
    found = None if limit is None else counterexample(trials, limit)
    verdict: Verdict | None
    if chosen == "posterior" and limit is not None and found is None:
        verdict, refusal = (
            judge(
                trials, limit, confidence, stochastic=stochastic, resolution=resolution, space=space, remarks=remarks
            ),
            None,
        )
        certificate = verdict.certificate
        if certificate is None:
            raise CertificateError(verdict.reason)
    else:
        certificate, refusal = _certificate(trials, chosen, confidence, options, needed=found is None)
        verdict = found
        if limit is not None and certificate is not None:
            verdict = judge_by(certificate, trials, limit, volume=volume, space=space)
    answer = _answer(verdict)
    said = {"kind": chosen, "refused": refusal} if certificate is None else certificate.to_json()
    others = [str(other) for other in other_stores(store)]
    report = {**answer, **said, "expected": certificate_of(verdict)["expected"]}
    report |= {"store": str(store), "other_stores": others}
    if not as_json:
        _print_certificate(certificate, verdict, refusal)
        print_other_stores(others)
    return report, FALSIFIED if verdict is not None and verdict.answer == "falsified" else 0


def _planned(store: Store) -> Settings:
    """Return what the experiment's file says; the defaults where the store is of no command."""
    return stored_settings(store) if store.settings() else Settings()


def _first(given: Any, planned: Any) -> Any:
    return planned if given is None else given


def _answer(verdict: Verdict | None) -> dict[str, Any]:
    if verdict is None:
        return {}
    said = {"verdict": verdict.answer, "reason": verdict.reason, "rests_on": verdict.rests_on}
    return {**said, "threshold": verdict.threshold}


def _space_of(store: Store) -> TaskSpace | None:
    """Return the task space as the store describes it; None if it does not."""
    try:
        described = dict(store.description()["validation"]["space"])
        described.pop("type", None)
        bounds: dict[str, tuple[Any, ...]] = {}
        for name, (low, high, *unit) in described.items():
            vector = name.partition("[")[0]
            lows, highs, *_ = bounds.get(vector, ([], []))
            bounds[vector] = (low, high, *unit) if vector == name else ([*lows, low], [*highs, high], *unit)
        return TaskSpace(**bounds)
    except (KeyError, TypeError, ValueError, InputError):
        return None  # nothing but the units in a sentence depends on it


def _search_of(store: Store) -> str | None:
    search = store.description().get("search")
    return search.get("type") if isinstance(search, dict) else None


def decide(campaign: Campaign, threshold: float, confidence: float, table: CertificateTable) -> Verdict:
    """Return the verdict that an experiment's own certificate gives; undecided where its theory refuses the trials."""
    trials = list(campaign.trials)
    found = counterexample(trials, threshold)
    if found is not None:
        return found
    if table.kind == "posterior":
        return campaign.verdict(threshold, confidence, stochastic=table.stochastic, resolution=table.resolution)
    search, remarks = _search_of(campaign.store), remarks_on(campaign.store.history())
    options = Options(table.stochastic, table.discard, table.constant, None, search, table.resolution, remarks)
    try:
        certificate = certify(Sample.of(trials), table.kind, confidence, options)
    except CertificateError as error:
        return Verdict("undecided", threshold, str(error))
    return judge_by(certificate, trials, threshold, volume=table.volume, space=campaign.validation.space)


def _require_together(given: dict[str, Any], threshold: float | None) -> None:
    if given["volume"] is not None and threshold is None:
        raise InputError("--volume is a share of the task space that may exceed a threshold; say --threshold too.")
    if given["constant"] is not None and given["theorem"] is not None:
        raise InputError("of --constant and --theorem only one can be given.")


def _require_closed(campaign: Campaign) -> None:
    """Refuse trials that people are executing; those that were interrupted are executed again by the audit itself."""
    if getattr(campaign.validation.system, "manual", False):
        return  # nothing can be executed at all, which the audit says
    waiting = [str(trial.number) for trial in campaign.trials if trial.state == "open" and not trial.attempts]
    if waiting:
        raise CertificateError(f"trials are open: {', '.join(waiting)}; tell how they ended before auditing.")


def _require_shares(confidence: float, volume: float) -> None:
    if not 0 < 1 - confidence < 1:
        raise InputError(f"the confidence must be strictly between 0 and 1, got {confidence!r}.")
    require_confidence(confidence)
    require_volume(volume)


def _certificate(
    trials: list[Trial], kind: str, confidence: float, options: Options, *, needed: bool
) -> tuple[Certificate | None, str | None]:
    """Return the certificate; where a counterexample was executed, a refusal does not matter."""
    try:
        return certify(Sample.of(trials), kind, confidence, options), None
    except CertificateError as error:
        if needed:
            raise
        return None, str(error)


def _run_audit(campaign: Campaign, draws: int, *, show: bool) -> None:
    _require_closed(campaign)
    drawn = sum(trial.origin == "iid" for trial in campaign.trials)
    with progress(campaign, campaign.executions + max(0, draws - drawn), show=show) as on_trial:
        campaign.audit(draws, on_trial)


def _theorem(text: str | None) -> TheoremConstants | None:
    if text is None:
        return None
    try:
        return TheoremConstants(*(float(part) for part in text.split(",")))
    except CertificateError:
        raise  # it names the number that is wrong
    except (ValueError, TypeError) as error:
        raise InputError(f"--theorem must be five numbers SCALE,NOISE,A,B,GAIN, got {text!r}.") from error


def _print_certificate(certificate: Certificate | None, verdict: Verdict | None, refusal: str | None) -> None:
    if verdict is not None:
        print_verdict(verdict)
    if certificate is None:
        out.say(f"no certificate: {refusal}", wrap=True)
        return
    out.say(f"{certificate.kind}: {certificate.statement}", wrap=True)
    if certificate.doubt is not None:
        out.say(("withdrawn", "bold red"), f": {certificate.doubt}.", wrap=True)
    out.say("It assumes that")
    for assumption in certificate.assumptions:
        out.say(f"- {assumption};", wrap=True)
    shown = {key: value for key, value in certificate.details.items() if key != "failures"}  # assumptions have them
    print_table({**shown, "trials": certificate.trials, "version": certificate.version})
