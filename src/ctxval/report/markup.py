"""HTML and SVG elements whose texts are always escaped, and the few shapes that sections are made of.

A text that is not :class:`Markup` is escaped, its control characters are written out, and it is shortened. So a name
from a store can neither script the page nor change its layout.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np
from markupsafe import Markup, escape

from ctxval._util.representation import shown
from ctxval._util.texts import plain, shortened, visible

UNCUT = 100_000  # characters of one text that must never be shortened, such as an assumption

# Texts


def text(value: object, longest: int = 2_000) -> Markup:
    """Return a text that cannot be markup; :class:`Markup` and charts stay as they are."""
    if hasattr(value, "__html__"):
        return Markup(value.__html__())
    return escape(shortened(visible(plain(value)), longest))


def number(value: object, digits: int = 4) -> str:
    """Return a number as text, with so many significant digits; other values as at a prompt."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
        return shown(value)
    short = str(int(value)) if isinstance(value, int | np.integer) else f"{float(value):.{digits}g}"
    return short.replace("-", "\u2212") if short != "-0" else "0"


def percent(share: float, digits: int = 2) -> str:
    """Return a share in percent; only a share of nothing is 0 %, and only a share of all is 100 %."""
    value = 100 * share
    if 0 < value < 0.01:
        return "less than 0.01 %"
    if 99.9 < value < 100:
        return "more than 99.9 %"
    return f"{value:.{max(digits, 3 if value >= 10 else digits)}g} %"


def quantity(value: float | str | None, units: str = "") -> str:
    """Return a number with its unit; a dash if it is None."""
    return "\u2013" if value is None else f"{number(value)} {units}".rstrip()


def sentence(words: str) -> str:
    """Return words that begin with a capital letter."""
    return f"{words[:1].upper()}{words[1:]}"


# Elements


def element(name: str, /, *children: object, **attributes: object) -> Markup:
    """Return one element with children: elements, or texts that are escaped; None is left out.

    An underscore in an attribute is a hyphen, and one at the end is dropped: ``class_``. An attribute that is None is
    left out, and one that is True has no value.
    """
    given = Markup("")
    for key, value in attributes.items():
        if value is not None:
            content = Markup("") if value is True else Markup('="{}"').format(text(value, 4_000_000))
            given += Markup(" {}{}").format(Markup(key.rstrip("_").replace("_", "-")), content)
    if name in ("br", "meta", "link", "input"):
        return Markup("<{}{}>").format(Markup(name), given)
    return Markup("<{0}{1}>{2}</{0}>").format(
        Markup(name), given, joined(child for child in children if child is not None)
    )


def joined(parts: Iterable[object]) -> Markup:
    """Return elements and charts one after the other; other texts are escaped."""
    return Markup("").join(map(text, parts))


def with_code(value: object) -> Markup:
    """Return a text whose commands, between backquotes, are code; elements stay as they are."""
    return (
        text(value) if hasattr(value, "__html__") else Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(text(value))))
    )


def paragraph(*children: object, class_: str | None = None) -> Markup:
    """Return a paragraph."""
    return element("p", *(with_code(child) for child in children if child is not None), class_=class_)


def heading(words: object, level: int = 3) -> Markup:
    """Return a heading inside a section, whose own heading has level 2."""
    return element(f"h{level}", words)


def bullets(items: Iterable[object]) -> Markup:
    """Return a list."""
    return element("ul", *(element("li", with_code(item)) for item in items))


def table(
    caption: str,
    headers: Sequence[str],
    rows: Iterable[Sequence[object]],
    class_: str | None = None,
    *,
    id_: str | None = None,
    label: str | None = None,
    scroll: str = "scroll",
) -> Markup:
    """Return a table with a caption, which scrolls by itself; a row is an element, or values with a header first.

    Numbers have four digits. The label is the caption, unless it is given.
    """
    head = element("tr", *(element("th", header, scope="col") for header in headers))
    body = []
    for row in rows:
        if not isinstance(row, Markup):
            first, *others = map(cell, row)
            row = element("tr", element("th", first, scope="row"), *(element("td", value) for value in others))
        body.append(row)
    inside = element("caption", caption), element("thead", head), element("tbody", *body)
    whole, label = element("table", *inside, class_=class_, id=id_), label or shortened(visible(caption), 120)
    # What scrolls by itself must be reached by the keyboard.
    return element("div", whole, class_=scroll, tabindex="0", role="region", aria_label=label)


def cell(value: object) -> Markup:
    """Return the content of a cell: numbers with four digits, a dash for None."""
    if value is None:
        return Markup("&ndash;")
    return text(value if isinstance(value, str) or hasattr(value, "__html__") else number(value), 300)


def bar(share: float) -> Markup:
    """Return a bar as long as a share from 0 to 1, which only repeats a number beside it."""
    shape = element("rect", width=f"{100 * share:.1f}", height=9, class_="bar")
    return element("svg", shape, viewBox="0 0 100 9", preserveAspectRatio="none", class_="bars", aria_hidden="true")


def code(words: str, label: str) -> Markup:
    """Return a block to copy."""
    return element("pre", element("code", words), tabindex="0", role="region", aria_label=label)


def details(summary: str, *children: object, opened: bool = False) -> Markup:
    """Return a part that can be folded; it is unfolded in print."""
    return element("details", element("summary", summary), *children, open=opened or None)
