"""Texts that come from elsewhere: how much of one is kept, and what a terminal or a spreadsheet would act upon."""

from __future__ import annotations

import re

LONGEST = 2_000
"""Characters of a failure's text that are kept and printed: its beginning and its end, half of them each."""

_SENTENCE = 200
"""Characters left free for the sentence that a reason becomes part of, so that nothing is cut twice."""

_ACTED_UPON = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # controls, but for the tab and the end of a line
    "\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"  # directions, line separators, what has no width
    "\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"
    "\ud800-\udfff]"  # halves of a character, which no file holds
)

_FORMULA = re.compile("[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
"""How a cell begins that a spreadsheet computes; the last four are their wide forms."""


def plain(value: object) -> str:
    """Return ``str(value)`` as a plain string; the name of its type if it has none."""
    try:
        # Joined, as a subclass of str may have methods of its own.
        return "".join((str(value),))
    except (Exception, SystemExit):
        return type(value).__name__


def shortened(text: str, longest: int = LONGEST) -> str:
    """Return at most ``longest`` characters of a text: its beginning, how many were left out, and its end."""
    if len(text) <= longest:
        return text
    room = longest - len(_gap(len(text)))
    tail = room // 2
    head = room - tail
    return text[:head] + _gap(len(text) - head - tail) + text[len(text) - tail :]


def _gap(characters: int) -> str:
    return f" ... ({characters} characters left out) ... "


def visible(text: str) -> str:
    r"""Return a text in which whatever a terminal would act upon is written out, such as ``\x1b`` for an escape."""
    return _ACTED_UPON.sub(lambda found: _written_out(ord(found[0])), text)


def _written_out(code: int) -> str:
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def text_of(reason: object) -> str:
    """Return a reason as text that every file can hold, shortened; a serial line may have put anything into it."""
    return shortened(plain(reason)).encode("utf-8", "backslashreplace").decode()


def reason_of(error: BaseException) -> str:
    """Return what an exception says, and its type; shortened, with room for a sentence around it."""
    name, said = type(error).__name__, plain(error)
    return shortened(f"{name}: {said}" if said and said != name else name, LONGEST - _SENTENCE)


def guarded(text: str) -> str:
    """Return a text for a cell of CSV: with an apostrophe before it where a spreadsheet would compute it.

    :func:`unguarded` undoes exactly that.
    """
    return f"'{text}" if _FORMULA.match(text.lstrip("'")) else text


def unguarded(cell: str) -> str:
    """Return the text of a cell that :func:`guarded` wrote."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell.lstrip("'")) else cell
