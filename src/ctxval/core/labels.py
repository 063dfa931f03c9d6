"""Names and units of states, inputs and the distance, for files, pictures and reports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ctxval._util.checked import checked
from ctxval._util.columns import conversion
from ctxval._util.refusals import reworded
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import parted, shortened
from ctxval.errors import InputError


@checked
@dataclass(frozen=True)
class Labels(ShortRepr):
    """Names and units, which change nothing that is computed."""

    #: one label ``name [unit]`` for each state and each input; empty if they have no names
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    units: str = ""  #: the units of the distance

    def __post_init__(self) -> None:
        require_names(self.states, self.inputs)

    def names(self, system: object, states: int, inputs: int) -> tuple[dict[str, str], dict[str, str]]:
        """Return the names of n states and m inputs with units: these labels, the system's, or ``x0, ..., u0, ...``."""
        named = list[dict[str, str]]()
        for labels, kind, letter, count in ((self.states, "states", "x", states), (self.inputs, "inputs", "u", inputs)):
            known = (dict(map(parted, labels)), names_of(system, kind))
            usual = {f"{letter}{i}": "" for i in range(count)}
            named.append(next((names for names in known if len(names) == count), usual))
        return named[0], named[1]


def require_names(states: Iterable[str], inputs: Iterable[str]) -> None:
    """Refuse labels of states and inputs that make a recording unreadable."""
    labels = [*states, *inputs]
    names = [parted(label)[0] for label in labels]
    for label, name in zip(labels, names, strict=True):
        plain = bool(name) and label == label.strip() and label.isprintable()
        if not plain or name in TIMES or names.count(name) > 1:
            wanted = "a name of its own, not t or time, without blanks around it or control characters"
            reason = f"because recordings have columns of these names; got {shortened(repr(label), 60)}"
            raise InputError(f"each state and input needs {wanted}, {reason}.")


TIMES = ("t", "time")  #: names of the column of times in a recording


def labels_of(named: Mapping[str, str]) -> tuple[str, ...]:
    """Return ``name [unit]`` for each name, or the name alone if it has no unit."""
    return tuple(f"{name} [{unit}]" if unit else name for name, unit in named.items())


def names_of(system: object, kind: str) -> dict[str, str]:
    """Return the names and units of the ``"states"`` or ``"inputs"`` of a system; empty if it names none."""
    names = getattr(system, kind, None)
    if isinstance(names, Mapping):
        return {str(name): str(unit) for name, unit in names.items()}
    return dict.fromkeys(map(str, names), "") if isinstance(names, list | tuple) else {}


def units_of(model: object) -> tuple[dict[str, str], dict[str, str]]:
    """Return the names of the states and inputs of a model with their units, or those of the data it was learned from.

    They are empty if they are not known.
    """
    data = getattr(model, "data", None)
    states, inputs = (names_of(model, kind) or names_of(data, kind) for kind in ("states", "inputs"))
    return states, inputs


def factors_between(first: Mapping[str, str], second: Mapping[str, str]) -> list[float]:
    """Return the factor from the unit of each first one to that of the second one in its place, 1 if one is unknown.

    Raises:
        InputError: if two units have no known factor, such as m and rad.
    """
    factors = list[float]()
    for (name, recorded), wanted in zip(first.items(), second.values(), strict=True):
        with reworded(name, InputError):
            factors.append(conversion(recorded, wanted) if recorded and wanted else 1.0)
    return factors


def require_same_units(what: str, units: Mapping[str, str], whose: str, others: Mapping[str, str]) -> None:
    """Refuse names with units of which one differs from the unit in its place of others."""
    if len(units) != len(others):  # those of the one or the other are not known
        return
    for (name, unit), other, factor in zip(units.items(), others.values(), factors_between(units, others), strict=True):
        if factor != 1:
            raise InputError(f"{what} have {name} in {unit}, and {whose} in {other}: use one unit.")
