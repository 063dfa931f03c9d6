"""What repeats the campaign and each of its worst tasks."""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from markupsafe import Markup

from ctxval._util.version import VERSION
from ctxval.certificates import Automatic
from ctxval.certificates.options import CONFIDENCE, WITHIN
from ctxval.core.trial import Trial
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import distance_of
from ctxval.report.markup import code, heading, joined, paragraph, quantity, table
from ctxval.searches import DEFAULT as DEFAULT_SEARCH


def repeat(context: ReportContext) -> Markup:
    """Return the command, the seed, the versions, the digests and a snippet for each of the worst tasks."""
    parts = [paragraph("No command made this store, so there is none that repeats it.")]
    if command := repeating_command(context):
        same = (
            "The command makes the same choices again, into a new store, with the same versions of the libraries on "
            "the same kind of processor. The option thinking of the search auto must then be fast or "
            "thorough: balanced measures times."
        )
        parts = [paragraph(same), code(command, "Command that repeats the campaign")]
        if not context.settings.get("experiment"):
            named = "The store keeps its content, but not its name, so its name is assumed here."
            parts.append(paragraph(f"The experiment is described in a file. {named}"))
    parts += [
        table("What identifies this campaign", ("Name", "Value"), identity(context).items(), class_="facts"),
        heading("The worst tasks"),
        paragraph(
            "Each snippet executes the system once. For a system that people operate, the command opens the task "
            "again as a new trial, and writes its controller to files."
        ),
    ]
    for trial in context.worst_tasks(5):
        parts += [
            heading(f"Trial {trial.number}, distance {quantity(distance_of(trial), context.labels.units)}", 4),
            code(python_snippet(context, trial), f"Python for trial {trial.number}"),
            code(command_snippet(context, trial), f"Command for trial {trial.number}"),
        ]
    return joined(parts)


def identity(context: ReportContext) -> dict[str, str]:
    """Return the seed, the versions and the digests by name."""
    search = context.description.get("search")
    known = ("space", "task", "system", "model", "synthesizer", "distance")
    digests = {f"digest of the {name}": digest(part) for name, part in context.parts.items() if name in known}
    trials = [[trial.number, trial.state, trial.unit_point.tolist(), trial.distance] for trial in context.trials]
    return {
        "store": str(context.store.name),
        "search": str(search.get("type")) if isinstance(search, Mapping) else "not known",
        "seed": str(context.description.get("seed", "not known")),
        "version of ctxval": VERSION,
        "version of Python": platform.python_version(),
        "version of numpy": np.__version__,
        "version of scipy": scipy.__version__,
        "processor": platform.machine(),
        **digests,
        "digest of the trials": digest(trials),
        "changes": "; ".join(f"{change.at[:19]} {change.what}: {change.why}" for change in context.store.history()),
    }


def digest(value: Any) -> str:
    """Return the SHA-256 of a value for JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def repeating_command(context: ReportContext) -> str:
    """Return the command that runs the campaign again, into a store in a folder of its own; empty if none made it."""
    path = Path(path_of(context))
    return command_of(context, None, "--store", str(path.parent / "again" / path.name))


def command_of(context: ReportContext, budget: int | None = None, *others: str) -> str:
    """Return the command that runs the campaign; empty if no command made the store."""
    settings = context.settings
    return run_command(settings, budget or settings.get("budget") or context.budget, *others) if settings else ""


def run_command(settings: Mapping[str, Any], budget: int | None, *others: str, target: str = "") -> str:
    """Return the command that runs a campaign with settings as a store keeps them, and with ``others`` beside them.

    ``target`` is the experiment, if it must be named otherwise than in the settings.
    """
    file = settings.get("file")
    named = None if file else settings.get("experiment")
    words = ["ctxval", "run", str(target or file or named or f"{settings.get('name') or 'experiment'}.toml")]
    # A store may hold anything.
    tables = {name: table for name, table in settings.items() if isinstance(table, Mapping)}
    search, certificate, options = (tables.get(name, {}) for name in ("search", "certificate", "options"))
    # The value of each option, and its default, with which it is left out.
    values = {
        "--search": (search.get("type"), DEFAULT_SEARCH if named else None),
        "--seed": (settings.get("seed"), 0 if named else None),
        "--budget": (budget, None),
        "--threshold": (settings.get("threshold"), None),
        "--confidence": (settings.get("confidence"), CONFIDENCE),
        **{f"--{option.name}": (certificate.get(option.name), option.default) for option in fields(Automatic)},
        "--within": (settings.get("within"), WITHIN),
    }
    for option, (value, default) in values.items():
        words += [] if value is None or value == default else [option, str(value)]
    explore = settings.get("explore")
    words += ["--explore"] if explore is True else ["--decide"] if explore is False else []
    for name, value in options.items():
        words += ["--option", f"{name}={value}"]
    return shlex.join([*words, *others])


def python_snippet(context: ReportContext, trial: Trial) -> str:
    """Return Python that executes the task of a trial once. Texts of the store are literals in it."""
    made = "validation = ...  # the Validation of the campaign"
    if context.settings:
        made = (
            "from ctxval import Store\nfrom ctxval.cli.config.stored_settings import trusted_settings\n\n"
            f"store = Store.existing({str(path_of(context))!r})\n"
            "validation = trusted_settings(store).load().validation"
        )
    return (
        f"{made}\npoint = validation.space.point({trial.parameters!r})\noutcome = validation.outcome(point)\n"
        f"print(outcome.distance)  # {distance_of(trial)!r} in the store"
    )


def command_snippet(context: ReportContext, trial: Trial) -> str:
    """Return the command that opens the task of a trial again, and writes its controller to files."""
    return shlex.join(["ctxval", "ask", str(path_of(context)), "--again", str(trial.number)])


def path_of(context: ReportContext) -> Path | str:
    """Return the path of the store, for a command."""
    return context.store.name if context.store.path is not None else "campaign.sqlite"
