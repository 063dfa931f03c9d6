"""The command line: a thin skin over the public interface."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ctxval import cases as known_cases
from ctxval import plot
from ctxval.campaign import Campaign
from ctxval.certificates import KINDS, Certificate, Options, Sample, TheoremConstants, certify
from ctxval.config import Settings, read_settings, stored_settings
from ctxval.describe import describe
from ctxval.errors import CertificateError, CtxvalError, InputError, StoreError, UnknownNameError
from ctxval.experiment import Experiment
from ctxval.store import Store
from ctxval.trial import Trial
from ctxval.truth import Truth
from ctxval.verdict import CONFIDENCE, Verdict, counterexample, is_decided, judge, judge_by, require_threshold

FALSIFIED, BAD_INPUT, CANNOT_GO_ON, INTERRUPTED = 1, 2, 3, 130
_BAD = (InputError, StoreError, CertificateError)

app = typer.Typer(
    name="ctxval",
    help="Decide whether a learned model of a robot can be trusted for the control tasks it is meant for.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
_out = Console()
_err = Console(stderr=True)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


def main() -> None:
    """Run the command line."""
    app()


def _command(function: Callable[..., Any]) -> Callable[..., Any]:
    """Turn ctxval's errors into one sentence and an exit status."""

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except CtxvalError as error:
            _err.print(f"[bold red]error:[/] {_escaped(str(error))}", highlight=False, soft_wrap=True)
            raise typer.Exit(BAD_INPUT if isinstance(error, _BAD) else CANNOT_GO_ON) from None
        except (typer.Exit, typer.Abort):
            raise
        except KeyboardInterrupt:
            _err.print("stopped; what was executed is stored, run the same command to go on.")
            raise typer.Exit(INTERRUPTED) from None
        except (Exception, SystemExit) as error:
            # Python's own exit status here would be 1, which says that a model is falsified.
            _err.print(f"[bold red]error:[/] {_escaped(f'{type(error).__name__}: {error}')}", highlight=False)
            raise typer.Exit(CANNOT_GO_ON) from None

    return wrapped


@app.command()
@_command
def run(
    target: Annotated[str, typer.Argument(metavar="CASE|FILE.toml|module:attr", help="What to validate.")],
    budget: Annotated[int | None, typer.Option(help="Executions of the system in all, earlier ones counted.")] = None,
    search: Annotated[str | None, typer.Option(help="How tasks are chosen: gp-ucb, random, ...")] = None,
    threshold: Annotated[float | None, typer.Option(help="Largest distance that you can accept.")] = None,
    confidence: Annotated[float | None, typer.Option(help="Of a validation; 0.95 if not given.")] = None,
    until_decided: Annotated[
        bool, typer.Option("--until-decided", help="Stop as soon as the verdict is reached; the budget is the most.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Of the data, the model and the search.")] = None,
    store: Annotated[Path | None, typer.Option(help="File of the trials; it is resumed if it exists.")] = None,
    truth: Annotated[bool, typer.Option("--truth", help="Find the true maximum too, of a simulated system.")] = False,
    as_json: AsJson = False,
    variant: Annotated[str | None, typer.Option(help="Variant of a case.")] = None,
    model: Annotated[str | None, typer.Option(help="Which learned model of a case.")] = None,
    dim: Annotated[int | None, typer.Option(help="Number of states of a case.")] = None,
) -> None:
    """Search for the task at which the system differs most from its model."""
    options = {k: v for k, v in {"variant": variant, "model": model, "dim": dim}.items() if v is not None}
    given = {"budget": budget, "search": search, "threshold": threshold, "confidence": confidence, "seed": seed}
    settings = read_settings(target, {**given, "store": store, "options": options})
    experiment = settings.load()
    chosen = experiment.threshold if settings.threshold is None else settings.threshold
    limit = None if chosen is None else require_threshold(chosen)
    path = settings.store_path(experiment.name)
    campaign = Campaign(
        experiment.validation, search=settings.search.build(), store=path, seed=settings.seed, name=experiment.name
    )
    campaign.store.keep_settings(settings.model_dump(mode="json", exclude={"store"}))
    total = experiment.budget if settings.budget is None else settings.budget
    until = _decided(limit, settings.confidence) if until_decided else None
    _run_with_progress(campaign, total, until, show=not as_json)
    known = _truth(experiment) if truth else None
    verdict = None if limit is None else campaign.verdict(limit, settings.confidence)
    report = _report(campaign, experiment, settings, total, path, verdict, known)
    report["pictures"] = [str(picture) for picture in _save_pictures(campaign, experiment, path)]
    if as_json:
        print(json.dumps(describe(report), allow_nan=False))
    else:
        _print_report(report, verdict)
    if verdict is not None and verdict.answer == "falsified":
        raise typer.Exit(FALSIFIED)


