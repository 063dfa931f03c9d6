"""A validation with a name, the budget that suits it, and its truth if that can be known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ctxval.truth import Truth
from ctxval.validation import Validation


@dataclass(frozen=True, eq=False)
class Experiment:
    """What ``ctxval run`` runs.

    Attributes:
        name: a short name, for files and displays.
        validation: the map p -> d(p).
        budget: executions of S, unless said otherwise.
        threshold: tau, unless said otherwise; no verdict without one.
        truth: finds d*, for simulated systems.
        units: the distance's units.
        states, inputs: names of the states and inputs with their units, for pictures.
    """

    name: str
    validation: Validation
    budget: int = 25
    threshold: float | None = None
    truth: Callable[[], Truth] | None = None
    units: str = ""
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
