"""A validation with a name, a default budget and threshold, and a way to find d* if there is one."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import product

import numpy as np

from ctxval._util.checked import PositiveFloat, PositiveInt, checked
from ctxval._util.columns import differ
from ctxval._util.representation import call
from ctxval._util.texts import parted
from ctxval.core.labels import Labels, names_of, require_same_units, units_of
from ctxval.core.truth import Truth
from ctxval.core.validation import Validation


class UnitsWarning(UserWarning):
    """A distance without weights or scales adds states of different units, or of another unit than its own."""


@checked
@dataclass(frozen=True, eq=False)
class Experiment:
    """A validation with its defaults, as ``ctxval run`` runs it; it gets the names and units as its labels.

    A UnitsWarning says that the distance, without weights and scales, adds states of different units, or of another
    unit than its own.
    """

    name: str  #: a short name for files and displays
    validation: Validation
    budget: PositiveInt = 25  #: the default number of executions of S
    threshold: PositiveFloat | None = None  #: the default threshold tau; without a threshold there is no verdict
    truth: Callable[[], Truth] | None = None  #: a function that finds d*, for simulated systems
    units: str = ""  #: the units of the distance
    #: names of the states and inputs with their units; by default the labels of the validation
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        given = self.validation.labels
        labels = Labels(self.states or given.states, self.inputs or given.inputs, self.units or given.units)
        for name in ("states", "inputs", "units"):
            object.__setattr__(self, name, getattr(labels, name))
        if labels != given:
            object.__setattr__(self, "validation", self.validation.with_parts(labels=labels))
        for kind, known in zip(("states", "inputs"), units_of(self.validation.model), strict=True):
            require_same_units(
                f"the {kind} of the model", known, "the experiment", dict(map(parted, getattr(self, kind)))
            )
        if (doubt := self.doubt_of_units) is not None:
            warnings.warn(doubt, UnitsWarning, stacklevel=3)

    @property
    def doubt_of_units(self) -> str | None:
        """Why the number that the distance gives is in no unit, or in another one than stated; None if all is well.

        A distance states which units it adds by its method ``added_units(units) -> units``, as the ready-made ones do.
        """
        ask = getattr(self.validation.distance, "added_units", None)
        units = [parted(label)[1] for label in self.states] or [*names_of(self.validation.system, "states").values()]
        added = tuple(ask(units)) if callable(ask) and units else ()
        if len(added) > 1:
            return (
                f"the distance adds states in {' and '.join(added)} without weights or scales, so it depends on the "
                "choice of units: give scales=[...], the size of an error of each state that counts as 1, or "
                "weights=[1, ...] if the plain sum is meant."
            )
        if added and self.units and added[0] != self.units:
            return (
                f"the distance is in {added[0]}, as its states are, and not in {self.units}: no unit is converted, so "
                f"state units={added[0]!r} and a threshold in {added[0]}, or give scales."
            )
        return None

    @property
    def doubt_of_parameters(self) -> str | None:
        """Why a task parameter is taken as a state without a conversion of its unit; None if all is well.

        Their numbers are compared in four random tasks, so a task function that converts the unit gives no doubt.
        """
        space = self.validation.space
        if not any(parted(label)[1] for label in space.labels):
            return None
        with suppress(Exception):  # parts that do not fit together are refused where they are used
            points = space.iid(4, np.random.default_rng(0))
            tasks = [self.validation.task(space.parameters(point)) for point in points]
            states = list(self.names(tasks[0].initial_state.shape[-1], 0)[0].items())
            taken = {"initial": [task.initial_state for task in tasks], "goal": [task.goal for task in tasks]}
            for (what, values), (column, label) in product(taken.items(), enumerate(space.labels)):
                parameter, unit = parted(label)
                equal = np.abs(np.stack(values)) == np.abs(points[:, column, None])
                for row in np.flatnonzero(equal.all(axis=0) & (np.ptp(points[:, column]) > 0)):
                    state, wanted = states[row]
                    if unit and wanted and differ(unit, wanted):
                        return (
                            f"the task function takes the parameter {parameter} in {unit} as the {what} {state} in "
                            f"{wanted}, and does not convert it: convert it there, or state its range in {wanted}."
                        )
        return None

    def names(self, states: int, inputs: int) -> tuple[dict[str, str], dict[str, str]]:
        """Return the names of n states and m inputs with their units (:meth:`Labels.names`)."""
        return self.validation.names(states, inputs)

    def __repr__(self) -> str:
        known = {"budget": self.budget, "threshold": self.threshold, "units": self.units or None}
        return call(self, self.name, self.validation, **known)
