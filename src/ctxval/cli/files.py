"""``ctxval init`` and ``ctxval check``: write and check experiment files."""

from __future__ import annotations

import shlex
import warnings
from dataclasses import asdict
from pathlib import Path
from string import Template
from typing import Any

from ctxval._util.files import write_text
from ctxval.cli.base import BAD_INPUT, FALSIFIED, command, out
from ctxval.cli.config.check import aspect1_findings, check_experiment
from ctxval.cli.config.settings import read_settings
from ctxval.cli.options import named_values
from ctxval.core.experiment import UnitsWarning
from ctxval.errors import InputError
from ctxval.studies.aspect1 import TASKS


@command()
def init(file: Path = Path("experiment.toml")) -> Any:
    """Write an example experiment file and the Python module of its system."""
    if file.suffix != ".toml":
        raise InputError(f"an experiment file ends in .toml, got {str(file)!r}.")
    module = "".join(c if c.isascii() and c.isalnum() else "_" for c in file.stem) + "_system"
    paths = {"experiment.toml": file, "system.py.txt": file.with_name(f"{module}.py")}
    for path in paths.values():
        if path.exists():
            raise InputError(f"{path} already exists and was not changed.")
    for example, path in paths.items():
        text = (Path(__file__).parent / "example" / example).read_text("utf-8")
        write_text(path, Template(text).substitute(name=file.name, module=module))
    quoted = shlex.quote(str(file))
    written = [str(path) for path in paths.values()]
    out.say(" and ".join(written))
    out.say(f"next: ctxval check {quoted}")
    out.say(f"then: ctxval run {quoted}")
    return {"files": written}


@command(tasks=TASKS)
def check(
    target: str,
    execute: bool = False,
    aspect1: bool = False,
    tasks: int | None = None,
    threshold: float | None = None,
    option: list[str] | None = None,
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
    simulated = settings.aspect1_of(experiment, tasks, threshold) if aspect1 and not failed else None
    if simulated is not None:
        findings += aspect1_findings(simulated)
        status = FALSIFIED if simulated.exceeding and simulated.completes is False else 0
    colours = {"ok": "green", "noted": "yellow", "failed": "bold red", "skipped": "dim"}
    for each in findings:
        out.say((f"{each.state:<8}", colours[each.state]), f"{each.check}: {each.text}")
    report = {"case": experiment.name, "ok": not status, "findings": [asdict(finding) for finding in findings]}
    if aspect1:
        report["aspect1"] = None if simulated is None else simulated.to_json()
    return report, status
