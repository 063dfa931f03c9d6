"""Texts from elsewhere, made harmless for terminals, Markdown and spreadsheets; and lists and columns of plain text."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable, Sequence
from typing import TypeVar

Number = TypeVar("Number", int, float)

LONGEST = 2_000
"""Largest number of characters of a failure's text that are kept: half from its beginning, half from its end."""

_ACTED_UPON = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # control characters, except tab and line feed
    "\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"  # text directions, line separators, zero width
    "\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"
    "\ud800-\udfff]"  # surrogates, which no file can hold
)

_FORMULA = re.compile("[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
"""First characters of cells that a spreadsheet evaluates; the last four are full-width forms."""


def plain(value: object) -> str:
    """Return ``str(value)`` as a plain string, or the name of its type if ``str`` fails."""
    try:
        # join returns a plain str; a subclass of str may have methods of its own.
        return "".join((str(value),))
    except (Exception, SystemExit):
        return type(value).__name__


def shortened(text: str, longest: int = LONGEST) -> str:
    """Return a text of at most ``longest`` characters: its beginning, the number of characters left out, its end."""
    if len(text) <= longest:
        return text
    room = longest - len(_gap(len(text)))
    tail = room // 2
    head = room - tail
    return text[:head] + _gap(len(text) - head - tail) + text[len(text) - tail :]


def number_in(text: str, kind: type[Number]) -> Number:
    """Return the number that a text is; a ValueError otherwise, also for ``1_0`` and digits of other scripts."""
    if "_" in text or not text.isascii():
        raise ValueError(f"{text!r} is not a number")
    return kind(text)


def enumerated(items: Iterable[object], most: int) -> str:
    """Return items with commas between them; if there are more than ``most``, the first ones and an ellipsis."""
    texts = [str(item) for item in items]
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")


def _gap(characters: int) -> str:
    return f" ... ({characters} characters left out) ... "


def visible(text: str) -> str:
    r"""Return a text with its control characters written out, such as ``\x1b`` for an escape."""

    def written_out(character: re.Match[str]) -> str:
        code = ord(character[0])
        return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"

    return _ACTED_UPON.sub(written_out, text)


def quoted(value: object) -> str:
    """Return a text of a file for a message: in one line, shortened, and with control characters written out."""
    return shortened(visible(" ".join(plain(value).split())), 100)


def text_of(reason: object) -> str:
    """Return a reason as shortened text that every file can hold; a reason from a serial line may have any bytes."""
    return shortened(plain(reason)).encode("utf-8", "backslashreplace").decode()


def reason_of(error: BaseException) -> str:
    """Return the type and the message of an exception, shortened to leave room for a sentence around it."""
    name, message = type(error).__name__, plain(error)
    # Room for a sentence around it, so that a text is not shortened twice.
    return shortened(f"{name}: {message}" if message and message != name else name, LONGEST - 200)


def shell_word(path: object) -> str:
    """Return a file's name as a word of a command to copy, without control characters or marks of direction."""
    text = str(path)
    if text.isprintable():
        return shlex.quote(text)
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    codes = (c if c.isprintable() else "".join(f"\\x{byte:02x}" for byte in os.fsencode(c)) for c in escaped)
    return f"$'{''.join(codes)}'"


def guarded(text: str) -> str:
    """Return a text for a cell of CSV, with an apostrophe (see `unguarded`) if a spreadsheet would evaluate it."""
    return f"'{text}" if _FORMULA.match(text.lstrip("'")) else text


def unguarded(cell: str) -> str:
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell.lstrip("'")) else cell


def markdown_text(text: str, longest: int = LONGEST) -> str:
    """Return a text in one line, in which characters that Markdown or HTML acts upon are escaped."""
    return re.sub(r"([\\`*_{}\[\]<>#|!~])", r"\\\1", " ".join(shortened(visible(text), longest).split()))


def aligned(rows: Sequence[Sequence[str]], *, right: bool = False) -> str:
    """Return rows of texts as columns of plain text."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = zip(row, widths, strict=True)
        lines.append("  ".join(f"{cell:{'>' if right and i else '<'}{width}}" for i, (cell, width) in enumerate(cells)))
    return "\n".join(line.rstrip() for line in lines)


def parted(label: str) -> tuple[str, str]:
    """Return the name and the unit of ``name [unit]``; ``x[1]`` is a name, as FMUs have them, and has no unit."""
    label = label.strip()
    name, bracket, unit = label.removesuffix("]").rpartition("[")
    is_unit = bracket and label.endswith("]") and not unit.strip().isdigit()
    return (name.strip(), unit.strip()) if is_unit else (label, "")


def as_text(value: object) -> str:
    """Return a number, a list of numbers or a table of numbers as text; floats have four significant digits."""
    match value:
        case None:
            return "-"
        case float():
            return f"{value:.4g}"
        case list() | tuple():
            return ", ".join(as_text(item) for item in value)
        case dict():
            return ", ".join(f"{name} {as_text(item)}" for name, item in value.items())
        case _:
            return str(value)
