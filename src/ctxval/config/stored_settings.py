"""The settings in a store, and which of them may be used: those that name code must be signed by this user."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ctxval.certificates import KINDS
from ctxval.config.settings import Settings, read_settings, sentence_of
from ctxval.config.signatures import code_named, unsigned, verifies
from ctxval.errors import InputError
from ctxval.searches.auto import present_options
from ctxval.storage.store import Store


def stored_settings(store: Store) -> Settings:
    """Return the settings in a store, whoever wrote them.

    Do not build anything from them: :func:`trusted_settings` returns those that may be used.

    Raises:
        InputError: if the store has no settings, or they are not valid.
    """
    return _of_store(store.settings())


def planned_settings(store: Store, kind: str | None = None) -> Settings:
    """Return the settings in a store, as :func:`stored_settings` does; the defaults if no command made the store.

    Args:
        store: the store of the trials.
        kind: the kind of certificate that the user asks for; None to use the kind in the store's settings.

    Raises:
        InputError: if the settings are not valid, or their certificate would run code that the user did not choose.
    """
    kept = store.settings()
    if not kept:
        return Settings()
    settings = stored_settings(store)
    planned = settings.certificate.kind
    if kind is None and not KINDS.is_data(planned) and not verifies(kept):
        raise InputError(
            f"{store.name} names the certificate {planned!r}, which is code of another package, and you did not make "
            f"the store. Give --kind {planned} if you trust that package, or give another kind."
        )
    return settings


def _of_store(kept: dict[str, Any]) -> Settings:
    if not kept:
        raise InputError(
            "the store does not name its experiment, because it was not made by a command: name the experiment with "
            "--experiment FILE.toml."
        )
    plain, search = unsigned(kept), kept.get("search")
    if isinstance(search, dict) and search.get("name") == "auto":
        plain = {**plain, "search": present_options(search)}
    try:
        return Settings.model_validate(plain)
    except ValidationError as error:
        raise InputError(sentence_of("the store's settings", error)) from error


def trusted_settings(store: Store, *, experiment: str | None = None, trust: bool = False) -> Settings:
    """Return the settings from which a store's experiment may be built.

    Args:
        store: the store. If its settings name code, this user must have signed them.
        experiment: a case, a file or ``module:attr`` that the user names instead. The seed of the store is used all the
            same, and its search if the search names no code.
        trust: accept the settings of the store, whoever wrote them.

    Raises:
        InputError: if the settings name code that the user has not allowed to run; the message shows the code.
    """
    kept = store.settings()
    if experiment is not None:
        return _named_again(kept, experiment)
    settings, code = _of_store(kept), code_named(kept)
    if not code or (settings.folder is not None and verifies(kept)):
        return settings
    folder = settings.folder or Path().resolve()
    if trust:
        return settings.model_copy(update={"folder": folder})
    more = f" and {len(code) - _SHOWN} more" if len(code) > _SHOWN else ""
    raise InputError(
        f"{store.path} would import or run code: {'; '.join(code[:_SHOWN])}{more}, from the folder "
        f"{ascii(str(folder))[:200]}. You did not make the store on this computer, or it was changed since, or an "
        "older version made it. If you know its experiment, name it with --experiment FILE.toml (or module:attr). If "
        "you trust the code that the store names, give --trust. The store then carries your signature, and the "
        "question will not be asked again."
    )


_SHOWN = 8
"""Largest number of pieces of code that the message shows."""


def _named_again(kept: dict[str, Any], experiment: str) -> Settings:
    settings = read_settings(experiment, {})
    try:
        stored = _of_store(kept)
    except InputError:
        return settings
    same: dict[str, Any] = {"seed": stored.seed}
    if not code_named({"search": kept.get("search", {})}):
        same["search"] = stored.search
    return settings.model_copy(update=same)
