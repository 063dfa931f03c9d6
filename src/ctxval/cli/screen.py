"""Output for people: texts are printed without markup, and control characters in them are escaped."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from ctxval._util.texts import shortened, visible


class Screen(Console):
    """A console that prints texts literally.

    Everything that rich prints is rendered here. Control characters are therefore escaped in lines, in tables and in
    progress bars alike.
    """

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


def print_anything() -> None:
    """Let the standard streams escape the characters that their encoding does not have."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
