"""What is printed for people: nothing in a text acts on the terminal, and nothing in it is taken for markup."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text
from typer.core import TyperGroup

from ctxval._util.texts import shortened, visible

_INDENT = "\n  "
"""Before further lines of a text, so that none looks like a line of ours."""


class Screen(Console):
    """A console on which texts stand as they are.

    Everything that rich prints is rendered here, so that what a terminal would act upon is written out whatever it
    came in: a line, a table, a bar of progress.
    """

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, markup=False, emoji=False, highlight=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Return the segments of anything printed, harmless."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)

    def say(self, *parts: str | tuple[str, str], wrap: bool = False) -> None:
        """Print one sentence.

        Args:
            parts: texts, or texts with a style, such as ``("error:", "bold red")``.
            wrap: break it between words, at the width of the screen.
        """
        texts = [(part, "") if isinstance(part, str) else part for part in parts]
        self.print(Text.assemble(*((line(text), style) for text, style in texts)), soft_wrap=not wrap)


def line(text: str) -> str:
    """Return a text to print: shortened, harmless, and its further lines indented."""
    return visible(shortened(text).replace("\r\n", "\n")).replace("\n", _INDENT)


class Commands(TyperGroup):
    """The commands, whose complaints about arguments repeat these."""

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
    """Return a complaint about arguments that prints nothing a terminal would act upon."""
    if hasattr(error, "format_message"):
        said = line(error.format_message())
        vars(error)["format_message"] = lambda: said
    return error


def print_anything() -> None:
    """Let the standard streams write out what their encoding cannot hold."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
