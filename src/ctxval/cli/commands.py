"""The commands, the module of each, which is loaded when one of them is called, and the screens that they print on."""

from __future__ import annotations

import functools
import gc
import importlib
import inspect
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

from ctxval._util.texts import number_in, shortened, visible
from ctxval._util.version import VERSION


class Screen(Console):
    """A console that prints texts literally; it escapes control characters in all that rich renders."""

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, markup=False, emoji=False, highlight=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)

    def say(self, *parts: str | tuple[str, str], wrap: bool = False) -> None:
        """Print one sentence of texts, some with a style; ``wrap`` breaks it between words."""
        texts = [(part, "") if isinstance(part, str) else part for part in parts]
        self.print(Text.assemble(*((line(text), style) for text, style in texts)), soft_wrap=not wrap)


def line(text: str) -> str:
    """Return a text to print: shortened, with control characters escaped, and its further lines indented."""
    # An indented line cannot be mistaken for another line of the output.
    return visible(shortened(text).replace("\r\n", "\n")).replace("\n", "\n  ")


TEXTS: dict[str, Any] = tomllib.loads(Path(__file__).with_name("texts.toml").read_text("utf-8"))
"""Every text of the command line."""

PANELS: dict[str, dict[str, list[str]]] = TEXTS["groups"]
"""For each group of the help, in order: the commands, the module of each, and the paragraphs, so none is loaded."""

MODULES = {name: f"ctxval.cli.{module}" for names in PANELS.values() for name, (module, *_) in names.items()}
"""The module of each command."""


def _plainly(options: list[Any], callback: Any) -> list[Any]:
    """Make options read paths and texts without pydantic, which typer would load: longer than `ctxval status` takes."""
    parameters = inspect.signature(callback).parameters

    def read(option: Any, kinds: tuple[Any, ...], ctx: Any, value: Any) -> Any:
        if isinstance(value, str) and (str in kinds or Path in kinds):
            return value if str in kinds else Path(value)
        if option.required or value not in (None, True, False):
            return type(option).process_value(option, ctx, value)
        return option.callback(ctx, option, value) if option.callback else value

    for option in options:
        annotation = parameters[option.name].annotation if option.name in parameters else None
        kind, *_ = get_args(annotation) or (annotation,)
        option.process_value = functools.partial(read, option, get_args(kind) or (kind,))
    return options


class PlainCommand(TyperCommand):
    """A command that reads its options fast."""

    def get_params(self, ctx: Any) -> list[Any]:
        return _plainly(super().get_params(ctx), self.callback)


class Commands(TyperGroup):
    """The commands, in groups; error messages about arguments are printed with control characters escaped."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        loaded, self.commands = self.commands, {}
        for panel, names in PANELS.items():
            for name, (_, *paragraphs) in names.items():
                command = loaded.get(name) or TyperCommand(name)
                command.help = "\n\n".join(paragraphs)
                vars(command).update(rich_help_panel=panel, hidden=name in TEXTS["hidden"])
                self.commands[name] = command

    def get_params(self, ctx: Any) -> list[Any]:
        return _plainly(super().get_params(ctx), self.callback)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in MODULES:
            gc.disable()  # which would look through all that is loaded
            try:
                importlib.import_module(MODULES[args[0]])
            finally:
                gc.enable()
            self.commands = typer.main.get_group(app).commands
        return super().resolve_command(ctx, args)

    def make_context(self, *args: Any, **extra: Any) -> Any:
        with _harmless_errors():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: Any) -> Any:
        with _harmless_errors():
            return super().invoke(ctx)


@contextmanager
def _harmless_errors() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if hasattr(error, "format_message"):
            message = line(error.format_message())
            vars(error)["format_message"] = lambda: message
        raise


def number_parser(annotation: Any) -> dict[str, Any]:
    """Return how typer reads the number of a parameter; empty if it is none.

    Python's own reading would take ``1_0`` and digits of other scripts, too.
    """
    kind = next((kind for kind in (int, float) if kind in (annotation, *get_args(annotation))), None)
    if kind is None:
        return {}

    def parsed(text: Any) -> Any:
        with suppress(ValueError):
            return number_in(text, kind) if isinstance(text, str) else text
        raise typer.BadParameter(f"{text!r} is not a valid {name}.")

    name = parsed.__name__ = "integer" if kind is int else "float"
    return {"parser": parsed}


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
