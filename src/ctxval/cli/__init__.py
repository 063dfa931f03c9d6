"""The command line: a thin skin over the public interface."""

from ctxval.cli import certify, files, hand, paper, run, stores
from ctxval.cli.base import app

__all__ = ["app", "certify", "files", "hand", "main", "paper", "run", "stores"]


def main() -> None:
    """Run the command line."""
    app()
