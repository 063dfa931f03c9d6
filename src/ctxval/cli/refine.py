"""``ctxval refine``: learn a better model from the executions that falsified one, and validate it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ctxval.campaign.campaign import Campaign
from ctxval.certificates import CertificateOptions
from ctxval.cli.base import FALSIFIED, command, out, print_columns
from ctxval.cli.config.references import reference, require_function
from ctxval.cli.config.settings import Settings
from ctxval.cli.options import named_values
from ctxval.cli.recordings import print_parameters, require_model_file, step_function
from ctxval.cli.trust import budget_of, limit_of, open_target
from ctxval.core.experiment import Experiment
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.studies.fitting.model_file import require_file_of
from ctxval.studies.refinement import Method, ParameterFit, Refinement, refine
from ctxval.studies.refinement.methods import NAMES, UserFit, method_of
from ctxval.studies.refinement.rounds import write_refined


@command("refine", methods=", ".join(NAMES))
def refine_model(
    target: str,
    threshold: float | None = None,
    budget: int | None = None,
    method: str = "residual",
    fit: str | None = None,
    step: str | None = None,
    parameter: list[str] | None = None,
    vectorized: bool = False,
    out_: Path | None = None,
    force: bool = False,
    confidence: float | None = None,
    stochastic: bool | None = None,
    seed: int | None = None,
    workers: int | None = None,
    timeout: float | None = None,
    experiment: str | None = None,
    trust: bool = False,
    option: list[str] | None = None,
) -> Any:
    """Learn a better model from the executions that falsified one, and validate it, until it is validated.

    Each refined model has a store and a file of its own next to STORE, such as cart.round-1.sqlite and
    cart.round-1.npz. Run the same command again to resume. An execution counts for the model on which its controller
    was designed, and for no other one; what was recorded goes on teaching.
    """
    chosen = _method(method, fit, step, parameter, vectorized)
    require_model_file(out_, [target, experiment], force=force)
    opened = open_target(target, {"seed": seed, "option": named_values(option) or None}, experiment, trust)
    settings = opened.settings.certified_as({"stochastic": stochastic})
    if confidence is not None:
        settings = settings.model_copy(update={"confidence": confidence})
    limit = limit_of(opened.experiment, settings, threshold)
    if limit is None:
        raise InputError("a refinement needs a threshold: give --threshold.")
    if out_ is not None:
        require_file_of(out_, chosen.name, chosen.makes, opened.campaign.validation.model, step)
    if budget is None:
        budget = opened.campaign.executions + budget_of(opened.experiment, settings)
    refinement = refine(
        opened.campaign,
        limit,
        budget,
        method=chosen,
        certificate=settings.certificate_options,
        open_round=_Rounds(settings, opened.experiment),
        workers=workers,
        timeout=timeout,
    )
    _print(refinement)  # before the files are written, which may fail
    number = refinement.last.number
    files = [] if out_ is None or not number else write_refined(out_, refinement, step)
    if files:
        out.say(f"the model of round {number} is in {' and '.join(files)}")
    return {**refinement.to_dict(), "files": files}, FALSIFIED if refinement.answer == "falsified" else 0


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


def _print(refinement: Refinement) -> None:
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
