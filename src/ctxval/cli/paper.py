"""``ctxval cases`` and ``ctxval reproduce``: the built-in cases and the experiments of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.progress import Progress, TextColumn

from ctxval import cases as known_cases
from ctxval.cli.base import command, err, out, print_table
from ctxval.cli.config.parts import plain_options
from ctxval.errors import InputError


@command()
def cases(name: str | None = None) -> Any:
    """List the cases, with their options: the systems of the paper, and those of installed packages.

    A case is an experiment that `ctxval run` finds by its name. Set its options with `ctxval run CASE --option
    NAME=VALUE`.
    """
    listed: dict[str, tuple[str, dict[str, Any]]] = {}
    for each in list(known_cases.REGISTRY) if name is None else [name]:
        try:
            listed[each] = known_cases.text_of(each), plain_options(each)
        except InputError as error:
            if name is not None:
                raise
            listed[each] = str(error), {}
    rows = {}
    for each, (text, options) in listed.items():
        texts = [key if default is None else f"{key}={default}" for key, default in options.items()]
        rows[each] = f"{text}; options: {', '.join(texts)}" if texts else text
    print_table(rows)
    if name is None:
        return {each: text for each, (text, _) in listed.items()}
    text, options = listed[name]
    return {"case": name, "text": text, "options": options}


@command(with_json=False)
def reproduce(
    name: str, quick: bool = False, out_: Path = Path("reproduction"), results: Path | None = None, workers: int = 2
) -> None:
    """Run the experiments of the paper and write its figures, their data and a table of its claims."""
    from ctxval import reproduce as paper  # imported here: the other commands do not need it

    with Progress(TextColumn("runs"), *Progress.get_default_columns(), console=err) as progress:
        line = progress.add_task("")
        table = paper.reproduce(
            name,
            out_,
            stored=results,
            scale=paper.QUICK if quick else paper.FULL,
            workers=workers,
            on_start=lambda missing: progress.update(line, total=missing),
            on_done=lambda job: progress.update(line, advance=1, description=job.key),
        )
    out.say(f"table: {table}")
    out.say(f"figures and data: {out_}")