@app.command("certify")
@_command
def certify_store(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="File of a campaign's trials.")],
    threshold: Annotated[float | None, typer.Option(help="Largest distance that you can accept.")] = None,
    confidence: Annotated[float, typer.Option(help="Of the certificate.")] = CONFIDENCE,
    kind: Annotated[str | None, typer.Option(help=f"One of {', '.join(KINDS)}.")] = None,
    audit: Annotated[
        int | None, typer.Option(help="Execute independent draws of tasks first, until there are so many in all.")
    ] = None,
    volume: Annotated[float, typer.Option(help="Share of the task space that may exceed the threshold.")] = 0.0,
    discard: Annotated[int | None, typer.Option(help="sampling-discarding: how many; chosen beforehand.")] = None,
    constant: Annotated[float | None, typer.Option(help="convergence: C, in the distance's units.")] = None,
    theorem: Annotated[
        str | None, typer.Option(help="convergence: SCALE,NOISE,A,B,GAIN that C is computed from (see the manual).")
    ] = None,
    stochastic: Annotated[
        bool, typer.Option("--stochastic", help="posterior: executions of one task may differ.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Say what the trials of a store prove, and with what confidence; nothing is executed but for an audit."""
    opened = Store.existing(store)
    limit = None if threshold is None else require_threshold(threshold)
    chosen = kind or ("posterior" if audit is None else "audit")
    options = Options(stochastic, discard, constant, _theorem(theorem))
    # All of it before an audit is paid for.
    _require_shares(confidence, volume)
    if chosen not in KINDS:
        raise UnknownNameError.among("certificate", chosen, KINDS)
    if audit is not None:
        _run_audit(opened, audit, show=not as_json)
    trials = opened.trials()
    found = None if limit is None else counterexample(trials, limit)
    certificate, refusal = _certificate(trials, chosen, confidence, options, needed=found is None)
    verdict = found if limit is None or certificate is None else judge_by(certificate, trials, limit, volume=volume)
    if verdict is not None and verdict.answer == "undecided" and chosen == "posterior":
        verdict = judge(trials, verdict.threshold, confidence, stochastic=stochastic)
    answer = {} if verdict is None else {"verdict": verdict.answer, "reason": verdict.reason, "threshold": limit}
    said = {"kind": chosen, "refused": refusal} if certificate is None else certificate.to_json()
    report = {**answer, **said, "expected": _certificate_of(verdict)["expected"], "store": str(store)}
    if as_json:
        print(json.dumps(describe(report), allow_nan=False))
    else:
        _print_certificate(certificate, verdict, refusal)
    if verdict is not None and verdict.answer == "falsified":
        raise typer.Exit(FALSIFIED)


def _require_shares(confidence: float, volume: float) -> None:
    if not 0 < confidence < 1:
        raise InputError(f"the confidence must be strictly between 0 and 1, got {confidence!r}.")
    if not 0 <= volume < 1:
        raise InputError(f"the volume must be a share of the task space, at least 0 and below 1, got {volume!r}.")


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


def _run_audit(store: Store, draws: int, *, show: bool) -> None:
    settings = stored_settings(store)
    experiment = settings.load()
    campaign = Campaign(
        experiment.validation, search=settings.search.build(), store=store, seed=settings.seed, name=experiment.name
    )
    drawn = sum(trial.origin == "iid" for trial in campaign.trials)
    with _progress(campaign, campaign.executions + max(0, draws - drawn), show=show) as on_trial:
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
        _out.print(
            f"[bold]{verdict.answer}[/] against {verdict.threshold:g}: {_escaped(verdict.reason)}", highlight=False
        )
    if certificate is None:
        _out.print(f"no certificate: {_escaped(str(refusal))}", highlight=False)
        return
    _out.print(f"{certificate.kind}: {_escaped(certificate.statement)}", highlight=False)
    if certificate.doubt is not None:
        _out.print(f"[bold red]withdrawn[/]: {_escaped(certificate.doubt)}.", highlight=False)
    _out.print("It assumes that", highlight=False)
    for assumption in certificate.assumptions:
        _out.print(f"- {_escaped(assumption)};", highlight=False)
    _print_table({**certificate.details, "trials": certificate.trials, "version": certificate.version})


@app.command()
@_command
def status(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="File of a campaign's trials.")],
    as_json: AsJson = False,
) -> None:
    """Say what a store holds; nothing is executed."""
    opened = Store.existing(store)
    description, trials = opened.description(), opened.trials()
    report = {
        "case": description.get("name"),
        "search": description.get("search", {}).get("type"),
        "seed": description.get("seed"),
        "executions": sum(trial.executed for trial in trials),
        "failed": sum(trial.state == "failed" for trial in trials),
        "open": sum(trial.state == "open" for trial in trials),
        "worst": _worst(
            max((t for t in trials if t.distance is not None), key=lambda t: t.distance or 0, default=None)
        ),
        "store": str(store),
    }
    if as_json:
        print(json.dumps(report))
    else:
        _print_table(report)


@app.command()
@_command
def cases(as_json: AsJson = False) -> None:
    """List the paper's systems that can be run by name."""
    if as_json:
        print(json.dumps(known_cases.NAMES))
        return
    _print_table(known_cases.NAMES)


