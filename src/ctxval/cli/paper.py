"""``ctxval cases`` and ``ctxval reproduce``: what the paper has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress, TextColumn

from ctxval import cases as known_cases
from ctxval.cli.base import AsJson, app, command, err, print_table
from ctxval.cli.base import out as screen


@app.command()
@command
def cases(as_json: AsJson = False) -> Any:
    """List the paper's systems that can be run by name."""
    if not as_json:
        print_table(known_cases.NAMES)
    return known_cases.NAMES


@app.command()
@command
def reproduce(
    name: Annotated[str, typer.Argument(metavar="STUDY|all", help="Which of the paper's figures, or all.")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer trials, coarser grids.")] = False,
    out: Annotated[
        Path, typer.Option(help="Folder of the figures and their data; the table is written beside it.")
    ] = Path("reproduction"),
    results: Annotated[
        Path | None,
        typer.Option(help="Folder of the stored runs, which are not run again (default: OUT/results)."),
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
) -> None:
    """Run the paper's experiments: figures, their data, and the table of its claims."""
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
