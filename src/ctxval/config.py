"""Experiments by name: cases, experiment files and ``module:attr`` references."""

from __future__ import annotations

import importlib
import os
import sys
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ctxval import cases
from ctxval.errors import CtxvalError, InputError
from ctxval.experiment import Experiment
from ctxval.searches import Search, by_name
from ctxval.store import Store
from ctxval.validation import Validation
from ctxval.verdict import CONFIDENCE

DEFAULT_SEARCH = "gp-ucb"


class SearchTable(BaseModel):
    """The table ``[search]``: a name, and the options of that search."""

    model_config = ConfigDict(extra="allow")

    name: str = DEFAULT_SEARCH

    def build(self) -> Search:
        """Return the search.

        Raises:
            UnknownNameError: there is no such search.
            InputError: it does not take these options.
        """
        return by_name(self.name, **(self.model_extra or {}))


class Settings(BaseModel):
    """What to run: the content of an experiment file, with the command line's options over it.

    Attributes:
        experiment: a case, or ``module:attr`` of an experiment or of a function of a seed that makes one.
        options: passed on to the case or function.
        budget, threshold, seed, store: None where the experiment decides.
        confidence: of a validation.
        search: which search, and its options.
    """

    model_config = ConfigDict(extra="forbid")

    experiment: str
    options: dict[str, Any] = Field(default_factory=dict)
    budget: int | None = Field(default=None, ge=1)
    threshold: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    confidence: float = Field(default=CONFIDENCE, gt=0, lt=1)
    seed: int = Field(default=0, ge=0)
    store: Path | None = None
    search: SearchTable = Field(default_factory=SearchTable)

    def load(self) -> Experiment:
        """Return the experiment.

        Raises:
            InputError: it cannot be found or made.
        """
        if "seed" in self.options:
            raise InputError("the seed stands beside [options], not in it.")
        if ":" in self.experiment:
            return _from_reference(self.experiment, self.seed, self.options)
        return cases.by_name(self.experiment, self.seed, **self.options)

    def store_path(self, name: str) -> Path:
        """Return where the trials go: the given store, or a file under ``runs/`` named after what is run."""
        if self.store is not None:
            return self.store
        options = [f"{key}-{value}" for key, value in self.options.items()]
        return Path("runs") / f"{'-'.join([name, *options, self.search.name])}-seed{self.seed}.sqlite"


def read_settings(target: str, overrides: dict[str, Any]) -> Settings:
    """Return what to run, from a case's name, an experiment file or ``module:attr``.

    Args:
        target: ``pendulum``, ``experiment.toml`` or ``my_module:my_experiment``.
        overrides: options of the command line, over what the file says; None where not given.

    Raises:
        InputError: the file cannot be read, or a value in it is not allowed; the message names it.
    """
    content = _read_toml(Path(target)) if target.endswith(".toml") else {"experiment": target}
    given = {key: value for key, value in overrides.items() if value is not None}
    options = {**_table(content, "options"), **given.pop("options", {})}
    search = _table(content, "search")
    named = given.pop("search", None)
    if named is not None and named != search.get("name", DEFAULT_SEARCH):
        search = {"name": named}  # the options in the file were those of another search
    try:
        return Settings.model_validate({**content, **given, "options": options, "search": search})
    except ValidationError as error:
        raise InputError(_sentence(target, error)) from error


def stored_settings(store: Store) -> Settings:
    """Return what was run into a store.

    Raises:
        InputError: the store does not say it, or what it says is not allowed.
    """
    kept = store.settings()
    if not kept:
        raise InputError("the store does not say what was run into it; only one made by `ctxval run` can be audited.")
    try:
        return Settings.model_validate(kept)
    except ValidationError as error:
        raise InputError(_sentence("the store's settings", error)) from error


def _table(content: dict[str, Any], key: str) -> dict[str, Any]:
    table = content.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"[{key}] must be a table, got {table!r}.")
    return table


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise InputError(f"the experiment file {path} cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}.") from error


def _sentence(target: str, error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"{target}: {where}: {first['msg'].lower()}, got {first['input']!r}."


def _from_reference(reference: str, seed: int, options: dict[str, Any]) -> Experiment:
    """Import ``module:attr``; this runs the module's code."""
    module_name, _, attribute = reference.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        found = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"{reference} cannot be loaded: {error}.") from error
    except CtxvalError:
        raise
    except Exception as error:
        raise InputError(f"{module_name} failed while it was loaded: {type(error).__name__}: {error}.") from error
    if callable(found) and not isinstance(found, Validation | Experiment):
        try:
            found = found(seed, **options)
        except TypeError as error:
            raise InputError(f"{reference} must be callable with a seed and its options: {error}.") from error
        except CtxvalError:
            raise
        except Exception as error:
            raise InputError(f"{reference} failed: {type(error).__name__}: {error}.") from error
    if isinstance(found, Validation):
        return Experiment(attribute, found)
    if not isinstance(found, Experiment):
        raise InputError(f"{reference} must be an Experiment or a Validation, got {type(found).__name__}.")
    return found
