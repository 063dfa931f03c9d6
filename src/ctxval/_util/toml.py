"""Files in TOML that are written: names from files are data, and a file that people have edited is recognised."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ctxval._util.files import MADE_BY, read_bytes, write_text
from ctxval.errors import InputError


def toml_text(content: Mapping[str, Any]) -> str:
    """Return a TOML file with the content of a table or of a document of tomlkit, whose comments stay.

    Characters that are not visible, such as marks that turn the direction of writing, are escaped. Surrogates, which no
    TOML file can hold, become U+FFFD.
    """
    import tomlkit  # imported here, because only few commands write files

    def visible(character: str) -> str:
        if character.isprintable() or character in "\n\t":
            return character
        code = ord(character)
        return "\ufffd" if 0xD800 <= code < 0xE000 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"

    return "".join(map(visible, tomlkit.dumps(content)))


def write_toml(path: Path, content: Mapping[str, Any]) -> Path:
    """Write a TOML file with a first line by which a later call knows whether it was edited."""
    text = toml_text(content)
    return write_text(path, f"{_first_line(text)}\n{text}")


def require_unedited(path: Path) -> None:
    """Check that a file is unchanged since :func:`write_toml` wrote it, or absent, so that it may be replaced."""
    if not path.exists():
        return
    first, _, text = read_bytes(path, 2**26).decode("utf-8", "replace").replace("\r\n", "\n").partition("\n")
    if first != _first_line(text):
        how = "was edited since ctxval wrote it" if first.startswith(f"# {MADE_BY}") else "is no file that ctxval wrote"
        raise InputError(f"{path} {how}: give another name, or --force to replace it.")


def _first_line(text: str) -> str:
    return f"# {MADE_BY}, digest {hashlib.sha256(text.encode()).hexdigest()[:16]}"