@app.command()
@_command
def reproduce(
    name: Annotated[str, typer.Argument(metavar="STUDY|all", help="Which of the paper's figures, or all.")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer trials, coarser grids.")] = False,
    out: Annotated[
        Path, typer.Option(help="Folder of results, figures and data; what is in it is not run again.")
    ] = Path("reproduction"),
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
) -> None:
    """Run the paper's experiments: figures, their data, and the table of its claims."""
    from ctxval import reproduce as paper  # imported here: the other commands do not need it

    with Progress(TextColumn("runs"), *Progress.get_default_columns(), console=_err) as progress:
        line = progress.add_task("")
        table = paper.reproduce(
            name,
            out,
            scale=paper.QUICK if quick else paper.FULL,
            workers=workers,
            on_start=lambda missing: progress.update(line, total=missing),
            on_done=lambda job: progress.update(line, advance=1, description=job.key),
        )
    _out.print(f"table: {table}\nfigures and data: {out}", highlight=False)


def _decided(threshold: float | None, confidence: float) -> Callable[[Campaign], bool]:
    if threshold is None:
        raise InputError("--until-decided needs a threshold to decide about; say --threshold.")
    return lambda campaign: is_decided(campaign.trials, threshold, confidence)


def _run_with_progress(
    campaign: Campaign, budget: int, until: Callable[[Campaign], bool] | None, *, show: bool
) -> None:
    with _progress(campaign, budget, show=show) as on_trial:
        campaign.run(budget, on_trial, until=until)


@contextmanager
def _progress(campaign: Campaign, total: int, *, show: bool) -> Iterator[Callable[[Trial], None]]:
    columns = (
        TextColumn("executions"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TextColumn("largest distance {task.fields[best]}  {task.fields[pace]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=_err, disable=not show) as progress:
        line = progress.add_task("", total=total, completed=campaign.executions, best="-", pace="")

        def on_trial(trial: Trial) -> None:
            best = "-" if campaign.worst is None else f"{campaign.worst.distance:.4g}"
            progress.update(line, completed=campaign.executions, best=best, pace=_pace(trial))

        yield on_trial


def _pace(trial: Trial) -> str:
    return "" if trial.seconds is None else f"{trial.seconds:.2g} s/execution"


def _truth(experiment: Experiment) -> Truth:
    if experiment.truth is None:
        raise InputError(f"the truth of {experiment.name!r} is not known: its system is not simulated here.")
    return experiment.truth()


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
        "worst": _worst(campaign.worst),
        "estimate": campaign.estimate,
        "units": experiment.units,
        "verdict": None if verdict is None else verdict.answer,
        "reason": None if verdict is None else verdict.reason,
        "threshold": None if verdict is None else verdict.threshold,
        **_certificate_of(verdict),
        "store": str(path),
    }
    if truth is not None:
        task = campaign.validation.space.describe_point(truth.parameters.points)
        report["truth"] = {"distance": truth.distance, "task": task, "method": truth.method}
        estimate = campaign.estimate
        report["error_percent"] = None if estimate is None else 100 * (truth.distance - estimate) / truth.distance
    return report


def _certificate_of(verdict: Verdict | None) -> dict[str, Any]:
    """Return what stands behind a verdict, and what is expected of further executions."""
    if verdict is None:
        return {"certificate": None, "expected": None}
    return {
        "certificate": None if verdict.certificate is None else verdict.certificate.to_json(),
        "expected": None if verdict.expected is None else asdict(verdict.expected),
    }


def _worst(trial: Trial | None) -> dict[str, Any] | None:
    return None if trial is None else {"task": trial.parameters, "distance": trial.distance}


def _save_pictures(campaign: Campaign, experiment: Experiment, path: Path) -> list[Path]:
    try:
        return _draw_pictures(campaign, experiment, path)
    except Exception as error:
        # A picture must not hide the verdict that was paid for.
        _err.print(f"no pictures: {_escaped(f'{type(error).__name__}: {error}')}", highlight=False)
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
    apart = ("verdict", "reason", "threshold", "units", "certificate", "expected")
    shown = {key: value for key, value in report.items() if key not in apart}
    _print_table(shown, units=report["units"])
    if verdict is not None:
        _out.print(
            f"[bold]{verdict.answer}[/] against {verdict.threshold:g}: {_escaped(verdict.reason)}", highlight=False
        )


def _print_table(rows: dict[str, Any], units: str = "") -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in rows.items():
        table.add_row(key.replace("_", " "), _escaped(_text(value, units)))
    _out.print(table, highlight=False)


def _text(value: Any, units: str) -> str:
    match value:
        case None:
            return "-"
        case float():
            return f"{value:.4g}"
        case list():
            return ", ".join(_text(item, units) for item in value)
        case {"task": dict() as task, "distance": distance, **rest}:
            at = ", ".join(f"{name} = {_text(item, '')}" for name, item in task.items())
            how = f" ({rest['method']})" if "method" in rest else ""
            return f"{distance:.4g} {units} at {at}{how}"
        case dict():
            return ", ".join(f"{name} {_text(item, '')}" for name, item in value.items())
        case _:
            return str(value)


def _escaped(text: str) -> str:
    return text.replace("[", r"\[")


if __name__ == "__main__":
    main()
