"""``ctxval init`` and ``ctxval check``: write and check experiment files."""

from __future__ import annotations

import shlex
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval._util.files import write_text
from ctxval.aspect1 import TASKS
from ctxval.cli.aspect1_findings import aspect1_findings
from ctxval.cli.base import BAD_INPUT, FALSIFIED, command, out
from ctxval.cli.commands import app
from ctxval.cli.options import AsJson, PartOptions, Target, named_values
from ctxval.config.check import check_experiment
from ctxval.config.settings import read_settings
from ctxval.core.experiment import UnitsWarning
from ctxval.errors import InputError

_EXPERIMENT = """\
# An experiment file: system, model, tasks and threshold.
#   ctxval check {name}      checks the file without executing the system
#   ctxval run {name}        searches for the task at which the system differs most from its model
name = "cart"
budget = 40             # maximum number of executions of the system
threshold = 0.5         # largest acceptable distance
confidence = 0.95       # confidence level of the certificate
seed = 0                # seed of the random numbers of the search
units = "m"             # units of the distance
# store = "runs/cart.sqlite"   # store of the campaign; running again resumes it

[space]                 # range of each task parameter: name = [low, high, "unit"]
goal = [0.5, 3.0, "m"]
load = [0.0, 0.4, "m/s"]

[task]                  # each component is a number or the name of a task parameter ("goal", "-goal", "vector[0]")
initial_state = [0.0, "load"]
goal = ["goal", 0.0]
horizon = 60            # number of time steps
dt = 0.05               # time step in seconds
# For other tasks, write a function p -> Task and name it above [space]: task = "my_module:my_task"

[states]                # names and units of the states, for files and figures
position = "m"
speed = "m/s"

[inputs]                # names and units of the inputs
force = "N"

[system]                # the true system; here a step function in {module}.py
type = "Simulated"
step = {{ ref = "{module}:step" }}
# Other types, with the same arguments as in Python:
#   type = "Gymnasium"    environment = "InvertedPendulum-v5"
#   type = "FMU"          path = "Cart.fmu", states = ["position", "speed"], inputs = ["force"]
#   type = "MuJoCo"       mjcf = "arm.xml"
#   type = "Subprocess"   command = "./my_rig", timeout = 60
#   type = "Manual"       states, inputs, dt; people execute the tasks with `ctxval ask` and `ctxval tell`
#   type = "my_module:MySystem"

[model]                 # the learned model
type = "Linear"         # or Onnx, with source = "model.onnx"; or my_module:my_model
A = [[1.0, 0.05], [0.0, 1.0]]
B = [[0.0], [0.05]]
# To learn the model from recorded trajectories, replace A and B by: data = ["run1.csv", "run2.npz"]

[synthesizer]           # method that designs the controllers on the model: LQR, ILQR, StationaryLQR, MPC, OnnxPolicy
type = "LQR"
Q = [10.0, 1.0]
R = [0.1]
limits = 4.0

[distance]              # FinalState, MaximumDeviation, MeanDeviation, GoalError, ...; or my_module:my_distance
type = "FinalState"
norm = 2
components = [0]        # only the position
# States of different units need scales, the error of each state that counts as 1: scales = [0.1, 0.5]

[search]                # `ctxval run --help` lists the search methods
name = "auto"
repeats = 1             # executions of each task; raise it if two executions of one task differ

[certificate]           # certificate for the verdict: see `ctxval certify --help`
kind = "auto"           # learned dynamics if they decide, otherwise the posterior bound of the distance
stochastic = false      # true if two executions of one task may differ
"""

_SYSTEM = '''"""The system of {name}. Replace it by your own system."""

import numpy as np


def step(x, u):
    """Return the next state of a cart, with a drag and a dry friction that the model does not contain."""
    position, speed = x
    friction = 0.3 * speed * abs(speed) + 0.5 * np.tanh(20 * speed)
    return np.array([position + 0.05 * speed, speed + 0.05 * (u[0] - friction)])
'''


@app.command()
@command
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="Experiment file to write.")] = Path(
        "experiment.toml"
    ),
    as_json: AsJson = False,
) -> Any:
    """Write an example experiment file and the Python module of its system."""
    if file.suffix != ".toml":
        raise InputError(f"an experiment file ends in .toml, got {str(file)!r}.")
    module = "".join(c if c.isascii() and c.isalnum() else "_" for c in file.stem) + "_system"
    contents = {
        file: _EXPERIMENT.format(name=file.name, module=module),
        file.with_name(f"{module}.py"): _SYSTEM.format(name=file.name),
    }
    for path in contents:
        if path.exists():
            raise InputError(f"{path} already exists and was not changed.")
    for path, content in contents.items():
        write_text(path, content)
    if not as_json:
        quoted = shlex.quote(str(file))
        out.say(" and ".join(map(str, contents)))
        out.say(f"next: ctxval check {quoted}")
        out.say(f"then: ctxval run {quoted}")
    return {"files": [str(path) for path in contents]}


@app.command()
@command
def check(
    target: Target,
    execute: Annotated[
        bool, typer.Option("--execute", help="Also execute one task twice and compare the two executions.")
    ] = False,
    aspect1: Annotated[
        bool,
        typer.Option(
            "--aspect1",
            help="Check whether the model itself completes the tasks (Aspect 1 of the paper): simulate tasks on the "
            "model, search for the worst one, and look at the controllers. The system is not executed.",
        ),
    ] = False,
    tasks: Annotated[
        int | None, typer.Option(min=2, help=f"Number of simulated tasks (default: {TASKS}). Only with --aspect1.")
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option(
            help="Largest error of the model with which a task counts as completed, in the units of its goal. Only "
            "with --aspect1."
        ),
    ] = None,
    as_json: AsJson = False,
    option: PartOptions = None,
) -> Any:
    """Check that the parts of an experiment fit together. The system is executed only if --execute is given."""
    if not aspect1 and (tasks is not None or threshold is not None):
        raise InputError(f"{'--tasks' if tasks is not None else '--threshold'} needs --aspect1.")
    settings = read_settings(target, {"options": named_values(option)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnitsWarning)  # it is one of the findings
        experiment = settings.load()
    _ = settings.certificate_options  # which refuses a kind or an option that does not exist
    settings.search.build(settings.folder)
    findings = check_experiment(experiment, execute=execute, seed=settings.seed)
    failed = any(finding.state == "failed" for finding in findings)
    status = BAD_INPUT if failed else 0
    found = settings.aspect1_of(experiment, tasks, threshold) if aspect1 and not failed else None
    if found is not None:
        findings += aspect1_findings(found)
        status = FALSIFIED if found.exceeding and found.completes is False else 0
    colours = {"ok": "green", "noted": "yellow", "failed": "bold red", "skipped": "dim"}
    for each in [] if as_json else findings:
        out.say((f"{each.state:<8}", colours[each.state]), f"{each.check}: {each.text}")
    report = {"case": experiment.name, "ok": not status, "findings": [asdict(finding) for finding in findings]}
    return {**report, **({"aspect1": None if found is None else found.to_json()} if aspect1 else {})}, status
