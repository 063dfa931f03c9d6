"""``ctxval ask``, ``ctxval tell`` and ``ctxval import``: systems that people operate."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.campaign.by_hand import parameters_from, read_recording, read_runs, write_files
from ctxval.campaign.campaign import Campaign, OpenTrial
from ctxval.cli.base import AsJson, app, command, out
from ctxval.cli.trust import AcceptChange, Named, Opened, Trust, open_store
from ctxval.config.settings import read_settings
from ctxval.core.experiment import Experiment
from ctxval.core.trial import Trial
from ctxval.core.validation import START
from ctxval.errors import InputError
from ctxval.storage.store import Store

_WAIT = 60.0
"""Seconds to wait for other terminals: each of them holds the store while it chooses a task."""

_STORES = (".sqlite", ".sqlite3", ".db")
"""How files of trials are mostly called."""

Resample = Annotated[
    bool, typer.Option("--resample", help="Bring a recording with other time steps to those of the task.")
]
StartTolerance = Annotated[
    float | None, typer.Option(help="By how much a recording may start elsewhere, as a share of what the model covers.")
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="A task parameter, once for each: goal=1.5, goal='1.5 rad', goal=[1.5, 0.5] or goal[0]=1.5.",
    ),
]
StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", help="File of a campaign's trials.")]


@app.command()
@command
def ask(
    target: Annotated[
        str,
        typer.Argument(metavar="STORE|CASE|FILE.toml|module:attr", help="A store, or what a new one is to be of."),
    ],
    store: Annotated[Path | None, typer.Option(help="File of the trials, if the first argument is none.")] = None,
    out_folder: Annotated[
        Path | None, typer.Option("--out", help="Folder for the trial's files; one beside the store by default.")
    ] = None,
    parameters: Set = None,
    draw: Annotated[bool, typer.Option("--draw", help="An independent draw, for an audit by hand.")] = False,
    again: Annotated[
        int | None, typer.Option(metavar="TRIAL", help="The task of this trial once more, as a new one.")
    ] = None,
    because: Annotated[
        str | None, typer.Option(help='With --again: what was changed on the system since, such as "fuse replaced".')
    ] = None,
    trial: Annotated[int | None, typer.Option(help="Write the files of this open trial again.")] = None,
    search: Annotated[str | None, typer.Option(help="How tasks are chosen, for a new store.")] = None,
    seed: Annotated[int | None, typer.Option(help="For a new store.")] = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Open the next trial and write its task and its controller, for a rig that people operate."""
    if sum((bool(parameters), draw, again is not None, trial is not None)) > 1:
        raise InputError("of --set, --draw, --again and --trial only one can be given.")
    if because is not None and again is None:
        raise InputError("--because says why a task is executed again; say --again TRIAL too.")
    opened = _opened(target, {"store": store, "search": search, "seed": seed}, experiment, trust, accept_change)
    if trial is not None:
        found = opened.campaign.reopen(trial)
    else:
        space = opened.experiment.validation.space
        chosen = parameters_from(parameters, space) if parameters else _parameters_of(opened.campaign, again)
        found = opened.campaign.ask(chosen, draw=draw, because=because, wait=_WAIT)
    folder = opened.path.with_suffix(".trials") / str(found.number) if out_folder is None else out_folder
    report = {
        "trial": found.number,
        "task": found.trial.parameters,
        "origin": found.trial.origin,
        "store": str(opened.path),
        "folder": str(folder),
        "files": write_files(folder, opened.experiment, found),
    }
    if not as_json:
        _print_asked(report, found)
    return report


def _parameters_of(campaign: Campaign, number: int | None) -> dict[str, Any] | None:
    """Return the parameters of a trial's task, None where none is named."""
    if number is None:
        return None
    known = {trial.number: trial.parameters for trial in campaign.trials}
    if number not in known:
        raise InputError(f"there is no trial {number}; there are {len(known)}, numbered from 0.")
    return known[number]


