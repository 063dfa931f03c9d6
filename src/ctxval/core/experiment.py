"""A validation with a name, a default budget and threshold, and a way to find d* if there is one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ctxval._util.representation import call, lines
from ctxval.core.truth import Truth
from ctxval.core.validation import Validation


@dataclass(frozen=True, eq=False)
class Experiment:
    """A validation with its defaults, as ``ctxval run`` runs it.

    Attributes:
        name: a short name for files and displays.
        validation: the map p -> d(p).
        budget: the default number of executions of S.
        threshold: the default threshold tau; without a threshold there is no verdict.
        truth: a function that finds d*, for simulated systems; None if there is none.
        units: the units of the distance.
        states, inputs: names of the states and inputs with their units, for files and pictures.
    """

    name: str
    validation: Validation
    budget: int = 25
    threshold: float | None = None
    truth: Callable[[], Truth] | None = None
    units: str = ""
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()

    def names(self, states: int, inputs: int) -> tuple[dict[str, str], dict[str, str]]:
        """Return the names of n states and m inputs with their units, for files.

        They are the names of the experiment, else those of its system, else ``x0, x1, ...`` and ``u0, u1, ...``.
        """
        system = self.validation.system
        return (
            _named(self.states, getattr(system, "states", None), "x", states),
            _named(self.inputs, getattr(system, "inputs", None), "u", inputs),
        )

    def __repr__(self) -> str:
        known = {"threshold": self.threshold, "units": self.units or None, "truth": self.truth}
        head = call(self, self.name, self.validation.space, budget=self.budget, **known)
        return lines(head, *(part.strip() for part in repr(self.validation).splitlines()[1:]))


def _named(labels: tuple[str, ...], own: object, letter: str, count: int) -> dict[str, str]:
    if len(labels) == count and len({_parted(label)[0] for label in labels}) == count:
        return dict(_parted(label) for label in labels)
    if isinstance(own, Mapping) and len(own) == count:
        return {str(name): str(unit) for name, unit in own.items()}
    if isinstance(own, list | tuple) and len(set(map(str, own))) == count:
        return {str(name): "" for name in own}
    return {f"{letter}{i}": "" for i in range(count)}


def labels_of(named: Mapping[str, str]) -> tuple[str, ...]:
    """Return ``name [unit]`` for each name, or the name alone if it has no unit."""
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in named.items())


def _parted(label: str) -> tuple[str, str]:
    """Return the name and the unit of ``name [unit]``."""
    name, _, unit = label.partition("[")
    return name.strip(), unit.strip().removesuffix("]")
