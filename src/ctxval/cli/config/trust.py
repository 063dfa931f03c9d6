"""The settings of stores whose code this user allows to run, kept as direnv does, and the settings that name code."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ctxval import cases, searches
from ctxval._util.registry import declaration_of
from ctxval.certificates import KINDS
from ctxval.cli.config.parts import REGISTRIES
from ctxval.errors import InputError


def allowed_folder() -> Path:
    """Return the folder of this user's list: ``$XDG_STATE_HOME/ctxval/allowed``, or in %LOCALAPPDATA% on Windows."""
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_STATE_HOME", "")
    if os.path.isabs(base):
        return Path(base) / "ctxval" / "allowed"
    try:
        return Path.home() / ".local" / "state" / "ctxval" / "allowed"
    except RuntimeError as error:
        raise OSError(None, "there is no home folder") from error


def allow(settings: Mapping[str, Any]) -> str | None:
    """Allow the code that settings name: an empty file is named by their SHA-256; return why it cannot be written."""
    try:
        allowed_folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        _entry(settings).touch()
    except OSError as error:
        return f"{error.filename or 'the home folder'} cannot be used: {error.strerror}"
    return None


def is_allowed(settings: Mapping[str, Any]) -> bool:
    with suppress(OSError):
        if _entry(settings).is_file():
            folder = allowed_folder()
            if os.name == "posix" and folder.stat().st_mode & 0o022:
                why = "other users can write to it, and may have allowed their own stores"
                raise InputError(f"{folder} is not used: {why}. Delete it; you are then asked again about stores.")
            return True
    return False


def _entry(settings: Mapping[str, Any]) -> Path:
    # In the form that a store returns.
    canonical = json.dumps(json.loads(json.dumps(settings)), sort_keys=True, separators=(",", ":"))
    return allowed_folder() / hashlib.sha256(canonical.encode()).hexdigest()


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
