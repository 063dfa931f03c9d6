"""Open a store with the experiment that it names, if the user made the store or trusts it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval._util.checked import PositiveFloat, PositiveInt, require
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.storage.other_stores import STORE_SUFFIXES
from ctxval.campaign.storage.store import Store
from ctxval.cli.base import err
from ctxval.cli.config.settings import Settings, not_an_experiment, read_settings
from ctxval.cli.config.signatures import code_named, verifies, why_no_key
from ctxval.cli.config.stored_settings import trusted_settings
from ctxval.core.experiment import Experiment
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class Opened:
    """A store, with its settings, its experiment and its campaign."""

    settings: Settings
    experiment: Experiment
    campaign: Campaign
    path: Path


def limit_of(experiment: Experiment, settings: Settings, given: float | None = None) -> float | None:
    """Return the threshold of the verdict: the given one, or else that of the settings, or else of the experiment."""
    known = (value for value in (given, settings.threshold, experiment.threshold) if value is not None)
    return require("threshold", PositiveFloat | None, next(known, None))  # type: ignore[no-any-return]


def budget_of(experiment: Experiment, settings: Settings, given: int | None = None) -> int:
    """Return the budget: the given one, or else that of the settings, or else of the experiment."""
    known = (value for value in (given, settings.budget, experiment.budget) if value is not None)
    return require("budget", PositiveInt, next(known))  # type: ignore[no-any-return]


def open_store(
    store: Store,
    path: Path,
    experiment: str | None,
    trust: bool,
    accept_change: str | None = None,
    *,
    remeasure: bool = False,
) -> Opened:
    """Build the experiment of a store, and its campaign."""
    settings = trusted_settings(store, experiment=experiment, trust=trust)
    asked = (trust or experiment is not None) and not verifies(store.settings())
    try:
        loaded = settings.load()
    except InputError as error:
        if settings.folder is None or settings.folder.is_dir():
            raise
        raise InputError(
            f"{error} The store names the folder {str(settings.folder)!a}, which does not exist any more: name the "
            "experiment at its present place with --experiment FILE.toml or module:attr."
        ) from error
    campaign = settings.campaign(loaded, store, accept_change=accept_change, remeasure=remeasure)
    if asked and code_named(store.settings()):
        reason = why_no_key()
        does = "now carries your signature, and the question will not be asked again"
        if reason is not None:
            does = f"cannot carry your signature, and the question will be asked again: {reason}"
        err.say(f"{path} {does}.")
    return Opened(settings, loaded, campaign, path)


def open_target(
    target: str, overrides: dict[str, Any], experiment: str | None, trust: bool, accept_change: str | None = None
) -> Opened:
    """Open the store that an argument names, or the campaign of an experiment with options of the command line."""
    path = Path(target)
    if path.suffix in STORE_SUFFIXES or (path.suffix not in (".toml", ".py") and path.is_file()):
        if any(value is not None for value in overrides.values()):
            *first, last = (f"--{name}" for name in overrides)
            flags = f"{', '.join(first)} and {last}"
            raise InputError(f"{target} is a store and keeps its own settings: remove {flags}.")
        return open_store(Store.existing(path), path, experiment, trust, accept_change)
    if path.suffix and ":" not in target and path.suffix != ".toml":
        raise InputError(not_an_experiment(target, f"a store ({', '.join(STORE_SUFFIXES)})"))
    if experiment is not None or trust:
        raise InputError(f"--experiment and --trust need a store as the first argument, and {target} is an experiment.")
    options = overrides.get("option")
    settings = read_settings(target, {**overrides, "options": options, "option": None})
    loaded = settings.load()
    path = settings.store_path(loaded.name)
    return Opened(settings, loaded, settings.campaign(loaded, path, accept_change=accept_change), path)
