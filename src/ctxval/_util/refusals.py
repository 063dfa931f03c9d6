"""Errors of others in a sentence of ctxval, and libraries that only some users need.

Each of these libraries is in an extra of the package, and is imported when it is used.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ctxval._util.texts import plain, reason_of
from ctxval.errors import CtxvalError, InputError


def require_extra(module: str, extra: str, needs: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = (error.name or module).partition(".")[0]
        raise InputError(f"{needs} {name}: pip install 'ctxval[{extra}]'.") from error


@contextmanager
def reworded(what: str, *kinds: type[BaseException], to: type[CtxvalError] = InputError) -> Iterator[None]:
    """Raise an error of ctxval in the place of others: what cannot be done, and after a colon why.

    The kinds are those of expected errors, whose messages are reasons. Without kinds, it is code of others that may
    raise anything; the name of an exception is then a part of the reason, and errors of ctxval are raised as they are.
    """
    caught = kinds or (Exception, SystemExit)
    try:
        yield
    except caught as error:
        if not kinds and isinstance(error, CtxvalError):
            raise
        reason = " ".join(plain(getattr(error, "strerror", None) or error).split()) if kinds else reason_of(error)
        ended = "" if reason.endswith("?") or not issubclass(to, InputError) else "."
        raise to(f"{what}: {reason.removesuffix('.')}{ended}") from error
