"""``ctxval refine``: learn a better model from the executions that falsified one, and validate it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.campaign.campaign import Campaign
from ctxval.certificates import CertificateOptions
from ctxval.cli.base import FALSIFIED, command, out, print_columns
from ctxval.cli.commands import app
from ctxval.cli.model_options import (
    Parameters,
    StepFunction,
    Vectorized,
    print_parameters,
    require_model_file,
    step_function,
)
from ctxval.cli.options import (
    TARGET,
    AsJson,
    Confidence,
    PartOptions,
    Stochastic,
    Threshold,
    Timeout,
    Workers,
    named_values,
)
from ctxval.cli.outputs import Force
from ctxval.cli.trust import Named, Trust, budget_of, limit_of, open_target
from ctxval.config.references import reference, require_function
from ctxval.config.settings import Settings
from ctxval.core.experiment import Experiment
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.refinement import Method, ParameterFit, Refinement, refine
from ctxval.refinement.files import require_file_of, write_refined
from ctxval.refinement.methods import NAMES, UserFit, method_of

Target = Annotated[
    str,
    typer.Argument(
        metavar=f"STORE|{TARGET}",
        help="Store of the campaign that falsified the model (a .sqlite file), or an experiment, which is then run "
        "first.",
    ),
]
Budget = Annotated[
    int | None,
    typer.Option(
        help="Largest total number of executions of all rounds, including those in STORE (default: the executions in "
        "STORE and the budget of the experiment)."
    ),
]
MethodName = Annotated[
    str,
    typer.Option(
        help=f"How the model is learned again: {', '.join(NAMES)}. residual corrects the given model; linear, network "
        "and gaussian-process replace it; parameters estimates those of --step, or of the given model if it is a "
        "Parametric; fit calls the function of --fit."
    ),
]
Fit = Annotated[
    str | None,
    typer.Option(
        "--fit",
        metavar="MODULE:ATTR",
        help="Your function fit(data) -> model, for the method fit. It must return the same model for the same data.",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="File for the last model: .onnx, which a robot can load without ctxval, .npz, or .toml for the parameters "
        "of --step. Its measured residual is written next to it, as .residual.json and .residual.txt.",
    ),
]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of an experiment that is run first (default: 0).")]


@app.command("refine")
@command
def refine_model(
    target: Target,
    threshold: Threshold = None,
    budget: Budget = None,
    method: MethodName = "residual",
    fit: Fit = None,
    step: StepFunction = None,
    parameter: Parameters = None,
    vectorized: Vectorized = False,
    out_file: Out = None,
    force: Force = False,
    confidence: Confidence = None,
    stochastic: Stochastic = None,
    seed: Seed = None,
    workers: Workers = None,
    timeout: Timeout = None,
    experiment: Named = None,
    trust: Trust = False,
    option: PartOptions = None,
    as_json: AsJson = False,
) -> Any:
    """Learn a better model from the executions that falsified one, and validate it, until it is validated.

    Each refined model has a store and a file of its own next to STORE, such as cart.round-1.sqlite and
    cart.round-1.npz. Run the same command again to resume. An execution counts for the model on which its controller
    was designed, and for no other one; what was recorded goes on teaching.
    """
    chosen = _method(method, fit, step, parameter, vectorized)
    require_model_file(out_file, [target, experiment], force=force)
    opened = open_target(target, {"seed": seed, "option": named_values(option) or None}, experiment, trust)
    settings = opened.settings.certified_as({"stochastic": stochastic})
    if confidence is not None:
        settings = settings.model_copy(update={"confidence": confidence})
    limit = limit_of(opened.experiment, settings, threshold)
    if limit is None:
        raise InputError("a refinement needs a threshold: give --threshold.")
    if out_file is not None:
        require_file_of(out_file, chosen, opened.campaign.validation.model, step)
    found = refine(
        opened.campaign,
        limit,
        opened.campaign.executions + budget_of(opened.experiment, settings) if budget is None else budget,
        method=chosen,
        certificate=settings.certificate_options,
        open_round=_Rounds(settings, opened.experiment),
        workers=workers,
        timeout=timeout,
    )
    if not as_json:
        _print(found)  # before the files are written, which may fail
    files = [] if out_file is None or not found.last.number else write_refined(out_file, found, step)
    if files and not as_json:
        out.say(f"the model of round {found.last.number} is in {' and '.join(files)}")
    return {**found.to_dict(), "files": files}, FALSIFIED if found.answer == "falsified" else 0


def _method(name: str, fit: str | None, step: str | None, parameter: list[str] | None, vectorized: bool) -> Method:
    if (fit is not None) != (name == "fit"):
        raise InputError("--method fit and --fit MODULE:ATTR must be given together.")
    if (parameter is not None and len(parameter) > 0) != (name == "parameters"):
        raise InputError("--method parameters and --parameter must be given together.")
    if step is not None and name != "parameters":
        raise InputError("--step is for --method parameters.")
    if fit is not None:
        return UserFit(require_function(f"--fit {fit}", reference(fit), "(data) -> model"))
    if name != "parameters":
        return method_of(name)
    return ParameterFit(named_values(parameter, "--parameter"), step_function(step), vectorized)


@dataclass(frozen=True, eq=False)
class _Rounds:
    """Makes the campaigns of rounds, whose stores name the experiment and the file of the model."""

    settings: Settings
    experiment: Experiment

    def __call__(
        self, validation: Validation, store: Path | None, model_file: Path | None, certificate: CertificateOptions
    ) -> Campaign:
        settings, name = self.settings, self.experiment.name
        if model_file is None or store is None:  # the model cannot be read again, so other commands cannot load it
            search = settings.search.build(settings.folder)
            return Campaign(validation, search=search, store=store, seed=settings.seed, name=name)
        known = {"refined": model_file.resolve(), "confidence": certificate.confidence}
        experiment = replace(self.experiment, validation=validation, truth=None)
        return settings.model_copy(update=known).campaign(experiment, store)


def _print(found: Refinement) -> None:
    rows = [(*each.cells, each.store.name if each.store else "-") for each in found.rounds]
    print_columns((*found.head, "store"), (), rows)
    for each in found.rounds:
        for note in each.notes:
            out.say((f"round {each.number}: ", "bold"), note, wrap=True)
    out.say((found.answer, "bold"), f" against {found.threshold:g}: {found.ended}.", wrap=True)
    out.say(found.last.verdict.reason, wrap=True)
    out.say(found.statement, wrap=True)
    print_parameters(found.parameters)
    if (residual := found.residual) is not None:
        out.say(("residual of one step", "bold"), ", measured on executions that the model was not learned from:")
        for row in residual.text.splitlines():
            out.say(row)
        out.say(f"measured for {residual.range_text}; it is not guaranteed, and nothing is known outside.", wrap=True)
