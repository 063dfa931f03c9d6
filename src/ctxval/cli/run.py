"""``ctxval run``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval import plot
from ctxval._util.texts import reason_of
from ctxval.campaign.campaign import Campaign
from ctxval.certificates.verdict import Verdict, require_threshold
from ctxval.cli.base import (
    CANNOT_GO_ON,
    FALSIFIED,
    RESOLUTION_HELP,
    AsJson,
    Dask,
    Timeout,
    Workers,
    app,
    certificate_of,
    command,
    err,
    failures_of,
    print_failures,
    print_other_stores,
    print_table,
    print_verdict,
    progress,
    say_error,
    worker_options,
    worst_of,
)
from ctxval.cli.case_options import CaseOptions, case_options
from ctxval.cli.trust import AcceptChange
from ctxval.config.settings import Settings, read_settings
from ctxval.core.experiment import Experiment
from ctxval.core.truth import Truth
from ctxval.errors import InputError
from ctxval.storage.other_stores import other_stores


@app.command()
@command
def run(
    target: Annotated[str, typer.Argument(metavar="CASE|FILE.toml|module:attr", help="What to validate.")],
    budget: Annotated[int | None, typer.Option(help="Executions of the system in all, earlier ones counted.")] = None,
    search: Annotated[str | None, typer.Option(help="How tasks are chosen: auto, gp-ucb, random, ...")] = None,
    threshold: Annotated[float | None, typer.Option(help="Largest distance that you can accept.")] = None,
    confidence: Annotated[float | None, typer.Option(help="Of a validation, at least 0.5; 0.95 if not given.")] = None,
    until_decided: Annotated[
        bool, typer.Option("--until-decided", help="Stop as soon as the verdict is reached; the budget is the most.")
    ] = False,
    stochastic: Annotated[
        bool | None,
        typer.Option("--stochastic", help="Executions of one task may differ; what is judged is the expected one."),
    ] = None,
    resolution: Annotated[
        float | None,
        typer.Option(help=RESOLUTION_HELP),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the data, the model and the search.")] = None,
    store: Annotated[Path | None, typer.Option(help="File of the trials; it is resumed if it exists.")] = None,
    truth: Annotated[bool, typer.Option("--truth", help="Find the true maximum too, of a simulated system.")] = False,
    workers: Workers = None,
    dask: Dask = None,
    timeout: Timeout = None,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
    option: CaseOptions = None,
    variant: Annotated[str | None, typer.Option(help="Variant of a case; the same as --option variant=...")] = None,
    model: Annotated[str | None, typer.Option(help="Learned model of a case; the same as --option model=...")] = None,
    dim: Annotated[int | None, typer.Option(help="Number of states of a case; the same as --option dim=...")] = None,
) -> Any:
    """Search for the task at which the system differs most from its model."""
    options = case_options(option, variant=variant, model=model, dim=dim)
    given = {"budget": budget, "search": search, "threshold": threshold, "confidence": confidence, "seed": seed}
    settings = read_settings(target, {**given, "store": store, "options": options})
    said = {"stochastic": stochastic, "resolution": resolution}
    settings = settings.certified_as({key: value for key, value in said.items() if value is not None})
    experiment = settings.load()
    if truth:
        _require_truth(experiment)  # before executions are paid for
    chosen = experiment.threshold if settings.threshold is None else settings.threshold
    limit = None if chosen is None else require_threshold(chosen)
    path = settings.store_path(experiment.name)
    campaign = settings.campaign(experiment, path, accept_change=accept_change)
    total = experiment.budget if settings.budget is None else settings.budget
    execute = _until_decided(campaign, limit, settings) if until_decided else campaign.run
    with worker_options(workers, dask, timeout) as execution, progress(campaign, total, show=not as_json) as on_trial:
        execute(budget=total, on_trial=on_trial, **execution)
    known = experiment.truth() if truth and experiment.truth is not None else None
    verdict = None if limit is None else campaign.verdict(limit, certificate=settings.certificate_options)
    report = _report(campaign, experiment, settings, total, path, verdict, known)
    report["pictures"] = [str(picture) for picture in _save_pictures(campaign, experiment, path)]
    if not as_json:
        _print_report(report, verdict)
    if campaign.failed and not campaign.completed:
        say_error(f"all {len(campaign.failed)} executions failed, so there is no distance.")
        return report, CANNOT_GO_ON
    return report, FALSIFIED if verdict is not None and verdict.answer == "falsified" else 0


def _until_decided(campaign: Campaign, threshold: float | None, settings: Settings) -> Callable[..., Campaign]:
    if threshold is None:
        raise InputError("--until-decided needs a threshold to decide about; say --threshold.")
    return functools.partial(campaign.run_until_decided, threshold, certificate=settings.certificate_options)


def _require_truth(experiment: Experiment) -> None:
    if experiment.truth is None:
        raise InputError(
            f"the truth of {experiment.name!r} is not known: only cases, and experiments that say it, have it."
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


def _save_pictures(campaign: Campaign, experiment: Experiment, path: Path) -> list[Path]:
    try:
        return _draw_pictures(campaign, experiment, path)
    except Exception as error:
        # A picture must not hide the verdict that was paid for.
        err.say(f"no pictures: {reason_of(error)}")
        return []


def _draw_pictures(campaign: Campaign, experiment: Experiment, path: Path) -> list[Path]:
    if campaign.worst is None:
        return []
    drawn = [
        plot.save(
            plot.worst_trajectories(campaign, states=experiment.states, inputs=experiment.inputs),
            path.with_suffix(".worst.png"),
        )
    ]
    if len(campaign.completed) >= 2:
        figure = plot.surrogate(campaign, truth=_true_curve(experiment), units=experiment.units)
        drawn.append(plot.save(figure, path.with_suffix(".surrogate.png")))
    return drawn


def _true_curve(experiment: Experiment) -> plot.Curve | None:
    """Return the distance on a grid, where that is cheap: a simulated system over one parameter."""
    space = experiment.validation.space
    if experiment.truth is None or space.dimension > 1:
        return None
    points = space.grid(401)
    return plot.Curve(points[:, 0], experiment.validation.distances(points))


def _print_report(report: dict[str, Any], verdict: Verdict | None) -> None:
    apart = (
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
    print_failures(report["failures"])
    if verdict is not None:
        print_verdict(verdict)
        print_other_stores(report["other_stores"])
