"""A validation with a name, a default budget and threshold, and a way to find d* if there is one."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

from ctxval._util.checked import PositiveFloat, PositiveInt, checked
from ctxval._util.representation import call, lines
from ctxval._util.texts import parted
from ctxval.core.labels import Labels, names_of
from ctxval.core.truth import Truth
from ctxval.core.validation import Validation


class UnitsWarning(UserWarning):
    """A distance adds states of different units without weights or scales."""


@checked
@dataclass(frozen=True, eq=False)
class Experiment:
    """A validation with its defaults, as ``ctxval run`` runs it; it gets the names and units as its labels.

    A UnitsWarning says that the distance adds states of different units, and has neither weights nor scales.
    """

    name: str  #: a short name for files and displays
    validation: Validation
    budget: PositiveInt = 25  #: the default number of executions of S
    threshold: PositiveFloat | None = None  #: the default threshold tau; without a threshold there is no verdict
    truth: Callable[[], Truth] | None = None  #: a function that finds d*, for simulated systems
    units: str = ""  #: the units of the distance
    #: states, inputs: names of the states and inputs with their units; by default the labels of the validation
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        given = self.validation.labels
        labels = Labels(self.states or given.states, self.inputs or given.inputs, self.units or given.units)
        for name in ("states", "inputs", "units"):
            object.__setattr__(self, name, getattr(labels, name))
        if labels != given:
            object.__setattr__(self, "validation", self.validation.with_parts(labels=labels))
        if self.mixed_units:
            warnings.warn(mixed_units_sentence(self.mixed_units), UnitsWarning, stacklevel=3)

    @property
    def mixed_units(self) -> tuple[str, ...]:
        """The units that the distance adds although they differ; none if it has weights or scales, or if none is known.

        A distance states them by its method ``mixed_units(units) -> units``, as the ready-made ones do.
        """
        ask = getattr(self.validation.distance, "mixed_units", None)
        units = [parted(label)[1] for label in self.states] or [*names_of(self.validation.system, "states").values()]
        return tuple(ask(units)) if callable(ask) and units else ()

    def names(self, states: int, inputs: int) -> tuple[dict[str, str], dict[str, str]]:
        """Return the names of n states and m inputs with their units (:meth:`Labels.names`)."""
        return self.validation.names(states, inputs)

    def __repr__(self) -> str:
        known = {"threshold": self.threshold, "units": self.units or None, "truth": self.truth}
        head = call(self, self.name, self.validation.space, budget=self.budget, **known)
        return lines(head, *(part.strip() for part in repr(self.validation).splitlines()[1:]))


def mixed_units_sentence(units: tuple[str, ...]) -> str:
    """Return the sentence that a distance adds these units."""
    return (
        f"the distance adds states in {' and '.join(units)} without weights or scales, so it depends on the choice of "
        "units: give scales=[...], the size of an error of each state that counts as 1, or weights=[1, ...] if the "
        "plain sum is meant."
    )
