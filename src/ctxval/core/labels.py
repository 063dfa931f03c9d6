"""Names and units of states, inputs and the distance, for files, pictures and reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ctxval._util.representation import record
from ctxval._util.texts import parted


@dataclass(frozen=True)
class Labels:
    """Names and units, which change nothing that is computed.

    Attributes:
        states, inputs: one label ``name [unit]`` for each state and each input; empty if they have no names.
        units: the units of the distance.
    """

    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    units: str = ""

    def names(self, system: object, states: int, inputs: int) -> tuple[dict[str, str], dict[str, str]]:
        """Return the names of n states and m inputs with their units.

        They are these labels, else the names that the system itself has, else ``x0, x1, ...`` and ``u0, u1, ...``.

        Args:
            system: the system, whose attributes ``states`` and ``inputs`` may be names, or names with units.
            states, inputs: the numbers of states and of inputs.
        """
        return (
            _named(self.states, getattr(system, "states", None), "x", states),
            _named(self.inputs, getattr(system, "inputs", None), "u", inputs),
        )

    def __repr__(self) -> str:
        return record(self)


def labels_of(named: Mapping[str, str]) -> tuple[str, ...]:
    """Return ``name [unit]`` for each name, or the name alone if it has no unit."""
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in named.items())


def _named(labels: tuple[str, ...], own: object, letter: str, count: int) -> dict[str, str]:
    if len(labels) == count and len({parted(label)[0] for label in labels}) == count:
        return dict(parted(label) for label in labels)
    if isinstance(own, Mapping) and len(own) == count:
        return {str(name): str(unit) for name, unit in own.items()}
    if isinstance(own, list | tuple) and len(set(map(str, own))) == count:
        return {str(name): "" for name in own}
    return {f"{letter}{i}": "" for i in range(count)}
