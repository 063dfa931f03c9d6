"""The settings in a store, those that may be used, since this user allows the code that they name, and the campaign."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ctxval import Campaign, Experiment, Store
from ctxval._util.checked import PositiveFloat, PositiveInt, require
from ctxval._util.registry import declaration_of
from ctxval.campaign.storage.other_stores import STORE_SUFFIXES
from ctxval.certificates import KINDS
from ctxval.cli.base import Allowed, err
from ctxval.cli.config.parts import REGISTRIES
from ctxval.cli.config.settings import ExperimentSettings, not_an_experiment, read_settings, sentence_of
from ctxval.cli.config.trust import allow, code_named, is_allowed
from ctxval.errors import InputError


def planned_settings(store: Store, kind: str | None = None) -> ExperimentSettings:
    """Return the settings in a store, whoever wrote them, from which nothing may be built; the defaults if none."""
    kept = store.settings()
    if not kept:
        return ExperimentSettings()
    settings = _of_store(kept)
    planned = settings.certificate.kind
    if kind is None and not KINDS.is_data(planned) and not is_allowed(kept):
        why = f"{store.name} names the certificate {planned!r}, which is code of another package"
        how = f"Give --kind {planned} if you trust that package, or give another kind."
        raise InputError(f"{why}, and you did not make the store. {how}")
    return settings


def _of_store(kept: dict[str, Any]) -> ExperimentSettings:
    if not kept:
        why = "the store does not name its experiment, because it was not made by a command"
        raise InputError(f"{why}: name the experiment with --experiment FILE.toml.")
    try:
        return ExperimentSettings.model_validate(kept)
    except ValidationError as error:
        raise InputError(sentence_of("the store's settings: ", error)) from error


def trusted_settings(store: Store, *, experiment: str | None = None, trust: bool = False) -> ExperimentSettings:
    """Return the settings from which a store's experiment may be built."""
    kept = store.settings()
    if experiment is not None and trust:
        raise InputError("--trust and --experiment cannot be given together.")
    if experiment is not None:
        named, same = read_settings(experiment, {}), dict[str, Any]()
        with suppress(InputError):
            stored = _of_store(kept)
            same["seed"] = stored.seed
            if not code_named({"search": kept.get("search", {})}):
                same["search"] = stored.search
        return named.model_copy(update=same)
    settings, code = _of_store(kept), code_named(kept)
    folder = settings.folder or Path().resolve()
    outside = [] if store.path is None else _files_outside(kept, folder, store.path.resolve().parent)
    if not (code or outside) or (settings.folder is not None and is_allowed(kept)):
        return settings
    if trust:
        return settings.model_copy(update={"folder": folder})
    unknown = "You did not make the store on this computer, or it was changed since"
    known = "If you know its experiment, name it with --experiment FILE.toml (or module:attr). If you trust the"
    if not code:
        files = f"files outside its folder: {'; '.join(outside[:8])}"
        raise InputError(f"{store.path} names {files}. {unknown}. {known} store, give --trust.")
    more = f" and {len(code) - 8} more" if len(code) > 8 else ""
    what = f"{'; '.join(code[:8])}{more}, from the folder {ascii(str(folder))[:200]}"
    then = "The question will then not be asked again."
    known = f"{unknown}, or an older version made it. {known} code that the store names, give --trust"
    raise InputError(f"{store.path} would import or run code: {what}. {known}. {then}")


_PARTS = (declaration_of(registry.find(name)) for registry in REGISTRIES.values() for name in registry.built_in)

_FILE_KEYS = {"refined", "data", "logs"}.union(*(declared.files for declared in _PARTS if declared))
"""The keys of settings whose texts are paths."""


