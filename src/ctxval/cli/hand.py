"""``ctxval ask``, ``ctxval tell`` and ``ctxval import``: tasks that people execute, and earlier runs."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval._util.checked import NonNegativeFloat, require
from ctxval._util.progress import advance, stage
from ctxval._util.texts import enumerated
from ctxval.campaign.by_hand import TRIAL_FILES, parameters_from, read_runs, write_files
from ctxval.campaign.campaign import OpenTrial
from ctxval.campaign.known import KnownExecution
from ctxval.campaign.telling import ToldResult, parameters_of_trial, result_sentence, tell_result
from ctxval.cli.base import FALSIFIED, command, out, print_verdict
from ctxval.cli.commands import app
from ctxval.cli.options import TARGET, AsJson, PartOptions, SearchName, StoreArgument, Threshold, named_values
from ctxval.cli.outputs import Force, require_folder
from ctxval.cli.trust import AcceptChange, Named, Opened, Trust, budget_of, limit_of, open_store, open_target
from ctxval.core.exchange import TASK_FORMAT
from ctxval.core.trial import CONVERGED, Trial
from ctxval.errors import InputError
from ctxval.storage.other_stores import STORE_SUFFIXES
from ctxval.storage.store import Store

_WAIT = 60.0
"""Seconds to wait for other terminals: each of them locks the store while it chooses a task."""

Target = Annotated[
    str, typer.Argument(metavar=f"STORE|{TARGET}", help="Existing store, or the experiment of a store to create.")
]
StoreFile = Annotated[
    Path | None, typer.Option(help="Store to create or to resume, if the first argument is an experiment.")
]
OutFolder = Annotated[
    Path | None, typer.Option("--out", help="Folder for the files of the trial (default: a folder next to the store).")
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Value of a task parameter. Repeat --set for each parameter. Examples: goal=1.5, goal='1.5 rad', "
        "goal=[1.5, 0.5], goal[0]=1.5.",
    ),
]
Draw = Annotated[bool, typer.Option("--draw", help="Choose the task by an independent random draw, for an audit.")]
Again = Annotated[
    int | None, typer.Option(metavar="TRIAL", help="Open a new trial with the task of this earlier trial.")
]
Because = Annotated[
    str | None,
    typer.Option(
        metavar="REASON",
        help='The change that was made to the system since the earlier trial, such as "fuse replaced". Only with '
        "--again.",
    ),
]
Explore = Annotated[
    bool,
    typer.Option(
        "--explore",
        help="Choose the task by the search alone. Without this option, and with a threshold, the task is the one that "
        "`ctxval run` would execute to decide the verdict soonest; if the verdict is reached, no trial is opened and "
        "the verdict is printed.",
    ),
]
Budget = Annotated[
    int | None,
    typer.Option(
        help="Maximum number of executions that may be planned for a verdict, including earlier ones (default: the "
        "budget of the experiment)."
    ),
]
Reopened = Annotated[int | None, typer.Option(help="Write the files of this open trial again.")]
Seed = Annotated[int | None, typer.Option(help="Seed of the random numbers of a new store (default: 0).")]
Resample = Annotated[bool, typer.Option("--resample", help="Interpolate a recording to the time steps of the task.")]
StartTolerance = Annotated[
    float | None,
    typer.Option(
        help="Largest permitted difference between the start of a recording and the initial state of its task, as a "
        "fraction of the range of each state in the trajectory of the model (default: the value of the experiment, "
        "which is 0.05 if it states none)."
    ),
]


@app.command()
@command
def ask(
    target: Target,
    store: StoreFile = None,
    out_folder: OutFolder = None,
    parameters: Set = None,
    draw: Draw = False,
    again: Again = None,
    because: Because = None,
    trial: Reopened = None,
    explore: Explore = False,
    threshold: Threshold = None,
    budget: Budget = None,
    search: SearchName = None,
    seed: Seed = None,
    force: Force = False,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
    option: PartOptions = None,
) -> Any:
    """Open the next trial of a system that people operate, and write its task and controller to files."""
    stated = sum((bool(parameters), draw, again is not None, trial is not None, explore))
    if stated > 1:
        raise InputError("--set, --draw, --again, --trial and --explore cannot be combined.")
    if stated and (threshold is not None or budget is not None):
        raise InputError(
            "--threshold and --budget are for a trial that decides a verdict; --set, --draw, --again, --trial and "
            "--explore open another one."
        )
    if because is not None and again is None:
        raise InputError("--because needs --again TRIAL: it states why the task is executed again.")
    if out_folder is not None:
        require_folder(out_folder, TRIAL_FILES, TASK_FORMAT, force=force)
    if Path(target).suffix in STORE_SUFFIXES and not Path(target).exists():
        raise InputError(f"there is no store at {target}; `ctxval ask FILE.toml --store {target}` creates one.")
    overrides = {"store": store, "search": search, "seed": seed, "option": named_values(option) or None}
    opened = open_target(target, overrides, experiment, trust, accept_change)
    limit = limit_of(opened.experiment, opened.settings, threshold)
    if trial is not None:
        waiting = opened.campaign.reopen(trial)
    elif limit is not None and not stated and (threshold is not None or not opened.settings.explores):
        total = budget_of(opened.experiment, opened.settings, budget)
        options = opened.settings.certificate_options
        asked = opened.campaign.ask_for_verdict(limit, total, certificate=options, wait=_WAIT)
        if asked is None:
            return _decided(opened, limit, as_json)
        waiting = asked
    else:
        chosen = None if again is None else parameters_of_trial(opened.campaign, again)
        if parameters:
            chosen = parameters_from(parameters, opened.experiment.validation.space)
        waiting = opened.campaign.ask(chosen, draw=draw, because=because, wait=_WAIT)
    folder = opened.path.with_suffix(".trials") / str(waiting.number) if out_folder is None else out_folder
    if out_folder is None:
        require_folder(folder, TRIAL_FILES, TASK_FORMAT, force=force)
    report = {
        "trial": waiting.number,
        "task": waiting.trial.parameters,
        "origin": waiting.trial.origin,
        "store": str(opened.path),
        "folder": str(folder),
        "files": write_files(folder, opened.experiment, waiting),
        "open": [t.number for t in opened.campaign.trials if t.state == "open" and t.number != waiting.number],
    }
    if not as_json:
        _print_asked(report, waiting)
    return report


@app.command()
@command
def tell(
    store: StoreArgument,
    trial: Annotated[int, typer.Argument(metavar="TRIAL", help="Number of the trial, as printed by `ctxval ask`.")],
    trajectory: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of the recorded trajectory, with named columns, or another log that `ctxval replay` reads."
        ),
    ] = None,
    npz: Annotated[
        Path | None, typer.Option(help="NPZ file of the recorded trajectory, with the arrays times, states and inputs.")
    ] = None,
    distance: Annotated[float | None, typer.Option(help="Distance of the trial, if there is no recording.")] = None,
    failed: Annotated[
        str | None, typer.Option(metavar="REASON", help="Reason why the execution has no usable result.")
    ] = None,
    resample: Resample = False,
    start_tolerance: StartTolerance = None,
    replace: Annotated[
        str | None,
        typer.Option(
            metavar="REASON",
            help='Replace the result that was told before, for a reason such as "wrong file". The store keeps the '
            "earlier result in its history.",
        ),
    ] = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Record the result of an open trial: exactly one of --trajectory, --npz, --distance and --failed."""
    given = {"--trajectory": trajectory, "--npz": npz, "--distance": distance, "--failed": failed}
    if sum(value is not None for value in given.values()) != 1:
        raise InputError(f"exactly one of {', '.join(given)} must be given.")
    if failed is not None and not failed.strip():
        raise InputError('--failed needs a reason, such as "the motor cut out".')
    if trajectory is None and npz is None and (resample or start_tolerance is not None):
        raise InputError("--resample and --start-tolerance need a recording: give --trajectory or --npz.")
    require("--start-tolerance", NonNegativeFloat | None, start_tolerance)
    opened = open_store(Store.existing(store), store, experiment, trust, accept_change)
    file, mapping = trajectory or npz, opened.settings.log_mapping
    result = ToldResult(file, distance, failed, npz is not None, resample, start_tolerance, mapping, replace)
    ended = tell_result(opened.campaign, opened.experiment, trial, result)
    report = _ended(ended, opened, opened.campaign.executions)
    if not as_json:
        out.say(result_sentence(ended, opened.experiment.units, opened.campaign.start_offset(ended)))
    return report


