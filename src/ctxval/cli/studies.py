"""``ctxval compare``, ``refine`` and ``safe``: the better one of several models, a better one, and safe tasks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctxval import Campaign, Store, Validation
from ctxval._util.checked import PositiveFloat, PositiveInt, require
from ctxval._util.representation import task_text
from ctxval._util.texts import enumerated
from ctxval.certificates import CertificateOptions
from ctxval.certificates.options import CONFIDENCE
from ctxval.cli import base
from ctxval.cli.base import Allowed, command, named_values, notes, out, print_columns, print_table
from ctxval.cli.config.references import reference, require_function
from ctxval.cli.config.settings import ExperimentSettings, read_settings
from ctxval.cli.config.stored_settings import Limits, open_target
from ctxval.cli.recordings import StepFunction, print_parameters, require_model_file
from ctxval.errors import CtxvalError, InputError
from ctxval.specs import ReachAvoid
from ctxval.studies.comparison import compare as run_comparison
from ctxval.studies.comparison.candidates import require_comparable
from ctxval.studies.comparison.compare import BUDGET, store_name
from ctxval.studies.comparison.result import CANDIDATES, PAIRS, WORDS, Comparison
from ctxval.studies.fitting.model_file import require_file_of
from ctxval.studies.refinement import CauseRepair, Method, ParameterFit, Refinement, refine
from ctxval.studies.refinement.methods import NAMES, UserFit, method_of
from ctxval.studies.refinement.rounds import write_refined
from ctxval.studies.safety import DrawnTasks, SafetyReport, assess, draw_tasks, require_safe_tasks
from ctxval.studies.safety.draws import require_box


@command()
def compare(
    candidates: list[str],
    question: str = "both",
    budget: int = BUDGET,
    confidence: float | None = None,
    seed: int = 0,
    stores: Path = Path("runs/compare"),
    largest_possible: float | None = None,
    stochastic: bool = False,
    option: list[str] | None = None,
) -> Any:
    campaigns = _candidates(candidates, stores, seed, named_values(option))
    comparison = run_comparison(
        campaigns,
        question=question,  # type: ignore[arg-type]  # it refuses other words
        budget=budget,
        confidence=CONFIDENCE if confidence is None else confidence,
        seed=seed,
        largest_possible=largest_possible,
        stochastic=stochastic,
    )
    failures = {name: base.failures_of(campaign.failed) for name, campaign in campaigns.items()}
    _print_comparison(comparison)
    for value in failures.values():
        base.print_failures(value)
    paths = {name: str(campaign.store.path) for name, campaign in campaigns.items()}
    return {**comparison.to_json(), "stores": paths, "failures": failures}


def _candidates(texts: Sequence[str], folder: Path, seed: int, options: dict[str, Any]) -> dict[str, Campaign]:
    """Return the campaigns of the candidates. A refused comparison leaves no store that a later one would find."""
    settings: dict[str, ExperimentSettings] = {}
    for text in texts:
        before, equals, after = text.partition("=")
        named = bool(equals) and before.isidentifier()
        target = after if named else text
        name = before if named else os.path.basename(target).removesuffix(".toml")
        if name in settings:
            raise InputError(f"two candidates are called {name}: give one another name, as in NAME={target}.")
        case, colon, rest = target.partition(":")
        given: dict[str, Any] = {"seed": seed, "options": options}
        if colon and "=" in rest:  # a case with options of its own, such as arm:model=gp
            target, given["options"] = case, {**options, **named_values(rest.split(","))}
        settings[name] = read_settings(target, given)
    loaded = {name: each.load() for name, each in settings.items()}
    require_comparable({name: experiment.validation for name, experiment in loaded.items()})
    return {name: each.campaign(loaded[name], folder / f"{store_name(name)}.sqlite") for name, each in settings.items()}


def _print_comparison(comparison: Comparison) -> None:
    for question in comparison.questions:
        out.say((f"{WORDS[question]}: ", "bold"), comparison.ranking_text(question), wrap=True)
    for headers, results in ((CANDIDATES, comparison.candidates), (PAIRS, comparison.pairs)):
        out.say("")
        print_columns(headers, [result.cells for result in results], left=len(headers))
    out.say("")
    for pair in comparison.pairs:
        out.say(f"{pair.first}, {pair.second}: {pair.reason}.", wrap=True)
    units = f" The distances are in {comparison.units}." if comparison.units else ""
    together = f"All decisions hold together with confidence {comparison.confidence:.6g}.{units} They assume that"
    out.say(f"{comparison.executions} executions of at most {comparison.budget}. {together}", wrap=True)
    for assumption in comparison.assumptions:
        out.say(f"- {assumption};", wrap=True)


@command("refine", methods=", ".join(NAMES))
def refine_model(
    target: str,
    allowed: Allowed,
    function: StepFunction,
    limits: Limits,
    parallel: base.Parallel,
    method: str = "residual",
    fit: str | None = None,
    out_: Path | None = None,
    force: bool = False,
    confidence: float | None = None,
    thinking: float | None = None,
    seed: int | None = None,
    option: list[str] | None = None,
) -> Any:
    known = _method(method, fit, function)
    if known is None and out_ is not None:
        raise InputError("--out is not for --method causes: `ctxval why` prints the lines that make its model.")
    require_model_file(out_, [target, allowed.experiment], force=force)
    opened = open_target(target, {"seed": seed, "options": named_values(option) or None}, allowed)
    settings = opened.settings
    seconds = base.stated_seconds(thinking, settings.thinking)
    chosen = CauseRepair(opened.campaign, seconds) if known is None else known
    if confidence is not None:
        settings = settings.model_copy(update={"confidence": confidence})
    limit, total = limits.completed_by(settings, opened.experiment)
    if limit is None:
        raise InputError("a refinement needs a threshold: give --threshold.")
    if out_ is not None:
        require_file_of(out_, chosen.name, chosen.makes, opened.campaign.validation.model, function.step)
    if limits.budget is None:
        total += opened.campaign.executions

    def open_round(validation: Validation, store: Path, model_file: Path, certificate: CertificateOptions) -> Campaign:
        """Return the campaign of a round, whose store names the experiment and the file of the model."""
        known = {"refined": model_file.resolve(), "confidence": certificate.confidence}
        experiment = replace(opened.experiment, validation=validation, truth=None)
        return settings.model_copy(update=known).campaign(experiment, store)

    refinement = refine(
        opened.campaign,
        limit,
        total,
        method=chosen,
        certificate=settings.certificate_options,
        open_round=open_round,
        thinking=seconds,
        workers=parallel.workers,
        timeout=parallel.timeout,
    )
    _print_refinement(refinement)  # before the files are written, which may fail
    number = refinement.last.number
    files = [] if out_ is None or not number else write_refined(out_, refinement, function.step)
    if files:
        out.say(f"the model of round {number} is in {' and '.join(files)}")
    return {**refinement.to_json(), "files": files}, base.FALSIFIED if refinement.answer == "falsified" else 0


def _method(name: str, fit: str | None, function: StepFunction) -> Method | None:
    """Return a method; None for one that needs the campaign."""
    if (fit is not None) != (name == "fit"):
        raise InputError("--method fit and --fit MODULE:ATTR must be given together.")
    if bool(function.parameter) != (name == "parameters"):
        raise InputError("--method parameters and --parameter must be given together.")
    if function.step is not None and name != "parameters":
        raise InputError("--step is for --method parameters.")
    if name == "causes":
        return None
    if fit is not None:
        return UserFit(require_function(f"--fit {fit}", reference(fit), "(data) -> model"))
    if name != "parameters":
        return method_of(name)
    return ParameterFit(function.bounds, function.load(), function.vectorized)


def _print_refinement(refinement: Refinement) -> None:
    rows = [(*each.cells, each.store.name if each.store else "-") for each in refinement.rounds]
    print_columns((*refinement.head, "store"), rows, left=len(refinement.head) + 1)
    for each in refinement.rounds:
        for note in each.notes:
            out.say((f"round {each.number}: ", "bold"), note, wrap=True)
    out.say((refinement.answer, "bold"), f" against {refinement.threshold:g}: {refinement.ended}.", wrap=True)
    out.say(refinement.last.verdict.reason, wrap=True)
    out.say(refinement.statement, wrap=True)
    print_parameters(refinement.parameters)
    if (residual := refinement.residual) is not None:
        out.say(("residual of one step", "bold"), ", measured on executions that the model was not learned from:")
        for row in residual.text.splitlines():
            out.say(row)
        out.say(f"measured for {residual.range_text}; it is not guaranteed, and nothing is known outside.", wrap=True)


@command()
def safe(
    target: str,
    parallel: base.Parallel,
    margin: float | None = None,
    budget: int | None = None,
    confidence: float | None = None,
    audit: int | None = None,
    seed: int | None = None,
    store: Path | None = None,
    accept_change: str | None = None,
) -> Any:
    require("margin", PositiveFloat | None, margin)
    require("audit", PositiveInt | None, audit)
    given = read_settings(target, {"budget": budget, "confidence": confidence, "seed": seed})
    if given.spec is None:
        raise InputError(f"{target} has no table [spec] with sets to avoid or to reach.")
    table = given.spec if margin is None else given.spec.model_copy(update={"margin": margin})
    asked: dict[str, Any] = {"spec": table, "judge": "spec", "threshold": table.margin, "explore": False}
    if given.certificate.kind == "auto":  # a Gaussian process of a distance with kinks would be no evidence
        asked["certificate"] = given.certificate.model_copy(update={"kind": "dynamics"})
    settings = given.model_copy(update=asked)
    experiment = settings.load()
    usual = settings.store_path(experiment.name)
    # It is not the store of a campaign of the experiment's own distance.
    path = usual.with_name(f"{usual.stem}.safe{usual.suffix}") if store is None else store
    if audit is not None:
        require_box(experiment.validation)
    share = require_safe_tasks(experiment.validation)
    again = _has_another_margin(path, settings)
    campaign = settings.campaign(experiment, path, accept_change=accept_change, remeasure=again)
    total, certificate = Limits().completed_by(settings, experiment)[1], settings.certificate_options
    units, wanted = experiment.units, f"{100 * share:.0f} % of the drawn tasks satisfy the specification on the model"
    if table.margin is not None:
        wanted += f" with the margin {table.margin:g} {units}".rstrip()
    out.say((experiment.name, "bold"), f": {wanted}", wrap=True)
    certificate.kind.require_usable(certificate.confidence, total)
    campaign.run(
        total, table.margin, certificate=certificate, explore=False, workers=parallel.workers, timeout=parallel.timeout
    )
    report, drawn = assess(campaign, certificate), None
    if audit is not None:
        least = report.d_b if report.d_b_bound is None else report.d_b_bound
        beside = path.with_name(f"{path.stem}.draws-above-{least:.6g}{path.suffix}")
        drawn = draw_tasks(campaign, least, audit, store=beside, confidence=certificate.confidence)
    _print_safety(report, drawn)
    failures = base.failures_of(campaign.failed)
    base.print_failures(failures)
    out.say(f"store: {path}")
    summary = {**report.to_json(), "drawn": drawn and vars(drawn), "budget": total, "failures": failures}
    return {**summary, "store": str(path)}, base.FALSIFIED if report.answer == "falsified" else 0


def _has_another_margin(path: Path, settings: ExperimentSettings) -> bool:
    """Return whether a store was made for another margin, so that its distances are computed again."""
    kept = None
    with suppress(CtxvalError):  # the campaign says it
        if path.exists() and path.stat().st_size:
            kept = Store.existing(path).settings().get("spec")
    if not isinstance(kept, dict) or kept.get("margin") == (settings.spec and settings.spec.margin):
        return False
    notes.say(f"{path} was made for another margin: the distances of its executions are computed again.")
    return True


def _print_safety(report: SafetyReport, drawn: DrawnTasks | None) -> None:
    def of(value: float | None) -> str:
        return "unknown" if value is None else f"{value:.4g} {report.units}".rstrip()

    if report.answer is not None and report.margin is not None:
        out.say((report.answer.upper(), f"bold {base.COLOURS[report.answer]}"), f": margin {of(report.margin)}")
    out.say(report.statement[0].upper() + report.statement[1:], wrap=True)
    executed, predicted = "largest executed", "predicted to be at most"
    certified = "not certified" if report.d_b_bound is None else f"certified at most {of(report.d_b_bound)}"
    rows = {"largest deviation": f"{executed} {of(report.d_a)}, {predicted} {of(report.d_a_bound)}"}
    rows["largest margin of an unsafe task"] = f"{executed} {of(report.d_b)}, {certified}"
    if report.share_by_deviation is not None:
        rows["safe if no deviation is larger"] = f"{100 * report.share_by_deviation:.1f} %, which is not certified"
    if report.tightened is not None:
        if report.tightened.avoid:
            rows["avoid on the model"] = enumerated([repr(part) for part in report.tightened.avoid], 6)
        if report.tightened.reach is not None:
            rows["reach on the model"] = repr(report.tightened.reach)
    elif report.d_b_bound is not None and isinstance(report.spec, ReachAvoid):
        rows["sets on the model"] = "nothing is left of a set that grows or shrinks by the bound"
    if drawn is not None:
        counts = f"{drawn.unsafe} of {drawn.draws} tasks with a margin above {of(drawn.margin)} are unsafe"
        most = f"at most {100 * drawn.share:.3g} % of them, with {100 * drawn.confidence:g} % confidence"
        rows["independent draws"] = f"{counts}: {most}"
    rows["between recorded times"] = f"the system moves by up to {of(report.between)}, which is not seen"
    rows["executions"] = str(report.executions)
    print_table(rows)
    for task in report.counterexamples[:5]:
        where = task_text(task.parameters)
        out.say(f"unsafe: {where}: {of(task.on_model)} on the model, {of(task.on_system)} on the system", wrap=True)
    if len(report.counterexamples) > 5:
        out.say(f"and {len(report.counterexamples) - 5} other unsafe tasks.")
