"""What repeats the campaign and each of its worst tasks: commands, seed, versions and digests."""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ctxval._util.representation import call
from ctxval.certificates import RESOLUTION
from ctxval.certificates.options import CONFIDENCE, WITHIN
from ctxval.core.trial import Trial
from ctxval.report.context import ReportContext, distance_of
from ctxval.report.markup import code, heading, joined, number, paragraph, table
from ctxval.searches import DEFAULT as DEFAULT_SEARCH
from ctxval.version import VERSION

_SAME = (
    "The command makes the same choices again, into a new store, with the same versions of the libraries on the same "
    "kind of processor. The option thinking of the search auto must then be a number, fast or thorough: balanced "
    "measures times."
)
_FILE = (
    "The experiment is described in a file. The store keeps its content, but not its name, so its name is assumed here."
)


class RepeatSection:
    """How to repeat the campaign, and each of the worst tasks."""

    title = "To repeat it"

    def render(self, context: ReportContext) -> Markup:
        """Return the command, the seed, the versions, the digests and a snippet for each of the worst tasks."""
        command = repeating_command(context)
        parts = [
            paragraph(_SAME) if command else paragraph("No command made this store, so there is none that repeats it."),
            code(command, "Command that repeats the campaign") if command else Markup(""),
            paragraph(_FILE) if command and not context.settings.get("experiment") else Markup(""),
            table("What identifies this campaign", ("Name", "Value"), identity(context).items(), class_="facts"),
            heading("The worst tasks"),
            paragraph(
                "Each snippet executes the system once. For a system that people operate, the command opens the task "
                "again as a new trial, and writes its controller to files."
            ),
        ]
        for trial in context.worst_tasks():
            distance = f"{number(distance_of(trial))} {context.labels.units}".rstrip()
            parts.append(heading(f"Trial {trial.number}, distance {distance}", 4))
            parts.append(code(python_snippet(context, trial), f"Python for trial {trial.number}"))
            parts.append(code(command_snippet(context, trial), f"Command for trial {trial.number}"))
        return joined(parts)

    __repr__ = call


def identity(context: ReportContext) -> dict[str, str]:
    """Return the seed, the versions and the digests by name."""
    described = context.description
    search = described.get("search")
    parts = described.get("validation")
    digests = {
        f"digest of the {name}": digest(part)
        for name, part in (parts.items() if isinstance(parts, Mapping) else ())
        if name in ("space", "task", "system", "model", "synthesizer", "distance")
    }
    return {
        "store": str(context.store.name),
        "search": str(search.get("type")) if isinstance(search, Mapping) else "not known",
        "seed": str(described.get("seed", "not known")),
        "version of ctxval": VERSION,
        "version of Python": platform.python_version(),
        **{f"version of {name}": _version(name) for name in ("numpy", "scipy")},
        "processor": platform.machine(),
        **digests,
        "digest of the trials": digest(
            [[trial.number, trial.state, trial.unit_point.tolist(), trial.distance] for trial in context.trials]
        ),
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # a package without its metadata, as in a bundle
        return "not known"


def digest(value: Any) -> str:
    """Return the SHA-256 of a value for JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def repeating_command(context: ReportContext) -> str:
    """Return the command that runs the campaign again, into a new store; empty if no command made the store.

    The new store has a folder of its own, because it is no other campaign among which one is chosen.
    """
    path = Path(path_of(context))
    return command_of(context, None, "--store", str(path.parent / "again" / path.name))


def command_of(context: ReportContext, budget: int | None = None, *others: str) -> str:
    """Return the command that runs the campaign, with further words; empty if no command made the store."""
    settings = context.settings
    if not settings:
        return ""
    named = settings.get("experiment")
    words = ["ctxval", "run", str(named) if named else f"{settings.get('name') or 'experiment'}.toml"]
    search, certificate, options = (_mapping(settings.get(name)) for name in ("search", "certificate", "options"))
    given = {
        "--search": search.get("name") if not named else _unless(DEFAULT_SEARCH, search.get("name")),
        "--seed": settings.get("seed") if not named else _unless(0, settings.get("seed")),
        "--budget": budget or settings.get("budget") or context.budget,
        "--threshold": settings.get("threshold"),
        "--confidence": _unless(CONFIDENCE, settings.get("confidence")),
        "--resolution": _unless(RESOLUTION, certificate.get("resolution")),
        "--within": _unless(WITHIN, settings.get("within")),
    }
    for option, value in given.items():
        words += [option, str(value)] if value is not None else []
    flags = {
        "--explore": settings.get("explore"),
        "--decide": settings.get("explore") is False,
        "--audited": settings.get("audited"),
        "--stochastic": certificate.get("stochastic"),
    }
    words += [flag for flag, wanted in flags.items() if wanted is True]
    for name, value in options.items():
        words += ["--option", f"{name}={value}"]
    return shlex.join([*words, *others])


def _unless(default: object, value: Any) -> Any:
    return None if value == default else value


def _mapping(value: Any) -> Mapping[str, Any]:
    """Return a table of the settings; an empty one for anything else, because a store may hold anything."""
    return value if isinstance(value, Mapping) else {}


def python_snippet(context: ReportContext, trial: Trial) -> str:
    """Return Python that executes the task of a trial once. Texts of the store are literals in it."""
    made = "validation = ...  # the Validation of the campaign"
    if context.settings:
        made = (
            "from ctxval import Store\nfrom ctxval.config.stored_settings import trusted_settings\n\n"
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
