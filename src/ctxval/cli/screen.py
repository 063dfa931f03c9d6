"""Output for people: texts are printed without markup, and control characters in them are escaped."""

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
"""Before further lines of a text, so that they cannot be mistaken for other lines of the output."""

PANELS = {
    "Run": ("init", "check", "run", "compare", "refine", "remeasure"),
    "Recordings": ("replay", "fit", "collect"),
    "By hand": ("ask", "tell", "import", "serve"),
    "Inspect": ("status", "certify", "report", "export"),
    "Paper": ("cases", "reproduce"),
}
"""Groups of commands in the help, in their order; a command that is in none comes first, without a group."""


class Screen(Console):
    """A console that prints texts literally.

    Everything that rich prints is rendered here. Control characters are therefore escaped in lines, in tables and in
    progress bars alike.
    """

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, markup=False, emoji=False, highlight=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Return the segments of an object, with control characters escaped."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)

    def say(self, *parts: str | tuple[str, str], wrap: bool = False) -> None:
        """Print one sentence.

        Args:
            parts: texts, or texts with a style, such as ``("error:", "bold red")``.
            wrap: break the sentence between words, at the width of the screen.
        """
        texts = [(part, "") if isinstance(part, str) else part for part in parts]
        self.print(Text.assemble(*((line(text), style) for text, style in texts)), soft_wrap=not wrap)


def line(text: str) -> str:
    """Return a text to print: shortened, with control characters escaped, and its further lines indented."""
    return visible(shortened(text).replace("\r\n", "\n")).replace("\n", _INDENT)


class Commands(TyperGroup):
    """The commands, in groups; error messages about arguments are printed with control characters escaped."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for panel, names in PANELS.items():
            for name in names:
                vars(self.commands[name])["rich_help_panel"] = panel
        for known in self.commands.values():
            # typer keeps the line breaks of the source in all paragraphs but the first.
            known.help = "\n\n".join(" ".join(each.split()) for each in (known.help or "").split("\n\n"))

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands in the order of their groups."""
        grouped = [name for names in PANELS.values() for name in names]
        return sorted(super().list_commands(ctx), key=lambda name: grouped.index(name) if name in grouped else -1)

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


def print_anything() -> None:
    """Let the standard streams escape the characters that their encoding does not have."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
