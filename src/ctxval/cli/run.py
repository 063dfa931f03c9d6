"""``ctxval run``: search for the worst task and give the verdict."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval import plot
from ctxval._util.texts import reason_of
from ctxval.campaign.campaign import Campaign
from ctxval.certificates.verdict import Verdict
from ctxval.cli.base import (
    CANNOT_GO_ON,
    FALSIFIED,
    certificate_of,
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
    SEARCH_METHODS,
    TARGET,
    AsJson,
    Confidence,
    Dask,
    PartOptions,
    Resolution,
    Stochastic,
    Threshold,
    Timeout,
    Workers,
    named_values,
)
from ctxval.cli.report import page_path
from ctxval.cli.trust import AcceptChange, limit_of, require_limit
from ctxval.config.settings import Settings, read_settings
from ctxval.core.experiment import Experiment
from ctxval.core.trial import designs_sentence
from ctxval.core.truth import Truth
from ctxval.errors import InputError
from ctxval.report.context import context_of_campaign
from ctxval.report.page import write_page
from ctxval.storage.other_stores import other_stores

Target = Annotated[
    str,
    typer.Argument(
        metavar=TARGET, help="Experiment to run: a case, an experiment file, or a reference to an object in Python."
    ),
]
Budget = Annotated[
    int | None,
    typer.Option(
        help="Maximum number of executions of the system, including earlier ones in the store (default: the budget of "
        "the experiment)."
    ),
]
SearchName = Annotated[str | None, typer.Option(help=f"Search method: {SEARCH_METHODS} (default: auto).")]
UntilDecided = Annotated[
    bool,
    typer.Option(
        "--until-decided",
        help="Execute the tasks that decide fastest, and stop as soon as the model is validated or falsified, or when "
        "the budget is spent. The executions are chosen for the bound from learned dynamics if trajectories teach "
        "them, and otherwise for the posterior bound of the distance.",
    ),
]
Audited = Annotated[
    bool,
    typer.Option(
        "--audited",
        help="Before learned dynamics validate the model, predict and execute eight fresh random tasks. Only with "
        "--until-decided.",
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
    until_decided: UntilDecided = False,
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
    as_json: AsJson = False,
    option: PartOptions = None,
    variant: Variant = None,
    model: ModelName = None,
    dim: Dimension = None,
) -> Any:
    """Search for the task at which the system differs most from its model.

    If the store exists, the campaign is resumed. Options that are not given have the values in the experiment file.
    """
    options = named_values(option, variant=variant, model=model, dim=dim)
    given = {"budget": budget, "search": search, "threshold": threshold, "confidence": confidence, "seed": seed}
    loop = {"until_decided": until_decided or None, "audited": audited or None}
    settings = read_settings(target, {**given, **loop, "store": store, "options": options})
    settings = settings.certified_as({"stochastic": stochastic, "resolution": resolution})
    experiment = settings.load()
    if settings.audited and not settings.until_decided:
        raise InputError("--audited needs --until-decided.")
    certificate = settings.certificate_options
    if truth:
        _require_truth(experiment)  # before executions are paid for
    limit = limit_of(experiment, settings)
    path = settings.store_path(experiment.name)
    campaign = settings.campaign(experiment, path, accept_change=accept_change)
    total = experiment.budget if settings.budget is None else settings.budget
    if limit is not None:
        certificate.kind.require_usable(certificate.confidence, total)  # before executions are paid for
    execute: Callable[..., Campaign] = campaign.run
    if settings.until_decided:
        wanted = require_limit(experiment, settings, None, "--until-decided")
        execute = functools.partial(
            campaign.run_until_decided, wanted, certificate=certificate, audited=settings.audited
        )
    with worker_options(workers, dask, timeout) as execution:
        execute(budget=total, **execution)
    known = experiment.truth() if truth and experiment.truth is not None else None
    verdict = None if limit is None else campaign.verdict(limit, certificate=certificate)
    report = _report(campaign, experiment, settings, total, path, verdict, known)
    report["pictures"] = [str(picture) for picture in _save_pictures(campaign, experiment, path, verdict)]
    if with_report:
        report["report"] = _save_report(campaign, verdict, total, path)
    if not as_json:
        _print_report(report, verdict)
    return report, _status(campaign, verdict)


def _status(campaign: Campaign, verdict: Verdict | None) -> int:
    """Return the exit status of a run; if all executions failed, print an error."""
    if campaign.failed and not campaign.completed:
        say_error(f"all {len(campaign.failed)} executions failed, so there is no distance.")
        return CANNOT_GO_ON
    return FALSIFIED if verdict is not None and verdict.answer == "falsified" else 0


def _require_truth(experiment: Experiment) -> None:
    if experiment.truth is None:
        raise InputError(
            f"the true maximum of {experiment.name!r} is not known. Only experiments with a `truth` function have it, "
            "such as the cases of the paper."
        )


def _report(
    campaign: Campaign,
    experiment: Experiment,
    settings: Settings,
    budget: int,
    path: Path,
    verdict: Verdict | None,
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
        "units": experiment.units,
        "verdict": None if verdict is None else verdict.answer,
        "reason": None if verdict is None else verdict.reason,
        "rests_on": None if verdict is None else verdict.rests_on,
        "threshold": None if verdict is None else verdict.threshold,
        **certificate_of(verdict),
        "store": str(path),
        "other_stores": [str(other) for other in other_stores(path)],
    }
    if truth is not None:
        task = campaign.validation.space.describe_point(truth.parameters.points)
        report["truth"] = {"distance": truth.distance, "task": task, "method": truth.method}
        estimate = campaign.estimate
        report["error_percent"] = None if estimate is None else 100 * (truth.distance - estimate) / truth.distance
    return report


def _save_pictures(campaign: Campaign, experiment: Experiment, path: Path, verdict: Verdict | None) -> list[Path]:
    try:
        if campaign.worst is None:
            return []
        drawn = [plot.save(plot.worst_trajectories(campaign), path.with_suffix(".worst.png"))]
        if len(campaign.completed) >= 2:
            figure = plot.surrogate(
                campaign,
                truth=_true_curve(experiment),
                threshold=None if verdict is None else verdict.threshold,
                bound=None if verdict is None else verdict.bound,
            )
            drawn.append(plot.save(figure, path.with_suffix(".surrogate.png")))
        return drawn
    except Exception as error:
        # An error in a figure must not hide the verdict, for which executions were paid.
        err.say(f"no pictures: {reason_of(error)}")
        return []


def _save_report(campaign: Campaign, verdict: Verdict | None, budget: int, path: Path) -> str | None:
    """Write the report next to the store and return its path; None if it cannot be written."""
    try:
        return str(write_page(context_of_campaign(campaign, verdict, budget=budget), page_path(path)))
    except Exception as error:
        # The same holds for an error in the report.
        err.say(f"no report: {reason_of(error)}")
        return None


def _true_curve(experiment: Experiment) -> plot.Curve | None:
    """Return the distance on a grid if this is cheap, that is, for a simulated system and one task parameter."""
    space = experiment.validation.space
    if experiment.truth is None or space.dimension > 1:
        return None
    points = space.grid(401)
    return plot.Curve(points[:, 0], experiment.validation.distances(points))


def _print_report(report: dict[str, Any], verdict: Verdict | None) -> None:
    apart = (
        "controllers",
        "failures",
        "verdict",
        "reason",
        "rests_on",
        "threshold",
        "units",
        "certificate",
        "expected",
        "other_stores",
    )
    shown = {key: value for key, value in report.items() if key not in apart}
    print_table(shown, units=report["units"])
    if verdict is None and report["controllers"]:  # a verdict says it
        out.say(f"{report['controllers']}.", wrap=True)
    print_failures(report["failures"])
    if verdict is not None:
        print_verdict(verdict)
        print_other_stores(report["other_stores"])
