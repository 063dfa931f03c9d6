"""Signatures of the settings in a store, and which settings would run code.

A command that writes settings signs them with a secret key of its user; settings that were edited, or that come from
somebody else, do not verify. Signatures of several users stand side by side.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ctxval import cases, searches
from ctxval.certificates import KINDS
from ctxval.config.parts import REGISTRIES
from ctxval.errors import InputError

SIGNATURES = "signatures"
"""The key of the settings in a store under which their signatures stand."""

_BYTES = 32
_USERS = 16
"""Largest number of signatures that settings keep; each is of one user on one computer."""

_SHOWN = 160
"""Characters of a setting in a store that are shown."""


def key_path() -> Path:
    """Return where this user's secret key is: ``$XDG_STATE_HOME/ctxval/key``, or %LOCALAPPDATA% on Windows.

    Raises:
        OSError: this user has no home folder.
    """
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_STATE_HOME", "")
    if os.path.isabs(base):
        return Path(base) / "ctxval" / "key"
    try:
        return Path.home() / ".local" / "state" / "ctxval" / "key"
    except RuntimeError as error:
        raise OSError(None, "there is no home folder") from error


def signed(settings: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with a signature of this user; without one if the user's key cannot be made.

    Args:
        settings: plain values, as they are stored.
        before: what is stored now; if only its signatures differ, those of other users are kept.

    Raises:
        InputError: the key is damaged.
    """
    plain = _plain(settings)
    others = _signatures(before) if _plain(before) == plain else []
    try:
        own = _signature(_made_key(), plain)
    except OSError:
        own = None
    if own is not None and own not in others:
        others = [own, *others]
    return {**plain, **({SIGNATURES: others[:_USERS]} if others else {})}


def verifies(settings: Mapping[str, Any]) -> bool:
    """Return whether settings are as this user signed them.

    Raises:
        InputError: the user's key is damaged.
    """
    signatures = _signatures(settings)
    try:
        key = _read_key(key_path()) if signatures else None
    except OSError:
        return False
    return key is not None and any(hmac.compare_digest(_signature(key, settings), each) for each in signatures)


def unsigned(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings without their signatures."""
    return {key: value for key, value in settings.items() if key != SIGNATURES}


def why_no_key() -> str | None:
    """Return why this user cannot sign; None if there is a key or one can be made.

    Raises:
        InputError: the key is damaged.
    """
    try:
        _made_key()
    except OSError as error:
        return f"the key in {error.filename or 'the home folder'} cannot be used: {error.strerror}"
    return None


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings without signatures as they come out of a store."""
    found: dict[str, Any] = json.loads(json.dumps(unsigned(settings)))
    return found


def _signatures(settings: Mapping[str, Any]) -> list[str]:
    found = settings.get(SIGNATURES)
    return [each for each in found if isinstance(each, str) and each.isascii()] if isinstance(found, list) else []


def _signature(key: bytes, settings: Mapping[str, Any]) -> str:
    canonical = json.dumps(unsigned(settings), sort_keys=True, separators=(",", ":"))
    return hmac.new(key, f"ctxval settings 1\n{canonical}".encode(), hashlib.sha256).hexdigest()


def _made_key() -> bytes:
    """Return the user's key, which is made if there is none; of two processes that make it, one wins."""
    path = key_path()
    with suppress(FileNotFoundError):
        return _read_key(path)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=".key-", dir=path.parent)  # with mode 0600
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(secrets.token_bytes(_BYTES))
            file.flush()
            os.fsync(file.fileno())
        _publish(name, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(name)
    return _read_key(path)


def _publish(name: str, path: Path) -> None:
    """Give a whole file its name, unless another process was faster."""
    try:
        os.link(name, path)
    except FileExistsError:
        return
    except OSError:
        # There are no hard links on this disk: of two processes at this very moment the last one wins, and the other's
        # store asks once more.
        if not path.exists():
            os.replace(name, path)


def _read_key(path: Path) -> bytes:
    with path.open("rb") as file:
        key = file.read(_BYTES + 1)
    if len(key) != _BYTES:
        raise InputError(
            f"the key {path} is damaged: it must have {_BYTES} bytes, got {len(key) if len(key) < _BYTES else 'more'}. "
            "Delete it; a new one is made, and stores that were signed with the old one ask once more."
        )
    return key


# Settings that would run code


def code_named(settings: Mapping[str, Any]) -> list[str]:
    """Return the settings whose code would run if the experiment were built, each as a text to show.

    Whatever is not known to be data counts as code: a reference anywhere, a task by name, a part of this package that
    runs programs or foreign libraries, and every case, part, search and certificate that this package does not have:
    an installed package may have it, and its code would be imported. No package is looked at to find out.
    """
    try:
        return _code_named(settings)
    except RecursionError:
        return ["what is nested too deeply to be looked through"]


def _code_named(settings: Mapping[str, Any]) -> list[str]:
    found = []
    if isinstance(settings.get("task"), str):
        found.append(_shown("task", settings["task"]))
    for key, name_key, is_data in _NAMED:
        given = settings.get(key)
        name = given.get(name_key) if name_key and isinstance(given, Mapping) else given
        if name is not None and not is_data(name):
            found.append(_shown(key, given))
    return [*found, *_references("", settings)]


_NAMED: tuple[tuple[str, str | None, Callable[[Any], bool]], ...] = (
    ("experiment", None, cases.REGISTRY.is_data),
    *((kind, "type", registry.is_data) for kind, registry in REGISTRIES.items()),
    ("search", "name", searches.REGISTRY.is_data),
    ("certificate", "kind", KINDS.is_data),
)
"""Settings that name a part: the key, the key of the name if it is a table, and whether a name is known to be data."""


def _references(where: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        if "ref" in value:
            yield _shown(where, value["ref"])
        for key, item in value.items():
            yield from _references(f"{where}.{key}" if where else str(key), item)
    elif isinstance(value, list):
        for item in value:
            yield from _references(where, item)


def _shown(where: str, value: Any) -> str:
    """Return a setting as text in which nothing steers a terminal, cut where it is long."""
    text = f"{ascii(where)[1:-1]} = {value!a}"
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN // 2]}...{text[-_SHOWN // 2 :]}"
