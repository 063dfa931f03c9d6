"""``ctxval init`` and ``ctxval check``: experiment files."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.cli.base import BAD_INPUT, AsJson, app, command, out
from ctxval.cli.case_options import CaseOptions, case_options
from ctxval.config.check import Finding, check_experiment
from ctxval.config.settings import read_settings
from ctxval.errors import InputError

_EXPERIMENT = """\
# An experiment: what is validated, for which tasks, and what would satisfy you.
#   ctxval check {name}      looks at it without executing the system
#   ctxval run {name}        searches for the task at which system and model differ most
name = "cart"
budget = 40             # executions of the system, in all; fewer with ctxval run --until-decided
threshold = 0.5         # the largest distance that you can accept
confidence = 0.95       # of a validation
seed = 0                # of the search
units = "m"             # of the distance
# store = "runs/cart.sqlite"   # file of the trials; running again resumes

[space]                 # the tasks: name = [low, high, "unit"]
goal = [0.5, 3.0, "m"]
load = [0.0, 0.4, "m/s"]

[task]                  # numbers, and task parameters by name ("goal", "-goal", "vector[0]")
initial_state = [0.0, "load"]
goal = ["goal", 0.0]
horizon = 60            # steps
dt = 0.05               # seconds in a step
# Tasks that need more than that are a function p -> Task of yours: task = "my_module:my_task", above [space].

[states]                # names and units, for files and pictures
position = "m"
speed = "m/s"

[inputs]
force = "N"

[system]                # the true one, here a step function in {module}.py
type = "Simulated"
step = {{ ref = "{module}:step" }}
# Others, each with the arguments that it has in Python:
#   type = "Gymnasium"    environment = "InvertedPendulum-v5"
#   type = "FMU"          path = "Cart.fmu", states = ["position", "speed"], inputs = ["force"]
#   type = "MuJoCo"       mjcf = "arm.xml"
#   type = "Subprocess"   command = "./my_rig", timeout = 60
#   type = "Manual"       states, inputs and dt: people execute it, with `ctxval ask` and `ctxval tell`
#   type = "my_module:MySystem"

[model]                 # the learned one
type = "Linear"         # or Onnx, with source = "model.onnx"; or my_module:my_model
A = [[1.0, 0.05], [0.0, 1.0]]
B = [[0.0], [0.05]]
# Learned from recorded trajectories instead of A and B: data = ["run1.csv", "run2.npz"]

[synthesizer]           # how controllers are designed on the model: LQR, ILQR, StationaryLQR, MPC, OnnxPolicy
type = "LQR"
Q = [10.0, 1.0]
R = [0.1]
limits = 4.0

[distance]              # FinalState, WholeTrajectory, MeanDeviation, GoalError; or my_module:my_distance
type = "FinalState"
norm = 2
components = [0]        # the position alone

[search]                # ctxval run --help
name = "auto"
repeats = 1             # executions of each task: more where two of one task differ

[certificate]           # what a validation rests on: see `ctxval certify --help`
kind = "posterior"
stochastic = false      # whether two executions of one task may differ
"""

_SYSTEM = '''"""The system of {name}; yours goes here."""

import numpy as np


def step(x, u):
    """Return the next state of a cart with a drag and a dry friction that its model does not know."""
    position, speed = x
    friction = 0.3 * speed * abs(speed) + 0.5 * np.tanh(20 * speed)
    return np.array([position + 0.05 * speed, speed + 0.05 * (u[0] - friction)])
'''


@app.command()
@command
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="The experiment file to write.")] = Path(
        "experiment.toml"
    ),
    as_json: AsJson = False,
) -> Any:
    """Write a commented experiment file that runs, and the system that it names."""
    if file.suffix != ".toml":
        raise InputError(f"an experiment file ends in .toml, got {str(file)!r}.")
    module = "".join(c if c.isascii() and c.isalnum() else "_" for c in file.stem) + "_system"
    contents = {
        file: _EXPERIMENT.format(name=file.name, module=module),
        file.with_name(f"{module}.py"): _SYSTEM.format(name=file.name),
    }
    for path in contents:
        if path.exists():
            raise InputError(f"{path} exists already, and is left as it is.")
    try:
        for path, content in contents.items():
            with path.open("x", encoding="utf-8") as opened:
                opened.write(content)
    except OSError as error:
        raise InputError(f"{error.filename} cannot be written: {error.strerror}.") from error
    if not as_json:
        quoted = shlex.quote(str(file))
        out.say(" and ".join(map(str, contents)))
        out.say(f"next: ctxval check {quoted}")
        out.say(f"then: ctxval run {quoted} --until-decided")
    return {"files": [str(path) for path in contents]}


@app.command()
@command
def check(
    target: Annotated[str, typer.Argument(metavar="CASE|FILE.toml|module:attr", help="What to check.")],
    execute: Annotated[bool, typer.Option("--execute", help="Execute one task twice on the system.")] = False,
    as_json: AsJson = False,
    option: CaseOptions = None,
) -> Any:
    """Check an experiment and its parts against each other; the system is executed only with --execute."""
    settings = read_settings(target, {"options": case_options(option)})
    experiment = settings.load()
    settings.search.build(settings.folder)
    findings = check_experiment(experiment, execute=execute, seed=settings.seed)
    if not as_json:
        _print_findings(findings)
    failed = any(finding.state == "failed" for finding in findings)
    report = {"case": experiment.name, "ok": not failed, "findings": [asdict(finding) for finding in findings]}
    return report, BAD_INPUT if failed else 0


def _print_findings(findings: list[Finding]) -> None:
    colours = {"ok": "green", "noted": "yellow", "failed": "bold red", "skipped": "dim"}
    for finding in findings:
        out.say((f"{finding.state:<8}", colours[finding.state]), f"{finding.check}: {finding.text}")
