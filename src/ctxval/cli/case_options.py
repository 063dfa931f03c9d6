"""Options of cases on the command line: ``--option name=value``."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from ctxval.errors import InputError

CaseOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="Set an option of a case, or of the function that makes the experiment. Repeat --option to set several. "
        "`ctxval cases` lists the options of each case.",
    ),
]


def case_options(given: Sequence[str] | None, **named: Any) -> dict[str, Any]:
    """Return the options that a command line states, by name.

    Args:
        given: texts ``name=value``; a value is a number, a Boolean, a list or a quoted text of TOML, or plain text.
        named: options that have a command line option of their own; None if it was not given.

    Raises:
        InputError: a text is not ``name=value``, or an option is given twice.
    """
    found = {name: value for name, value in named.items() if value is not None}
    for text in given or ():
        name, equals, value = text.partition("=")
        name = name.strip()
        if not (equals and name):
            raise InputError(f"--option must be NAME=VALUE, such as --option dim=4, got {text!r}.")
        if name in found:
            raise InputError(f"the option {name} is given twice: as {found[name]!r} and as {value!r}.")
        found[name] = parsed(value.strip())
    return found


def parsed(text: str) -> Any:
    """Return the number, Boolean, list or quoted text that a TOML file would hold, or else the text itself."""
    try:
        content = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    value = content.get("value")
    return value if len(content) == 1 and isinstance(value, str | int | float | bool | list) else text
