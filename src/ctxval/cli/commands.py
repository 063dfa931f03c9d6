"""The commands, and which module has each. A module is loaded when one of its commands is called.

The help of ``ctxval`` lists the commands without loading any of them, so their first sentences stand here, too.
"""

from __future__ import annotations

import importlib
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ctxval.cli.screen import Screen, line
from ctxval.version import VERSION

PANELS = {
    "Run": {
        "init": ("files", "Write an example experiment file and the Python module of its system."),
        "check": (
            "files",
            "Check that the parts of an experiment fit together. The system is executed only if --execute is given.",
        ),
        "run": ("run", "Execute the tasks that decide whether the model can be trusted, and give the verdict."),
        "compare": (
            "compare",
            "Compare models, controllers or distances on one system, with as few executions of it as possible.",
        ),
        "refine": (
            "refine",
            "Learn a better model from the executions that falsified one, and validate it, until it is validated.",
        ),
        "remeasure": (
            "remeasure",
            "Recompute the distances of all stored executions, after you changed the distance function.",
        ),
    },
    "Recordings": {
        "replay": (
            "replay",
            "Compare a model with recordings of its system. Nothing is executed, and no experiment file is needed.",
        ),
        "fit": ("fit", "Learn models from recordings, and compare their errors on recordings that were held out."),
        "collect": (
            "collect",
            "Execute random tasks with a signal added to the inputs, and record them for `ctxval fit` and "
            "`ctxval replay`.",
        ),
    },
    "By hand": {
        "ask": (
            "hand",
            "Open the next trial of a system that people operate, and write its task and controller to files.",
        ),
        "tell": (
            "hand",
            "Record the result of an open trial: exactly one of --trajectory, --npz, --distance and --failed.",
        ),
        "import": ("hand", "Import earlier executions into a store."),
        "serve": ("serve", "Serve a page for the people who execute the tasks of a store by hand."),
    },
    "Inspect": {
        "status": ("stores", "Summarise the trials in a store. Nothing is executed."),
        "certify": (
            "certify",
            "Compute a certificate from the trials in a store. The system is executed only if --audit is given.",
        ),
        "report": (
            "report",
            "Write the report of a store: one HTML page with the verdict, insights, charts and trials.",
        ),
        "export": ("stores", "Write the trials of a store as CSV and JSON."),
    },
    "Paper": {
        "cases": (
            "paper",
            "List the cases, with their options: the systems of the paper, and those of installed packages.",
        ),
        "reproduce": (
            "paper",
            "Run the experiments of the paper and write its figures, their data and a table of its claims.",
        ),
    },
}
"""For each group of the help, in order: the commands, the module of each, and its first sentence."""

MODULES = {name: f"ctxval.cli.{module}" for names in PANELS.values() for name, (module, _) in names.items()}
"""The module of each command."""


class Commands(TyperGroup):
    """The commands, in groups; error messages about arguments are printed with control characters escaped."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        loaded, self.commands = self.commands, {}
        for panel, names in PANELS.items():
            for name, (_, sentence) in names.items():
                command = self.commands[name] = loaded.get(name) or TyperCommand(name, help=sentence)
                vars(command)["rich_help_panel"] = panel
                # typer keeps the line breaks of the source in all paragraphs but the first.
                command.help = "\n\n".join(" ".join(each.split()) for each in (command.help or "").split("\n\n"))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the arguments name, loaded, and the other arguments."""
        if args[0] in MODULES:
            importlib.import_module(MODULES[args[0]])
            self.commands = typer.main.get_group(app).commands
        return super().resolve_command(ctx, args)

    def make_context(self, *args: Any, **extra: Any) -> Any:
        """Read the arguments."""
        try:
            return super().make_context(*args, **extra)
        except Exception as error:
            raise _harmless(error) from None

    def invoke(self, ctx: Any) -> Any:
        """Read the arguments of a command, and run it."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            raise _harmless(error) from None


def _harmless(error: Exception) -> Exception:
    """Return an error about arguments whose message has control characters escaped."""
    if hasattr(error, "format_message"):
        message = line(error.format_message())
        vars(error)["format_message"] = lambda: message
    return error


app = typer.Typer(
    name="ctxval",
    cls=Commands,
    help="Find the task at which a system differs most from its learned model, and decide whether the difference stays "
    "below a threshold.",
    epilog="The glossary in docs/glossary.md explains the words and numbers that these commands print.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        Screen().say(f"ctxval {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Print the version, if that is asked for."""
