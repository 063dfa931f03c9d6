"""``ctxval compare`` and ``ctxval refine``: which of several models is better, and how one becomes better."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctxval._util.files import write_text
from ctxval._util.texts import reason_of
from ctxval.campaign import plot
from ctxval.campaign.campaign import Campaign
from ctxval.certificates import CertificateOptions
from ctxval.certificates.options import CONFIDENCE
from ctxval.cli import base
from ctxval.cli.base import Allowed, command, err, named_values, out, print_columns, require_outputs
from ctxval.cli.config.references import reference, require_function
from ctxval.cli.config.settings import Settings, read_settings
from ctxval.cli.config.stored_settings import budget_of, limit_of, open_target
from ctxval.cli.recordings import StepFunction, print_parameters, require_model_file
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.studies.comparison import compare as run_comparison
from ctxval.studies.comparison.candidates import require_comparable
from ctxval.studies.comparison.compare import BUDGET, store_name
from ctxval.studies.comparison.result import CANDIDATES, PAIRS, WORDS, Comparison
from ctxval.studies.fitting.model_file import require_file_of
from ctxval.studies.refinement import CauseRepair, Method, ParameterFit, Refinement, refine
from ctxval.studies.refinement.methods import NAMES, UserFit, method_of
from ctxval.studies.refinement.rounds import write_refined


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
    out_: Path | None = None,
    force: bool = False,
    option: list[str] | None = None,
) -> Any:
    picture = None if out_ is None else out_.with_suffix(".png")
    require_outputs({"--out .md": out_, "its picture": picture}, candidates, force=force)
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
    files = []
    if out_ is not None:
        files.append(str(write_text(out_, comparison.to_markdown())))
        try:
            files.append(str(plot.save(comparison.plot(), out_.with_suffix(".png"))))
        except Exception as error:  # it must not hide the decisions, for which executions were paid
            err.say(f"no picture: {reason_of(error)}")
    paths = {name: str(campaign.store.path) for name, campaign in campaigns.items()}
    return {**comparison.to_dict(), "stores": paths, "failures": failures, "files": files}


def _candidates(texts: Sequence[str], folder: Path, seed: int, options: dict[str, Any]) -> dict[str, Campaign]:
    """Return the campaigns of the candidates. A refused comparison leaves no store that a later one would find.

    The name of a candidate is the one that is given, or else the text without folder and suffix.
    """
    settings: dict[str, Settings] = {}
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
    out.say(
        f"{comparison.executions} executions of at most {comparison.budget}. All decisions hold together with "
        f"confidence {comparison.confidence:.6g}.{units} They assume that",
        wrap=True,
    )
    for assumption in comparison.assumptions:
        out.say(f"- {assumption};", wrap=True)


@command("refine", methods=", ".join(NAMES))
def refine_model(
    target: str,
    allowed: Allowed,
    function: StepFunction,
    threshold: float | None = None,
    budget: int | None = None,
    method: str = "residual",
    fit: str | None = None,
    out_: Path | None = None,
    force: bool = False,
    confidence: float | None = None,
    seed: int | None = None,
    workers: int | None = None,
    timeout: float | None = None,
    option: list[str] | None = None,
) -> Any:
    known = _method(method, fit, function)
    if known is None and out_ is not None:
        raise InputError("--out is not for --method causes: `ctxval why` prints the lines that make its model.")
    require_model_file(out_, [target, allowed.experiment], force=force)
    opened = open_target(target, {"seed": seed, "options": named_values(option) or None}, allowed)
    chosen = CauseRepair(opened.campaign) if known is None else known
    settings = opened.settings
    if confidence is not None:
        settings = settings.model_copy(update={"confidence": confidence})
    limit = limit_of(opened.experiment, settings, threshold)
    if limit is None:
        raise InputError("a refinement needs a threshold: give --threshold.")
    if out_ is not None:
        require_file_of(out_, chosen.name, chosen.makes, opened.campaign.validation.model, function.step)
    if budget is None:
        budget = opened.campaign.executions + budget_of(opened.experiment, settings)

    def open_round(
        validation: Validation, store: Path | None, model_file: Path | None, certificate: CertificateOptions
    ) -> Campaign:
        """Return the campaign of a round, whose store names the experiment and the file of the model."""
        if model_file is None or store is None:  # the model cannot be read again, so other commands cannot load it
            search, name = settings.search.build(settings.folder), opened.experiment.name
            return Campaign(validation, search=search, store=store, seed=settings.seed, name=name)
        known = {"refined": model_file.resolve(), "confidence": certificate.confidence}
        experiment = replace(opened.experiment, validation=validation, truth=None)
        return settings.model_copy(update=known).campaign(experiment, store)

    refinement = refine(
        opened.campaign,
        limit,
        budget,
        method=chosen,
        certificate=settings.certificate_options,
        open_round=open_round,
        workers=workers,
        timeout=timeout,
    )
    _print_refinement(refinement)  # before the files are written, which may fail
    number = refinement.last.number
    files = [] if out_ is None or not number else write_refined(out_, refinement, function.step)
    if files:
        out.say(f"the model of round {number} is in {' and '.join(files)}")
    return {**refinement.to_dict(), "files": files}, base.FALSIFIED if refinement.answer == "falsified" else 0


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
    columns = (*refinement.head, "store")
    print_columns(columns, rows, left=len(columns))
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
