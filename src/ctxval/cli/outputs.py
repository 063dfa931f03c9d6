"""What commands write to files that options name: never onto an input, and never onto the work of others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

import typer

from ctxval._util.files import make_folder_of, require_made_by_us
from ctxval.errors import InputError

Force = Annotated[
    bool,
    typer.Option("--force", help="Replace files that are there already, even if ctxval did not write them."),
]


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
        try:
            place, there = path.resolve(), path.exists()
            is_input = there and any(each.exists() and each.samefile(path) for each in read)
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"{path} cannot be written: {error}.") from error
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
