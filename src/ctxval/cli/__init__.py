"""The command line: a thin skin over the public interface."""

import sys

from ctxval.cli.commands import app

__all__ = ["app", "main"]


def main() -> None:
    for stream in (sys.stdout, sys.stderr):  # they escape the characters that their encoding does not have
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    app(prog_name="ctxval")
