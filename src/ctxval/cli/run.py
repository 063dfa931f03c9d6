"""``ctxval run``: execute the tasks that decide, and give the verdict."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctxval._util.progress import also_listening
from ctxval._util.texts import reason_of, shortened
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.certificates.base import Certificate
from ctxval.certificates.verdict import Verdict, usable_bound
from ctxval.cli.base import (
    CANNOT_GO_ON,
    FALSIFIED,
    RUN,
    command,
    err,
    failures_of,
    out,
    print_failures,
    print_other_stores,
    print_table,
    print_verdict,
    say_error,
    worker_options,
    worst_of,
)
from ctxval.cli.commands import app
from ctxval.cli.options import (
    AsJson,
    Confidence,
    Dask,
    PartOptions,
    Resolution,
    SearchName,
    Stochastic,
    Target,
    Threshold,
    Timeout,
    Workers,
    named_values,
)
from ctxval.cli.report import page_path
from ctxval.cli.trust import AcceptChange, budget_of, limit_of
from ctxval.config.settings import Settings, read_settings
from ctxval.core.experiment import Experiment
from ctxval.core.trial import designs_sentence
from ctxval.core.truth import Truth
from ctxval.errors import CertificateError, InputError
from ctxval.report.context import context_of_campaign
from ctxval.report.page import write_page
from ctxval.storage.other_stores import other_stores
from ctxval.web.served import ServedCampaign

if TYPE_CHECKING:
    from ctxval.web.live import LiveCampaign

Budget = Annotated[
    int | None,
    typer.Option(
        help="Maximum number of executions of the system, including earlier ones in the store (default: the budget of "
        "the experiment)."
    ),
]
Explore = Annotated[
    bool | None,
    typer.Option(
        "--explore/--decide",
        help="Spend the whole budget on the tasks of the search, or stop as soon as the verdict is reached (default: "
        "--decide, and --explore if --search names another search than auto).",
    ),
]
Within = Annotated[
    float | None,
    typer.Option(
        help="Largest share by which the bound may exceed the largest executed distance when a campaign without a "
        "threshold stops (default: 0.05)."
    ),
]
Audited = Annotated[
    bool,
    typer.Option(
        "--audited",
        help="Before learned dynamics validate the model, predict and execute eight fresh random tasks.",
    ),
]
Seed = Annotated[
    int | None, typer.Option(help="Seed of the random numbers of the data, the model and the search (default: 0).")
]
StoreFile = Annotated[
    Path | None,
    typer.Option(
        help="Store of the campaign. If the file exists, the campaign is resumed (default: a file in the folder runs, "
        "named after the experiment, the search and the seed)."
    ),
]
WithTruth = Annotated[
    bool, typer.Option("--truth", help="Also compute the true maximum distance. This needs a simulated system.")
]
WithReport = Annotated[
    bool,
    typer.Option(
        "--report/--no-report",
        help="Write a report next to the store: one HTML page with the verdict, insights and charts.",
    ),
]
Live = Annotated[
    bool,
    typer.Option(
        "--live",
        help="Show the campaign in a browser as it goes: serve a page on this computer until the command ends, and "
        "print its address. The page needs the extra web.",
    ),
]
Variant = Annotated[str | None, typer.Option(help="Variant of a case; the same as --option variant=VALUE.")]
ModelName = Annotated[str | None, typer.Option(help="Learned model of a case; the same as --option model=VALUE.")]
Dimension = Annotated[int | None, typer.Option(help="Number of states of a case; the same as --option dim=VALUE.")]


@app.command()
@command
def run(
    target: Target,
    budget: Budget = None,
    search: SearchName = None,
    threshold: Threshold = None,
    confidence: Confidence = None,
    explore: Explore = None,
    within: Within = None,
    audited: Audited = False,
    stochastic: Stochastic = None,
    resolution: Resolution = None,
    seed: Seed = None,
    store: StoreFile = None,
    truth: WithTruth = False,
    workers: Workers = None,
    dask: Dask = None,
    timeout: Timeout = None,
    accept_change: AcceptChange = None,
    with_report: WithReport = True,
    live: Live = False,
    as_json: AsJson = False,
    option: PartOptions = None,
    variant: Variant = None,
    model: ModelName = None,
    dim: Dimension = None,
) -> Any:
    """Execute the tasks that decide whether the model can be trusted, and give the verdict.

    The campaign stops when the threshold lies outside of the interval of the largest distance, or when the budget is
    spent. If the store exists, the campaign is resumed. Options that are not given have the values in the experiment
    file.
    """
    options = named_values(option, variant=variant, model=model, dim=dim)
    given = {"budget": budget, "search": search, "threshold": threshold, "confidence": confidence, "seed": seed}
    ending = {"explore": explore, "within": within, "audited": audited or None}
    settings = read_settings(target, {**given, **ending, "store": store, "options": options})
    settings = settings.certified_as({"stochastic": stochastic, "resolution": resolution})
    experiment = settings.load()
    if settings.audited and settings.explores:
        raise InputError("--audited tests the bound that ends a campaign; an exploration ends with its budget.")
    certificate = settings.certificate_options
    if truth and experiment.truth is None:
        raise InputError(
            f"the true maximum of {experiment.name!r} is not known. Only experiments with a `truth` function have it, "
            "such as the cases of the paper."
        )
    limit = limit_of(experiment, settings)
    path = settings.store_path(experiment.name)
    campaign = settings.campaign(experiment, path, accept_change=accept_change)
    total = budget_of(experiment, settings)
    if limit is not None:
        certificate.kind.require_usable(certificate.confidence, total)  # before executions are paid for
    if not as_json:
        parts = experiment.validation
        sentence = f": S {type(parts.system).__name__}, M {shortened(repr(parts.model), 60)}, "
        sentence += f"controllers {type(parts.synthesizer).__name__}"
        if limit is not None:
            sentence += f", threshold {limit:g} {experiment.units}".rstrip()
        out.say((experiment.name, "bold"), sentence, wrap=True)
    with _live_page(live, ServedCampaign(experiment, campaign, limit, certificate, total), settings) as shown:
        with worker_options(workers, dask, timeout) as execution:
            campaign.run(
                total,
                limit,
                None if shown is None else shown.take,
                explore=settings.explores,
                within=settings.within,
                certificate=certificate,
                audited=settings.audited,
                **execution,
            )
        known = experiment.truth() if truth and experiment.truth is not None else None
        digest = campaign.store.digest()
        verdict = None if limit is None else campaign.verdict(limit, certificate=certificate)
        bound = None if verdict is None else verdict.certificate
        if verdict is None and not settings.explores:
            with suppress(CertificateError):
                bound = campaign.certify(certificate=certificate)
        report = _report(campaign, experiment, settings, total, path, verdict, bound, known)
        result = {"verdict": None if verdict is None else verdict.to_json(), "budget": total}
        if with_report:
            page = page_path(path)
            # An earlier run may have written the same report.
            current = page.is_file() and campaign.store.computed(RUN) == {**result, "report": str(page)}
            try:
                context = None if current else context_of_campaign(campaign, verdict, budget=total)
                report["report"] = str(page if context is None else write_page(context, page))
            except Exception as error:  # it must not hide the verdict, for which executions were paid
                err.say(f"no report: {reason_of(error)}")
                report["report"] = None
        campaign.store.keep_computed(RUN, {**result, "report": report.get("report")}, digest)
        if shown is not None:
            shown.end(verdict, bound, report.get("report"))
    if not as_json:
        _print_report(report, verdict, bound)
    if campaign.failed and not campaign.completed:
        say_error(f"all {len(campaign.failed)} executions failed, so there is no distance.")
        return report, CANNOT_GO_ON
    return report, FALSIFIED if verdict is not None and verdict.answer == "falsified" else 0


@contextmanager
def _live_page(wanted: bool, served: ServedCampaign, settings: Settings) -> Iterator[LiveCampaign | None]:
    """Serve the page of the campaign while the command runs, if it is wanted."""
    if not wanted:
        yield None
        return
    from ctxval.cli.serve import web_server  # it needs an extra

    web, search = web_server(), None
    if not settings.explores:
        search = IntervalSearch(
            served.campaign.recorder,
            served.certificate,
            served.budget,
            served.threshold,
            settings.within,
            settings.audited,
        )
    page = web.LiveCampaign(served, search)
    with web.showing(page) as address, also_listening(page.hear):
        out.say(f"the page is at {address}")
        screen = sys.platform in ("win32", "darwin") or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
        if sys.stdout.isatty() and screen:
            webbrowser.open(address)
        yield page


def _report(
    campaign: Campaign,
    experiment: Experiment,
    settings: Settings,
    budget: int,
    path: Path,
    verdict: Verdict | None,
    bound: Certificate | None,
    truth: Truth | None,
) -> dict[str, Any]:
    report: dict[str, Any] = {
        "case": experiment.name,
        **({"options": settings.options} if settings.options else {}),
        "search": settings.search.name,
        "seed": settings.seed,
        "budget": budget,
        "executions": campaign.executions,
        "failed": len(campaign.failed),
        "failures": failures_of(campaign.failed),
        "controllers": designs_sentence(campaign.trials),
        "worst": worst_of(campaign.worst),
        "estimate": campaign.estimate,
        "interval": None if campaign.worst is None else [campaign.worst.distance, usable_bound(bound)],
        "units": experiment.units,
        **(dict.fromkeys(("verdict", "reason", "rests_on", "threshold")) if verdict is None else verdict.to_json()),
        "certificate": None if bound is None else bound.to_json(),
        "expected": None if verdict is None or verdict.expected is None else asdict(verdict.expected),
        "store": str(path),
        "other_stores": [str(other) for other in other_stores(path)],
    }
    if truth is not None:
        task = campaign.validation.space.describe_point(truth.parameters.points)
        report["truth"] = {"distance": truth.distance, "task": task, "method": truth.method}
        estimate = campaign.estimate
        report["error_percent"] = None if estimate is None else 100 * (truth.distance - estimate) / truth.distance
    return report


def _print_report(report: dict[str, Any], verdict: Verdict | None, bound: Certificate | None) -> None:
    if verdict is not None:
        print_verdict(verdict, report["units"])
    elif bound is not None:
        print_table({"certificate": bound.doubt or bound.statement})
    elif report["controllers"]:  # a verdict says it
        out.say(f"{report['controllers']}.", wrap=True)
    print_failures(report["failures"])
    executions = f"{report['executions']} of at most {report['budget']}"
    failed = f", of which {report['failed']} failed" if report["failed"] else ""
    rows: dict[str, Any] = {"executions": f"{executions}{failed}"}
    rows |= {name: report[name] for name in ("worst", "truth", "error_percent", "store", "report") if name in report}
    print_table(rows, units=report["units"])
    if verdict is not None:
        print_other_stores(report["other_stores"])
