"""The settings of stores from which this user lets experiments be built, kept as direnv does.

Building an experiment may import modules, run programs and read files, so no settings are used that nobody allowed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

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
    """Allow settings: an empty file is named by their SHA-256. Return why it cannot be written; None if it is."""
    try:
        allowed_folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        _entry(settings).touch()
    except OSError as error:
        return f"{error.filename or 'the home folder'} cannot be used: {error.strerror}"
    return None


def is_allowed(settings: Mapping[str, Any]) -> bool:
    with suppress(OSError, RecursionError):  # settings may be nested too deeply to be written
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
