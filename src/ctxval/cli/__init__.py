"""The command line: a thin skin over the public interface."""

from ctxval.cli import (
    certify,
    collect,
    compare,
    files,
    fit,
    hand,
    paper,
    refine,
    remeasure,
    replay,
    report,
    run,
    serve,
    stores,
)
from ctxval.cli.base import app
from ctxval.cli.screen import print_anything

__all__ = [
    "app",
    "certify",
    "collect",
    "compare",
    "files",
    "fit",
    "hand",
    "main",
    "paper",
    "refine",
    "remeasure",
    "replay",
    "report",
    "run",
    "serve",
    "stores",
]


def main() -> None:
    """Run the command line."""
    print_anything()
    app(prog_name="ctxval")
