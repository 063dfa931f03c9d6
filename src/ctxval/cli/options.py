"""Arguments and options that several commands have, and the values of ``--option NAME=VALUE``."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ctxval.errors import InputError
from ctxval.searches import REGISTRY as SEARCHES

TARGET = "CASE|FILE.toml|module:attr"
"""The three ways to name an experiment."""

SEARCH_METHODS = ", ".join(sorted(SEARCHES.built_in))

Target = Annotated[
    str,
    typer.Argument(
        metavar=TARGET, help="Experiment: a case, an experiment file, or a reference to an object in Python."
    ),
]
SearchName = Annotated[str | None, typer.Option(help=f"Search method: {SEARCH_METHODS} (default: auto).")]
StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", help="Store of a campaign (a .sqlite file).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
Threshold = Annotated[
    float | None, typer.Option(help="Largest acceptable distance. The verdict is given against this value.")
]
Confidence = Annotated[
    float | None, typer.Option(help="Confidence level of the certificate, at least 0.5 (default: 0.95).")
]
Stochastic = Annotated[
    bool | None,
    typer.Option(
        "--stochastic",
        help="State that two executions of one task may differ. The certificate is then the posterior bound, and it "
        "bounds the largest expected distance. The dynamics bound is not used.",
    ),
]
Resolution = Annotated[
    float | None,
    typer.Option(
        help="Largest distance between a task and its nearest trial with which the posterior certificate still "
        "validates, in diagonals of the task space (default: 0.125). The dynamics certificate does not use it. False "
        "validations are more frequent above the default: in a study with thresholds just below d*, 1 of 74 campaigns "
        "was validated at 0.125, and 8 of 75 at 0.25. On narrow peaks in two dimensions, 11 of 48 were validated at "
        "0.25."
    ),
]
Workers = Annotated[
    int | None, typer.Option(help="Number of parallel executions, each in its own process (default: 1).")
]
Dask = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Address of a Dask scheduler. Its workers execute the tasks.")
]
Timeout = Annotated[
    float | None,
    typer.Option(help="Time limit of one execution in seconds; a longer execution has failed (default: no limit)."),
]
PartOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="Option of a case, or of the function that makes the experiment. Repeat --option to set several. "
        "`ctxval cases` lists the options of each case.",
    ),
]


def named_values(given: Sequence[str] | None, flag: str = "--option", /, **named: Any) -> dict[str, Any]:
    """Return the options that a command line states, by name."""
    found = {name: value for name, value in named.items() if value is not None}
    for text in given or ():
        name, equals, value = text.partition("=")
        name = name.strip()
        if not (equals and name):
            raise InputError(f"{flag} must be NAME=VALUE, such as {flag} dim=4, got {text!r}.")
        if name in found:
            raise InputError(f"the option {name} is given twice: as {found[name]!r} and as {value!r}.")
        found[name] = parsed(value.strip())
    return found


def parsed(text: str) -> Any:
    """Return the number, Boolean, list or quoted text that a TOML file would contain, or else the text itself."""
    try:
        content = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    value = content.get("value")
    return value if len(content) == 1 and isinstance(value, str | int | float | bool | list) else text
