"""The settings in a store, those that may be used, since this user allows them, and the campaign."""

from __future__ import annotations

import reprlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ctxval import Campaign, Experiment, Store, searches
from ctxval._util.checked import PositiveFloat, PositiveInt, require
from ctxval.campaign.storage.other_stores import STORE_SUFFIXES
from ctxval.certificates import KINDS
from ctxval.cli.base import Allowed, err
from ctxval.cli.config.parts import REGISTRIES
from ctxval.cli.config.settings import ExperimentSettings, not_an_experiment, read_settings, sentence_of
from ctxval.cli.config.trust import allow, is_allowed
from ctxval.errors import InputError


def planned_settings(store: Store, kind: str | None = None) -> ExperimentSettings:
    """Return the settings in a store, whoever wrote them, from which nothing may be built; the defaults if none."""
    kept = store.settings()
    if not kept:
        return ExperimentSettings()
    settings = _of_store(kept)
    planned = settings.certificate.kind
    if kind is None and planned not in KINDS.built_in and not is_allowed(kept):
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
            plain = not any(isinstance(value, dict) for value in (stored.search.model_extra or {}).values())
            if plain and stored.search.type in searches.REGISTRY.built_in:  # which names no code
                same["search"] = stored.search
        return named.model_copy(update=same)
    settings = _of_store(kept)
    folder = settings.folder or Path().resolve()
    if is_allowed(kept) and settings.folder is not None:
        return settings
    if trust:
        return settings.model_copy(update={"folder": folder})
    keys = ("experiment", "options", "task", *REGISTRIES, "distribution", "search", "certificate", "spec", "outputs")
    stated = [f"{key} = {_SHOWN.repr(kept[key])}" for key in (*keys, "recordings", "refined") if kept.get(key)]
    where = f"{store.path} would build its experiment, which may import modules and run programs"
    unknown = "You did not make the store on this computer, or it was changed since"
    known = "If you know its experiment, name it with --experiment FILE.toml (or module:attr)"
    then = "If you trust what the store names, give --trust; the question will then not be asked again"
    what = f"{'; '.join(stated)}, from the folder {_SHOWN.repr(str(folder))}"
    raise InputError(f"{where}: {what}. {unknown}. {known}. {then}.")


# Settings of anybody as text: shortened, and with control characters escaped.
_SHOWN = reprlib.Repr()
_SHOWN.maxstring = _SHOWN.maxother = 160
_SHOWN.maxdict = 8


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
    if asked:
        does = "is now allowed, and the question will not be asked again"
        if (reason := allow(store.settings())) is not None:
            does = f"is allowed only now, and the question will be asked again: {reason}"
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
