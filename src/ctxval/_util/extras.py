"""Libraries that only some users need: each is in an extra of the package, and is imported when it is used."""

from __future__ import annotations

import importlib
from typing import Any

from ctxval.errors import InputError


def require_extra(module: str, extra: str, needs: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = (error.name or module).partition(".")[0]
        raise InputError(f"{needs} {name}: pip install 'ctxval[{extra}]'.") from error