def _files_outside(kept: dict[str, Any], folder: Path, home: Path) -> list[str]:
    """Return the files that settings name outside a folder, each as a text to show."""
    parts = {key: value for key, value in kept.items() if key in (*REGISTRIES, "refined")}
    in_xml = re.compile(r"""(?:file|dir)\s*=\s*["']([^"']+)""")
    named = [name for text in _texts(parts, False) for name in (in_xml.findall(text) if "<" in text else [text])]
    return [ascii(name)[:200] for name in named if "\0" in name or not (folder / name).resolve().is_relative_to(home)]


def _texts(value: Any, path: bool) -> Iterator[str]:
    """Yield the texts in settings that are paths, or a MuJoCo model as its text."""
    match value:
        case {}:
            for key, item in value.items():
                yield from _texts(item, path or key in _FILE_KEYS)
        case [*items]:
            for item in items:
                yield from _texts(item, path)
        case str() if path:
            yield value


# Campaigns


@dataclass(frozen=True, eq=False)
class Opened:
    """A store, with its settings, its experiment and its campaign."""

    settings: ExperimentSettings
    experiment: Experiment
    campaign: Campaign
    path: Path


@dataclass(frozen=True)
class Limits:
    """The threshold of a verdict, and the budget of executions; those of the settings or the experiment if None."""

    threshold: float | None = None
    budget: int | None = None

    def completed_by(self, settings: ExperimentSettings, experiment: Experiment) -> tuple[float | None, int]:
        """Return the threshold, which no one need have stated, and the budget."""
        sources: tuple[Any, ...] = self, settings, experiment
        threshold = next((each.threshold for each in sources if each.threshold is not None), None)
        budget = next(each.budget for each in sources if each.budget is not None)
        return require("threshold", PositiveFloat | None, threshold), require("budget", PositiveInt, budget)


def open_store(path: Path, allowed: Allowed, *, remeasure: bool = False) -> Opened:
    store = Store.existing(path)
    settings = trusted_settings(store, experiment=allowed.experiment, trust=allowed.trust)
    asked = (allowed.trust or allowed.experiment is not None) and not is_allowed(store.settings())
    try:
        experiment = settings.load()
    except InputError as error:
        if settings.folder is None or settings.folder.is_dir():
            raise
        gone = f"The store names the folder {str(settings.folder)!a}, which does not exist any more"
        how = "name the experiment at its present place with --experiment FILE.toml or module:attr"
        raise InputError(f"{error} {gone}: {how}.") from error
    campaign = settings.campaign(experiment, store, accept_change=allowed.accept_change, remeasure=remeasure)
    if asked and code_named(store.settings()):
        does = "is now allowed to run its code, and the question will not be asked again"
        if (reason := allow(store.settings())) is not None:
            does = f"is allowed to run its code only now, and the question will be asked again: {reason}"
        err.say(f"{path} {does}.")
    return Opened(settings, experiment, campaign, path)


def open_target(target: str, overrides: dict[str, Any], allowed: Allowed) -> Opened:
    """Open the store that an argument names, or the campaign of an experiment with options of the command line."""
    path = Path(target)
    if path.suffix in STORE_SUFFIXES or (path.suffix not in (".toml", ".py") and path.is_file()):
        if any(value is not None for value in overrides.values()):
            *first, last = (f"--{name.removesuffix('s')}" for name in overrides)
            flags = f"{', '.join(first)} and {last}"
            raise InputError(f"{target} is a store and keeps its own settings: remove {flags}.")
        return open_store(path, allowed)
    if path.suffix and ":" not in target and path.suffix != ".toml":
        raise InputError(not_an_experiment(target, f"a store ({', '.join(STORE_SUFFIXES)})"))
    if allowed.experiment is not None or allowed.trust:
        raise InputError(f"--experiment and --trust need a store as the first argument, and {target} is an experiment.")
    settings = read_settings(target, overrides)
    experiment = settings.load()
    path = settings.store_path(experiment.name)
    return Opened(settings, experiment, settings.campaign(experiment, path, accept_change=allowed.accept_change), path)