@app.command()
@command
def tell(
    store: StoreArgument,
    trial: Annotated[int, typer.Argument(metavar="TRIAL", help="The number that `ctxval ask` said.")],
    trajectory: Annotated[Path | None, typer.Option(help="CSV of what happened, with named columns.")] = None,
    npz: Annotated[Path | None, typer.Option(help="NPZ of what happened: times, states, inputs.")] = None,
    distance: Annotated[float | None, typer.Option(help="The distance alone, where nothing was recorded.")] = None,
    failed: Annotated[str | None, typer.Option(help="Why there is no result.")] = None,
    resample: Resample = False,
    start_tolerance: StartTolerance = None,
    experiment: Named = None,
    trust: Trust = False,
    accept_change: AcceptChange = None,
    as_json: AsJson = False,
) -> Any:
    """Say how an open trial ended."""
    given = {"--trajectory": trajectory, "--npz": npz, "--distance": distance, "--failed": failed}
    if sum(value is not None for value in given.values()) != 1:
        raise InputError(f"exactly one of {', '.join(given)} must be given.")
    if failed is not None and not failed.strip():
        raise InputError('--failed needs a reason, such as "the motor cut out".')
    if trajectory is None and npz is None and (resample or start_tolerance is not None):
        raise InputError("--resample and --start-tolerance are for a recording, and there is none.")
    tolerance = _tolerance(start_tolerance)
    opened = open_store(Store.existing(store), store, experiment, trust, accept_change)
    recording = None
    path = trajectory or npz
    if path is not None:
        plan = opened.campaign.reopen(trial).plan
        recording = read_recording(path, opened.experiment, plan, npz=npz is not None, resample=resample)
    ended = opened.campaign.tell(trial, recording, distance=distance, failed=failed, start_tolerance=tolerance)
    report = _ended(ended, opened)
    if not as_json:
        out.say(_sentence(ended, opened.experiment))
    return report


@app.command("import")
@command
def import_runs(
    store: StoreArgument,
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Tables of known runs: CSV with the task parameters and trajectory, distance or failed; "
            "with --set, one trajectory.",
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
    """Take in executions that were made before; each counts as one, and none is taken in twice."""
    tolerance = _tolerance(start_tolerance)
    opened = open_store(Store.existing(store), store, experiment, trust, accept_change)
    space = opened.experiment.validation.space
    runs = read_runs(files, parameters_from(parameters, space) if parameters else None, space)
    checked = []
    for run in runs:
        # All of it before any is stored.
        try:
            checked.append(run.checked(opened.campaign.validation, opened.experiment, resample, tolerance))
        except InputError as error:
            raise InputError(f"{run.where}: {error}") from error
    ended = [opened.campaign.add_known(execution, _WAIT) for execution in checked]
    new = [trial for trial in ended if trial is not None]
    report = {
        "imported": [_ended(trial, opened) for trial in new],
        "known": len(ended) - len(new),
        "store": str(store),
    }
    if not as_json:
        for trial in new:
            out.say(_sentence(trial, opened.experiment))
        out.say(f"{len(new)} imported, {len(ended) - len(new)} were there already.")
    return report


def _tolerance(given: float | None) -> float:
    if given is not None and not (0 <= given < math.inf):
        raise InputError(f"--start-tolerance must be a share, a finite number >= 0, got {given!r}.")
    return START if given is None else given


def _opened(
    target: str, overrides: dict[str, Any], experiment: str | None, trust: bool, accept_change: str | None
) -> Opened:
    path = Path(target)
    if path.suffix != ".toml" and path.is_file():
        if any(value is not None for value in overrides.values()):
            raise InputError(f"{target} is a store, which knows its search and its seed; give no other.")
        return open_store(Store.existing(path), path, experiment, trust, accept_change)
    if path.suffix in _STORES:
        raise InputError(f"there is no store at {target}; `ctxval ask FILE.toml --store {target}` makes one.")
    if experiment is not None or trust:
        raise InputError(f"--experiment and --trust are for a store, and {target} is what a store is of.")
    settings = read_settings(target, overrides)
    made = settings.load()
    where = settings.store_path(made.name)
    return Opened(settings, made, settings.campaign(made, where, accept_change=accept_change), where)


def _ended(trial: Trial, opened: Opened) -> dict[str, Any]:
    return {
        "trial": trial.number,
        "task": trial.parameters,
        "state": trial.state,
        "distance": trial.distance,
        "failure": trial.failure,
        "executions": opened.campaign.executions,
        "store": str(opened.path),
    }


def _sentence(trial: Trial, experiment: Experiment) -> str:
    if trial.state == "unmeasured":
        return f"trial {trial.number} is stored without a distance: {trial.failure}"
    if trial.distance is None:
        return f"trial {trial.number} failed: {trial.failure}"
    return f"trial {trial.number} has the distance {trial.distance:.4g} {experiment.units}".rstrip()


def _print_asked(report: dict[str, Any], opened: OpenTrial) -> None:
    task = ", ".join(f"{name} = {value}" for name, value in report["task"].items())
    out.say(f"trial {opened.number}: {task}")
    out.say(f"{', '.join(report['files'])} in {report['folder']}")
    if "controller.json" not in report["files"]:
        out.say("its controller cannot be written to a file: only affine feedback, of LQR and iLQR, can.")
    told = f"ctxval tell {shlex.quote(report['store'])} {opened.number} --trajectory run.csv"
    out.say(f"afterwards: {told}")
