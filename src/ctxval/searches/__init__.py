"""Searches: ask and tell over the unit cube."""

from __future__ import annotations

from typing import Any

from ctxval.errors import InputError, UnknownNameError
from ctxval.searches.annealing import Annealing
from ctxval.searches.auto import Auto
from ctxval.searches.base import Note, Prediction, Search, SequentialSearch
from ctxval.searches.bayesian_optimisation import Scalar
from ctxval.searches.cma_es import CMAES
from ctxval.searches.gp_ucb import GPUCB
from ctxval.searches.random import Random, SamplingDiscarding
from ctxval.searches.repeated import Repeated
from ctxval.searches.trust_region import Climbs

__all__ = [
    "CMAES",
    "GPUCB",
    "NAMES",
    "Annealing",
    "Auto",
    "Climbs",
    "Note",
    "Prediction",
    "Random",
    "Repeated",
    "SamplingDiscarding",
    "Scalar",
    "Search",
    "SequentialSearch",
    "by_name",
]

NAMES: dict[str, type[Any]] = {
    "annealing": Annealing,
    "auto": Auto,
    "climbs": Climbs,
    "cma-es": CMAES,
    "gp-ucb": GPUCB,
    "random": Random,
    "sampling-discarding": SamplingDiscarding,
    "scalar": Scalar,
}
"""The searches that the command line and experiment files know."""


def by_name(name: str, *, repeats: int = 1, **options: Any) -> Search:
    """Return a new search from its name and its options.

    Args:
        name: of ``NAMES``.
        repeats: how often each point is evaluated, of a noisy function.
        options: of the search.

    Raises:
        UnknownNameError: there is no such search; the message has the nearest name.
        InputError: it does not take these options.
    """
    if name not in NAMES:
        raise UnknownNameError.among("search", name, NAMES)
    try:
        search: Search = NAMES[name](**options)
    except TypeError as error:
        raise InputError(f"search {name!r}: {error}.") from error
    return search if repeats == 1 else Repeated(search, repeats)
