"""``ctxval init`` and ``check``: experiment files."""

from __future__ import annotations

import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from string import Template
from typing import Any

from ctxval._util.files import write_text
from ctxval._util.texts import shell_word
from ctxval._util.toml import toml_text
from ctxval.cli import policies
from ctxval.cli.base import BAD_INPUT, FALSIFIED, command, named_values, out
from ctxval.cli.config.check import aspect1_findings, check_experiment
from ctxval.cli.config.parts import part
from ctxval.cli.config.settings import read_settings
from ctxval.core.experiment import UnitsWarning
from ctxval.errors import InputError
from ctxval.studies import aspect1 as model_alone
from ctxval.studies.safety.draws import spec_distance


@command()
def init(
    file: Path = Path("experiment.toml"),
    hardware: bool = False,
    policy: Path | None = None,
    mjcf: Path | None = None,
    descriptor: Path | None = None,
) -> Any:
    if file.suffix != ".toml":
        raise InputError(f"an experiment file ends in .toml, got {str(file)!r}.")
    if policy is not None:
        if mjcf is None or hardware:
            raise InputError("--policy needs --mjcf, the robot of the policy, and no --hardware.")
        return _init_policy(file, policy, mjcf, descriptor)
    if mjcf is not None or descriptor is not None:
        raise InputError("--mjcf and --descriptor need --policy.")
    kind = "rig" if hardware else "system"
    module = "".join(c if c.isascii() and c.isalnum() else "_" for c in file.stem) + f"_{kind}"
    paths = {"experiment.toml": file, f"{kind}.py.txt": file.with_name(f"{module}.py")}
    if hardware:
        about = f"here a program that executes one task on a rig: {module}.py"
        program = toml_text({"command": f"{Path(sys.executable).name} {module}.py"})
        system = f'type = "Subprocess"\n{program}timeout = 60            # seconds'
    else:
        about = f"here a step function in {module}.py"
        system = f'type = "Simulated"\nstep = {{ ref = "{module}:step" }}'
    for path in paths.values():
        if path.exists():
            raise InputError(f"{path} already exists and was not changed.")
    for example, path in paths.items():
        text = (Path(__file__).parent / "example" / example).read_text("utf-8")
        write_text(path, Template(text).substitute(name=shell_word(file.name), about=about, system=system))
    return _written(file, [*paths.values()])


def _init_policy(file: Path, policy: Path, mjcf: Path, descriptor: Path | None) -> Any:
    if file.exists():
        raise InputError(f"{file} already exists and was not changed.")
    written, guessed = policies.write_experiment(file, policy, mjcf, descriptor)
    if guessed:
        out.say(f"the contract of the policy is guessed: {guessed}")
    return _written(file, written) | {"guessed": guessed or None}


def _written(file: Path, paths: list[Path]) -> dict[str, Any]:
    out.say(" and ".join(map(str, paths)))
    out.say(f"next: ctxval check {shell_word(file)}")
    out.say(f"then: ctxval run {shell_word(file)}")
    return {"files": [str(path) for path in paths]}


@command(tasks=model_alone.TASKS)
def check(
    target: str,
    execute: bool = False,
    aspect1: bool = False,
    tasks: int | None = None,
    threshold: float | None = None,
    option: list[str] | None = None,
) -> Any:
    if not aspect1 and (tasks is not None or threshold is not None):
        raise InputError(f"{'--tasks' if tasks is not None else '--threshold'} needs --aspect1.")
    settings = read_settings(target, {"options": named_values(option)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnitsWarning)  # it is one of the findings
        experiment = settings.load()
    _ = settings.certificate_options  # which refuses a kind or an option that does not exist
    settings.search.build(settings.folder)
    spec = None if settings.spec is None else spec_distance(settings.spec.on(experiment).validation).spec
    findings = check_experiment(experiment, execute=execute, seed=settings.seed, spec=spec)
    failed = any(finding.state == "failed" for finding in findings)
    status, simulated = BAD_INPUT if failed else 0, None
    if aspect1 and not failed:
        table = settings.aspect1
        simulated = model_alone.check(
            experiment.validation,
            threshold=table.threshold if threshold is None else threshold,
            distance=None if table.distance is None else part("distance", table.distance, settings.folder),
            tasks=table.tasks if tasks is None else tasks,
            seed=settings.seed,
        )
        findings += aspect1_findings(simulated)
        status = FALSIFIED if simulated.exceeding and simulated.completes is False else 0
    colours = {"ok": "green", "noted": "yellow", "failed": "bold red", "skipped": "dim"}
    for each in findings:
        out.say((f"{each.state:<8}", colours[each.state]), f"{each.check}: {each.text}")
    report = {"case": experiment.name, "ok": not status, "findings": [asdict(finding) for finding in findings]}
    if aspect1:
        report["aspect1"] = None if simulated is None else simulated.to_json()
    return report, status
