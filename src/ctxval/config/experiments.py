"""Experiments that are not described in a file: cases by name, and ``module:attr`` references."""

from __future__ import annotations

from inspect import Parameter, signature
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ctxval import cases
from ctxval._util.texts import reason_of
from ctxval.config.parts import require_types
from ctxval.config.references import accepts, is_function, reference
from ctxval.core.experiment import Experiment
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, InputError


def named_experiment(text: str, seed: int, options: dict[str, Any], folder: Path | None = None) -> Experiment:
    """Return the experiment that the name of a case or a reference gives; a reference runs the code of its module."""
    if ":" in text:
        return _from_reference(text, seed, options, folder)
    if options:
        options = require_types(f"case {text!r}", cases.REGISTRY.find(text), options)
    return cases.by_name(text, seed, **options)


def plain_options(case: str) -> dict[str, Any]:
    """Return the options of a case that a file or a command line can set, with their defaults.

    The default of an option that must be given is None.
    """
    try:
        hints = get_type_hints(cases.REGISTRY.find(case))
    except InputError:
        raise
    except Exception:  # annotations that are texts are evaluated, and anything may stand in them
        hints = {}
    found = {name: default for name, default in cases.options_of(case).items() if _is_plain(hints.get(name, str))}
    return {name: None if default is Parameter.empty else default for name, default in found.items()}


def _is_plain(hint: Any) -> bool:
    """Return whether an annotation allows a number, a Boolean or a text."""
    return get_origin(hint) is Literal or bool({hint, *get_args(hint)} & {str, int, float, bool})


def _from_reference(text: str, seed: int, options: dict[str, Any], folder: Path | None) -> Experiment:
    """Return the experiment that ``module:attr`` names or makes; this runs the code of the module."""
    found = reference(text, folder)
    if is_function(found) and not isinstance(found, Validation | Experiment):
        found = _called(text, found, seed, options)
    if isinstance(found, Validation):
        return Experiment(text.partition(":")[2], found)
    if not isinstance(found, Experiment):
        raise InputError(
            f"{text} must be an Experiment or a Validation, or a function of a seed that makes one, "
            f"got {type(found).__name__}."
        )
    return found


def _called(text: str, make: Any, seed: int, options: dict[str, Any]) -> Any:
    if not accepts(make, 1, **options):
        given = f" {', '.join(options)}" if options else ""
        raise InputError(f"{text} must be callable with a seed and its options{given}; it takes {signature(make)}.")
    try:
        return make(seed, **options)
    except CtxvalError:
        raise
    except Exception as error:
        raise InputError(f"{text} failed: {reason_of(error)}.") from error