@app.command("import")
@command
def import_runs(
    store: StoreArgument,
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="CSV tables of earlier runs. Each row has the task parameters and a value in one of the columns "
            "trajectory, distance and failed. With --set, the file is one recorded trajectory.",
        ),
    ],
    parameters: Set = None,
    resample: Resample = False,
    start_tolerance: StartTolerance = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Import earlier executions into a store.

    Each one counts in the budget. A run that is already in the store is not imported again.
    """
    require("--start-tolerance", NonNegativeFloat | None, start_tolerance)
    opened = open_store(Store.existing(store), store, experiment, trust, accept_change)
    space = opened.experiment.validation.space
    runs = read_runs(files, parameters_from(parameters, space) if parameters else None, space)
    checked = list[KnownExecution]()
    with stage("checking", len(runs), "runs"):
        validation, mapping = opened.campaign.validation, opened.settings.log_mapping
        for run in runs:  # all of them before any is stored
            try:
                checked.append(run.checked(validation, opened.experiment, resample, start_tolerance, mapping))
            except InputError as error:
                raise InputError(f"{run.where}: {error}") from error
            advance(1)
    ended = opened.campaign.add_known(checked, _WAIT)
    new = [trial for trial in ended if trial is not None]
    executions = opened.campaign.executions
    report = {
        "imported": [_ended(trial, opened, executions) for trial in new],
        "known": len(ended) - len(new),
        "store": str(store),
    }
    if not as_json:
        for trial in new[:10]:
            out.say(result_sentence(trial, opened.experiment.units, opened.campaign.start_offset(trial)))
        if len(new) > 10:
            out.say(f"... and {len(new) - 10} other trials; --json lists them.")
        out.say(f"{len(new)} runs imported, {len(ended) - len(new)} already in the store.")
    return report


def _decided(opened: Opened, limit: float, as_json: bool) -> tuple[dict[str, Any], int]:
    """Return the verdict of a campaign that needs no further trial, and the exit status."""
    verdict = opened.campaign.verdict(limit, certificate=opened.settings.certificate_options)
    if not as_json:
        print_verdict(verdict)
        if verdict.answer == "undecided":
            out.say(
                "the budget is spent: --budget plans more executions, and --explore opens a trial without a verdict."
            )
    report = {
        "trial": None,
        "executions": opened.campaign.executions,
        "verdict": verdict.answer,
        "reason": verdict.reason,
        "threshold": limit,
        "store": str(opened.path),
    }
    return report, FALSIFIED if verdict.answer == "falsified" else 0


def _ended(trial: Trial, opened: Opened, executions: int) -> dict[str, Any]:
    return {
        "trial": trial.number,
        "task": trial.parameters,
        "state": trial.state,
        "distance": trial.distance,
        "failure": trial.failure,
        "executions": executions,
        "store": str(opened.path),
    }


def _print_asked(report: dict[str, Any], opened: OpenTrial) -> None:
    task = ", ".join(f"{name} = {value}" for name, value in report["task"].items())
    out.say(f"trial {opened.number}: {task}")
    out.say(f"{', '.join(report['files'])} in {report['folder']}")
    if "controller.json" not in report["files"]:
        out.say("the controller cannot be written to a file: this is possible only for affine feedback (LQR and iLQR).")
    if (opened.trial.note or {}).get(CONVERGED) is False:
        out.say("the design of the controller did not converge: nearly the same task may have another controller.")
    if report["open"]:
        count = len(report["open"])
        out.say(f"{count} other {'trial is' if count == 1 else 'trials are'} open: {enumerated(report['open'], 10)}.")
    out.say(f"next: ctxval tell {shlex.quote(report['store'])} {opened.number} --trajectory run.csv")
