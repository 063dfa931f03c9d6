"""``ctxval ask``, ``tell``, ``import`` and ``serve``: tasks that people execute, and earlier runs."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from ctxval import Plan, Store
from ctxval._util.checked import NonNegativeFloat, require
from ctxval._util.progress import advance, stage
from ctxval._util.refusals import require_extra
from ctxval._util.texts import enumerated, shell_word
from ctxval.campaign import by_hand
from ctxval.campaign.choices import Execution
from ctxval.campaign.storage.other_stores import STORE_SUFFIXES
from ctxval.campaign.telling import SuppliedResult
from ctxval.cli import base
from ctxval.cli.base import Allowed, command, named_values, out, print_verdict, require_folder, status_of
from ctxval.cli.config.settings import ExperimentSettings
from ctxval.cli.config.stored_settings import Limits, Opened, open_store, open_target, trusted_settings
from ctxval.core.exchange import TASK_FORMAT
from ctxval.core.trial import Trial
from ctxval.errors import InputError
from ctxval.web.jobs import ServedCampaign

_WAIT = 60.0  #: seconds to wait for other terminals: each of them locks the store while it chooses a task


@command()
def ask(
    target: str,
    allowed: Allowed,
    made: base.NewStore,
    limits: Limits,
    out_: Path | None = None,
    parameters: list[str] | None = None,
    draw: bool = False,
    again: int | None = None,
    because: str | None = None,
    trial: int | None = None,
    explore: bool = False,
    force: bool = False,
    option: list[str] | None = None,
) -> Any:
    stated = sum((bool(parameters), draw, again is not None, trial is not None, explore))
    if stated > 1:
        raise InputError("--set, --draw, --again, --trial and --explore cannot be combined.")
    if stated and limits != Limits():
        flags = "--set, --draw, --again, --trial and --explore"
        raise InputError(f"--threshold and --budget are for a trial that decides a verdict; {flags} open another one.")
    if because is not None and again is None:
        raise InputError("--because needs --again TRIAL: it states why the task is executed again.")
    if out_ is not None:
        require_folder(out_, by_hand.TRIAL_FILES, TASK_FORMAT, force=force)
    if Path(target).suffix in STORE_SUFFIXES and not Path(target).exists():
        raise InputError(f"there is no store at {target}; `ctxval ask FILE.toml --store {target}` creates one.")
    opened = open_target(target, {**vars(made), "options": named_values(option) or None}, allowed)
    experiment, settings, campaign, path = opened.experiment, opened.settings, opened.campaign, opened.path
    limit, total = limits.completed_by(settings, experiment)
    if trial is None and limit is not None:
        campaign.state_threshold(limit)
    if trial is not None:
        waiting = campaign.reopen(trial)
    elif limit is not None and not stated and (limits.threshold is not None or not settings.explores):
        certificate = settings.certificate_options
        asked = campaign.ask_for_verdict(limit, total, certificate=certificate, thinking=settings.thinking, wait=_WAIT)
        if asked is None:
            verdict = campaign.verdict(limit, certificate=certificate, thinking=settings.thinking)
            print_verdict(verdict)
            if verdict.answer == "undecided" and not campaign.recorder.has_tasks:
                out.say("each task of the suite is executed or open: --set task=NAME opens one of them again.")
            elif verdict.answer == "undecided" and campaign.executions + len(campaign.trials.open) >= total:
                more = "--budget plans more executions, and --explore opens a trial without a verdict"
                out.say(f"the budget is spent: {more}.")
            decided = {"verdict": verdict.answer, "reason": verdict.reason, "threshold": limit, "store": str(path)}
            return {"trial": None, "executions": campaign.executions, **decided}, status_of(verdict)
        waiting = asked
    else:
        chosen = None if again is None else by_hand.parameters_of_trial(campaign, again)
        if parameters:
            chosen = by_hand.parameters_from(parameters, experiment.validation.space)
        waiting = campaign.ask(chosen, draw=draw, because=because, wait=_WAIT)
    folder = path.with_suffix(".trials") / str(waiting.number) if out_ is None else out_
    if out_ is None:
        require_folder(folder, by_hand.TRIAL_FILES, TASK_FORMAT, force=force)
    files = by_hand.write_files(folder, experiment, waiting)
    others = [number for number in campaign.trials.open.numbers if number != waiting.number]
    task = ", ".join(f"{name} = {value}" for name, value in waiting.trial.parameters.items())
    out.say(f"trial {waiting.number}: {task}")
    out.say(f"{', '.join(files)} in {folder}")
    if "controller.json" not in files:
        plan = f"`plan = campaign.reopen({waiting.number}).plan`"
        steps = "`pi = controllers.started(plan.controller, plan.task)` and `u = pi(t, x)` at each step"
        why = "the controller cannot be written to a file: this is possible only for affine feedback (LQR and iLQR)."
        out.say(f"{why} Run its loop in Python: {plan}, then {steps}.")
    if waiting.trial.note.converged is False:
        out.say("the design of the controller did not converge: nearly the same task may have another controller.")
    if others:
        trials = "trial is" if len(others) == 1 else "trials are"
        out.say(f"{len(others)} other {trials} open: {enumerated(others, 10)}.")
    out.say(f"next: ctxval tell {shell_word(path)} {waiting.number} --trajectory run.csv")
    return {
        "trial": waiting.number,
        "task": waiting.trial.parameters,
        "origin": waiting.trial.origin,
        "store": str(path),
        "folder": str(folder),
        "files": files,
        "open": others,
    }


@command()
def tell(
    store: Path,
    trial: int,
    allowed: Allowed,
    trajectory: Path | None = None,
    npz: Path | None = None,
    distance: float | None = None,
    failed: str | None = None,
    resample: bool = False,
    start_tolerance: float | None = None,
    replace: str | None = None,
) -> Any:
    stated = {"--trajectory": trajectory, "--npz": npz, "--distance": distance, "--failed": failed}
    count = sum(value is not None for value in stated.values())
    if count != 1 and not (count == 2 and failed is not None and distance is None):
        raise InputError(f"one of {', '.join(stated)} must be given; a recording may have --failed beside it.")
    if failed is not None and not failed.strip():
        raise InputError('--failed needs a reason, such as "the motor cut out".')
    if trajectory is None and npz is None and (resample or start_tolerance is not None):
        raise InputError("--resample and --start-tolerance need a recording: give --trajectory or --npz.")
    require("start tolerance", NonNegativeFloat | None, start_tolerance)
    opened = open_store(store, allowed)
    file, mapping = trajectory or npz, opened.settings.log_mapping
    result = SuppliedResult(file, distance, failed, npz is not None, resample, start_tolerance, mapping, replace)
    ended = by_hand.tell_result(opened.campaign, opened.experiment, trial, result)
    _say_result(opened, ended)
    return _ended(opened, ended)


@command("import")
def import_runs(
    store: Path,
    files: list[Path],
    allowed: Allowed,
    parameters: list[str] | None = None,
    resample: bool = False,
    start_tolerance: float | None = None,
) -> Any:
    require("start tolerance", NonNegativeFloat | None, start_tolerance)
    opened = open_store(store, allowed)
    campaign, space = opened.campaign, opened.experiment.validation.space
    given = by_hand.parameters_from(parameters, space) if parameters else None
    how = {"resample": resample, "start_tolerance": start_tolerance, "mapping": opened.settings.log_mapping}
    runs = by_hand.read_runs(files, given, space, **how)
    checked = list[tuple[Plan, Execution]]()
    with stage("checking", len(runs), "runs"):
        for run in runs:  # all of them before any is stored
            checked.append(run.checked(campaign.validation, opened.experiment))
            advance(1)
    ended = campaign.recorder.add(checked, _WAIT)
    new = [trial for trial in ended if trial is not None]
    known = len(ended) - len(new)
    for trial in new[:10]:
        _say_result(opened, trial)
    if len(new) > 10:
        out.say(f"... and {len(new) - 10} other trials; --json lists them.")
    out.say(f"{len(new)} runs imported, {known} already in the store.")
    return {"imported": [_ended(opened, trial) for trial in new], "known": known, "store": str(store)}


def _say_result(opened: Opened, trial: Trial) -> None:
    differences = opened.campaign.start_offset(trial), opened.campaign.input_difference(trial)
    out.say(by_hand.result_sentence(trial, opened.experiment.units, *differences))


def _ended(opened: Opened, trial: Trial) -> dict[str, Any]:
    return {
        "trial": trial.number,
        "task": trial.parameters,
        "state": trial.state,
        "distance": trial.distance,
        "failure": trial.failure,
        "executions": opened.campaign.executions,
        "store": str(opened.path),
    }


@command(with_json=False)
def serve(
    store: Path,
    allowed: Allowed,
    limits: Limits,
    host: str = "127.0.0.1",
    port: int = 8765,
    token: str | None = None,
    allow_host: list[str] | None = None,
) -> Any:
    web = require_extra("ctxval.web.server", "web", "the page needs")
    settings = trusted_settings(Store.existing(store), experiment=allowed.experiment, trust=allowed.trust)

    def say_started(place: str, secret: str | None) -> None:
        out.say(f"the page is at {place}" + ("" if secret is None else f"?token={secret}"))
        if secret is not None:
            out.say("everybody who has this address can record results. It is sent without encryption.")
        out.say("Ctrl-C stops the server; all results are stored.")

    again = functools.partial(_reopened, settings, store, limits)  # a child process unpickles it
    where: dict[str, Any] = {"host": host, "port": port, "token": token, "names": allow_host or ()}
    web.serve(lambda: _served(open_store(store, allowed), limits), again, say_started, **where)


def _reopened(settings: ExperimentSettings, path: Path, limits: Limits) -> ServedCampaign:
    """Open a store by settings that the user has allowed to run here: those in it may have been changed since."""
    experiment = settings.load()
    campaign = settings.campaign(experiment, Store.existing(path))
    return _served(Opened(settings, experiment, campaign, path), limits)


def _served(opened: Opened, limits: Limits) -> ServedCampaign:
    experiment, settings = opened.experiment, opened.settings
    limit, total = limits.completed_by(settings, experiment)
    if limit is not None:
        opened.campaign.state_threshold(limit)
    return ServedCampaign(experiment, opened.campaign, limit, settings.certificate_options, total)
