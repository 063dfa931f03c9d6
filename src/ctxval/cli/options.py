"""Options that several commands have, values of ``--option NAME=VALUE``, and files that commands write."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval._util.files import make_folder_of, require_made_by_us
from ctxval._util.refusals import reworded
from ctxval.errors import InputError


@dataclass(frozen=True)
class Allowed:
    """What may be done with the experiment of a store: whose code may run, and why it may have changed."""

    experiment: str | None = None
    trust: bool = False
    accept_change: str | None = None


def named_values(given: Sequence[str] | None, flag: str = "--option", /, **named: Any) -> dict[str, Any]:
    values = {name: value for name, value in named.items() if value is not None}
    for text in given or ():
        name, equals, value = text.partition("=")
        name = name.strip()
        if not (equals and name):
            raise InputError(f"{flag} must be NAME=VALUE, such as {flag} dim=4, got {text!r}.")
        if name in values:
            raise InputError(f"the option {name} is given twice: as {values[name]!r} and as {value!r}.")
        values[name] = parsed(value.strip())
    return values


def parsed(text: str) -> Any:
    """Return the number, Boolean, list or quoted text that a TOML file would contain, or else the text itself."""
    with suppress(tomllib.TOMLDecodeError, RecursionError):
        match tomllib.loads(f"value = {text}"):
            case {"value": str() | int() | float() | list() as value, **others} if not others:
                return value
    return text


# Files that options name: never onto an input, and never onto the work of others


def require_outputs(outputs: Mapping[str, Path | None], inputs: Iterable[object], *, force: bool) -> None:
    """Check the files that a command will write, before it does anything else."""
    read = [Path(str(each)) for each in inputs if each is not None and "\0" not in str(each)]
    named: dict[Path, str] = {}
    for option, path in outputs.items():
        if path is None:
            continue
        name, _, suffix = option.partition(" .")
        suffix = suffix and f".{suffix}"
        if suffix and path.suffix.lower() != suffix:
            raise InputError(f"{name} must be a file that ends in {suffix}, got {str(path)!r}.")
        make_folder_of(path)
        with reworded(f"{path} cannot be written", OSError, RuntimeError, ValueError):
            place, there = path.resolve(), path.exists()
            is_input = there and any(each.exists() and each.samefile(path) for each in read)
        if place in named:
            raise InputError(f"{named[place]} and {name} must be different files, and both are {path}.")
        named[place] = name
        if path.is_dir():
            raise InputError(f"{path} cannot be written: it is a folder.")
        if is_input and not force:
            raise InputError(f"{path} is read by this command: give another name, or --force to replace it.")
        if path.is_symlink() and not force:
            raise InputError(f"{path} is a link to another file: give another name, or --force to replace it.")
        if not force:
            require_made_by_us(path)


def require_folder(folder: Path, names: Iterable[str], mark: str, *, force: bool) -> None:
    """Check that files may be written into a folder: none of them is there, or the first one is ours."""
    first, *others = names
    there = [name for name in (first, *others) if (folder / name).exists()]
    if there and not force:
        if first not in there:
            raise InputError(f"{folder / there[0]} is there already: give another folder, or --force to replace it.")
        require_made_by_us(folder / first, mark.encode())
