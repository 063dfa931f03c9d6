"""Signatures of the settings in a store by secret keys of its users, and the settings that would run code."""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ctxval import cases, searches
from ctxval._util.registry import declaration_of
from ctxval.certificates import KINDS
from ctxval.cli.config.parts import REGISTRIES
from ctxval.errors import InputError

SIGNATURES = "signatures"  #: the key of the signatures in the settings of a store

_BYTES = 32


def key_path() -> Path:
    """Return the path of this user's secret key: ``$XDG_STATE_HOME/ctxval/key``, or in %LOCALAPPDATA% on Windows."""
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_STATE_HOME", "")
    if os.path.isabs(base):
        return Path(base) / "ctxval" / "key"
    try:
        return Path.home() / ".local" / "state" / "ctxval" / "key"
    except RuntimeError as error:
        raise OSError(None, "there is no home folder") from error


def signed(settings: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with a signature of this user; without one if the user's key cannot be made."""
    plain: dict[str, Any] = json.loads(json.dumps(unsigned(settings)))  # as a store returns them
    signatures = _signatures(before) if unsigned(before) == plain else []
    with suppress(OSError):
        signatures = list(dict.fromkeys([_signature(_made_key(), plain), *signatures]))
    # At most 16, one for each user and computer.
    return {**plain, **({SIGNATURES: signatures[:16]} if signatures else {})}


def verifies(settings: Mapping[str, Any]) -> bool:
    if signatures := _signatures(settings):
        with suppress(OSError):
            signature = _signature(_read_key(key_path()), settings)
            return any(hmac.compare_digest(signature, each) for each in signatures)
    return False


def unsigned(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key != SIGNATURES}


def why_no_key() -> str | None:
    """Return why this user cannot sign; None if there is a key or one can be made."""
    try:
        _made_key()
    except OSError as error:
        return f"the key in {error.filename or 'the home folder'} cannot be used: {error.strerror}"
    return None


def _signatures(settings: Mapping[str, Any]) -> list[str]:
    match settings.get(SIGNATURES):
        case [*kept]:
            return [each for each in kept if isinstance(each, str) and each.isascii()]
    return []


def _signature(key: bytes, settings: Mapping[str, Any]) -> str:
    canonical = json.dumps(unsigned(settings), sort_keys=True, separators=(",", ":"))
    return hmac.new(key, f"ctxval settings 1\n{canonical}".encode(), hashlib.sha256).hexdigest()


def _made_key() -> bytes:
    """Return the user's key, and make it if there is none; if two processes make it, both return the same one."""
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
        try:
            os.link(name, path)
        except OSError:
            # Another process was faster, or this disk has no hard links. In the latter case, if two processes make a
            # key at the same moment, the last one is kept, and the store of the other process asks the user again.
            if not path.exists():
                os.replace(name, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(name)
    return _read_key(path)


def _read_key(path: Path) -> bytes:
    with path.open("rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        key = file.read(_BYTES + 1)
    problem = None
    if os.name == "posix" and mode & 0o077:
        who = f"other users (mode {stat.filemode(mode)}), who may have signed stores with it"
        problem = f"can be read or written by {who}"
    elif len(key) != _BYTES:
        size = len(key) if len(key) < _BYTES else "more"
        problem = f"is damaged: it must have {_BYTES} bytes, got {size}"
    if problem is not None:
        again = "a new key is made, and for stores that carry the old signature the question is asked again"
        raise InputError(f"the key {path} {problem}. Delete it: {again}.")
    return key


# Settings that would run code


def code_named(settings: Mapping[str, Any]) -> list[str]:
    """Return the settings whose code would run if the experiment were built, each as a text to show.

    Everything that is not known to be data counts as code: every reference, a task by name, a part that runs programs
    or other libraries, and every name that this package does not have, since an installed one may have it.
    """
    # The key of a setting that names a part, the key of the name if it is a table, and the parts that are known.
    named: list[tuple[str, str, Any]] = [("experiment", "", cases.REGISTRY)]
    named += ((kind, "type", registry) for kind, registry in REGISTRIES.items())
    named += (("search", "name", searches.REGISTRY), ("certificate", "kind", KINDS))
    try:
        code = [_shown(key, settings[key]) for key in ("task", "outputs") if isinstance(settings.get(key), str)]
        match settings:
            case {"recordings": {"observer": observer}}:
                code.append(_shown("recordings.observer", observer))
        for key, name_key, registry in named:
            code += _parts(key, settings.get(key), name_key, registry)
        return [*code, *_references("", settings)]
    except RecursionError:
        return ["settings that are nested too deeply to be checked"]


def _parts(where: str, given: Any, name_key: str, registry: Any) -> Iterator[str]:
    """Yield a part if it runs code, or else those of its arguments that are parts and run code."""
    is_table = bool(name_key) and isinstance(given, Mapping)
    name = given.get(name_key) if is_table else given
    if name is None:
        return
    if not registry.is_data(name):
        yield _shown(where, given)
    elif is_table and (declared := declaration_of(registry.find(name))) is not None:
        for key, kind in declared.parts.items():
            yield from _parts(f"{where}.{key}", given.get(key), "type", REGISTRIES[kind])


def _references(where: str, value: Any) -> Iterator[str]:
    match value:
        case {}:
            if "ref" in value:
                yield _shown(where, value["ref"])
            for key, item in value.items():
                yield from _references(f"{where}.{key}" if where else str(key), item)
        case [*items]:
            for item in items:
                yield from _references(where, item)


def _shown(where: str, value: Any) -> str:
    """Return a setting as text, shortened and with control characters escaped."""
    text = f"{ascii(where)[1:-1]} = {value!a}"
    return text if len(text) <= 160 else f"{text[:80]}...{text[-80:]}"
