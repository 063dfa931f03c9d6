"""The settings in a store, and which of them may be used: those that name code must be signed by this user."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ctxval._util.registry import declaration_of
from ctxval.campaign.storage.store import Store
from ctxval.certificates import KINDS
from ctxval.cli.config.parts import REGISTRIES
from ctxval.cli.config.settings import Settings, read_settings, sentence_of
from ctxval.cli.config.signatures import code_named, unsigned, verifies
from ctxval.errors import InputError


def planned_settings(store: Store, kind: str | None = None) -> Settings:
    """Return the settings in a store, whoever wrote them; the defaults if no command made the store.

    Do not build anything from them: :func:`trusted_settings` returns those that may be used.
    """
    kept = store.settings()
    if not kept:
        return Settings()
    settings = _of_store(kept)
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
    try:
        return Settings.model_validate(unsigned(kept))
    except ValidationError as error:
        raise InputError(sentence_of("the store's settings", error)) from error


def trusted_settings(store: Store, *, experiment: str | None = None, trust: bool = False) -> Settings:
    """Return the settings from which a store's experiment may be built."""
    kept = store.settings()
    if experiment is not None and trust:
        raise InputError("--trust and --experiment cannot be given together.")
    if experiment is not None:
        named = read_settings(experiment, {})
        try:
            stored = _of_store(kept)
        except InputError:
            return named
        same: dict[str, Any] = {"seed": stored.seed}
        if not code_named({"search": kept.get("search", {})}):
            same["search"] = stored.search
        return named.model_copy(update=same)
    settings, code = _of_store(kept), code_named(kept)
    folder = settings.folder or Path().resolve()
    outside = [] if store.path is None else _files_outside(kept, folder, store.path.resolve().parent)
    signed = (settings.folder is not None or not code) and verifies(kept)
    if not (code or outside) or signed:
        return settings
    if trust:
        return settings.model_copy(update={"folder": folder})
    if not code:
        raise InputError(
            f"{store.path} names files outside its folder: {'; '.join(outside[:8])}. You did not make the store "
            "on this computer, or it was changed since. If you know its experiment, name it with --experiment "
            "FILE.toml (or module:attr). If you trust the store, give --trust."
        )
    more = f" and {len(code) - 8} more" if len(code) > 8 else ""
    raise InputError(
        f"{store.path} would import or run code: {'; '.join(code[:8])}{more}, from the folder "
        f"{ascii(str(folder))[:200]}. You did not make the store on this computer, or it was changed since, or an "
        "older version made it. If you know its experiment, name it with --experiment FILE.toml (or module:attr). If "
        "you trust the code that the store names, give --trust. The store then carries your signature, and the "
        "question will not be asked again."
    )


_FILE_KEYS = {"refined", "data", "logs"}.union(
    *(
        declared.files
        for registry in REGISTRIES.values()
        for name in registry.built_in
        if (declared := declaration_of(registry.find(name)))
    )
)
"""The keys of settings whose texts are paths."""


def _files_outside(kept: dict[str, Any], folder: Path, home: Path) -> list[str]:
    """Return the files that settings name outside a folder, each as a text to show."""
    parts = {key: value for key, value in kept.items() if key in (*REGISTRIES, "refined")}
    named = [name for text in _texts(parts, False) for name in (_IN_XML.findall(text) if "<" in text else [text])]
    return [ascii(name)[:200] for name in named if "\0" in name or not (folder / name).resolve().is_relative_to(home)]


def _texts(value: Any, path: bool) -> Iterator[str]:
    """Yield the texts in settings that are paths, or a MuJoCo model as its text."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _texts(item, path or key in _FILE_KEYS)
    elif isinstance(value, list):
        for item in value:
            yield from _texts(item, path)
    elif path and isinstance(value, str):
        yield value


_IN_XML = re.compile(r"""(?:file|dir)\s*=\s*["']([^"']+)""")
