"""The command line: a thin skin over the public interface."""

from ctxval.cli.commands import app, print_anything

__all__ = ["app", "main"]


def main() -> None:
    print_anything()
    app(prog_name="ctxval")
