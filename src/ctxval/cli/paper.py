"""``ctxval cases`` and ``ctxval reproduce``: the built-in cases and the experiments of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress, TextColumn

from ctxval import cases as known_cases
from ctxval.cli.base import command, err, print_table
from ctxval.cli.base import out as screen
from ctxval.cli.commands import app
from ctxval.cli.options import AsJson
from ctxval.config.experiments import plain_options
from ctxval.errors import InputError


@app.command()
@command
def cases(
    name: Annotated[
        str | None, typer.Argument(metavar="CASE", help="Name of one case; the others are not listed.")
    ] = None,
    as_json: AsJson = False,
) -> Any:
    """List the cases, with their options: the systems of the paper, and those of installed packages.

    A case is an experiment that `ctxval run` finds by its name. Set its options with `ctxval run CASE --option
    NAME=VALUE`.
    """
    listed = list(known_cases.REGISTRY) if name is None else [name]
    found = {each: _described(each, skip_broken=name is None) for each in listed}
    if not as_json:
        rows = {}
        for each, (text, options) in found.items():
            texts = [key if default is None else f"{key}={default}" for key, default in options.items()]
            rows[each] = f"{text}; options: {', '.join(texts)}" if texts else text
        print_table(rows)
    if name is None:
        return {each: text for each, (text, _) in found.items()}
    text, options = found[name]
    return {"case": name, "text": text, "options": options}


def _described(name: str, *, skip_broken: bool) -> tuple[str, dict[str, Any]]:
    """Return the description and the options of a case; if it cannot be loaded and is skipped, the reason."""
    try:
        return known_cases.text_of(name), plain_options(name)
    except InputError as error:
        if not skip_broken:
            raise
        return str(error), {}


@app.command()
@command
def reproduce(
    name: Annotated[str, typer.Argument(metavar="STUDY|all", help="Figure or study of the paper, or all.")],
    quick: Annotated[bool, typer.Option("--quick", help="Use fewer trials and coarser grids.")] = False,
    out: Annotated[
        Path, typer.Option(help="Folder for the figures and their data. The table is written next to the folder.")
    ] = Path("reproduction"),
    results: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the stored runs. A run in it is not computed again (default: results in the --out folder)."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(help="Number of parallel processes.")] = 2,
) -> None:
    """Run the experiments of the paper and write its figures, their data and a table of its claims."""
    from ctxval import reproduce as paper  # imported here: the other commands do not need it

    with Progress(TextColumn("runs"), *Progress.get_default_columns(), console=err) as progress:
        line = progress.add_task("")
        table = paper.reproduce(
            name,
            out,
            stored=results,
            scale=paper.QUICK if quick else paper.FULL,
            workers=workers,
            on_start=lambda missing: progress.update(line, total=missing),
            on_done=lambda job: progress.update(line, advance=1, description=job.key),
        )
    screen.say(f"table: {table}")
    screen.say(f"figures and data: {out}")
