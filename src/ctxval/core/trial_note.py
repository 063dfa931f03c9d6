"""What is recorded of a trial beside its task and its result, as typed fields."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self

from ctxval._util.representation import ShortRepr


class LoopTimes(NamedTuple):
    """Seconds after which something happened in the closed loops of M and S; None where it did not."""

    model: float | None
    system: float | None


@dataclass(frozen=True)
class TrialNote(ShortRepr):
    """What is recorded of a trial beside its task and its result.

    Its JSON is one table: what the search attached, and the other fields that are known.
    """

    #: what the search attached when it chose the task, as JSON; it gets this back when a campaign resumes
    search: dict[str, Any] | None = None
    draws: int | None = None  #: the planned number of independent draws, of one of them; 0 if results decide the number
    #: the number of the hypercube that begins with this test, and the share of all hypercubes that are like it
    hypercube: tuple[int, float] | None = None
    #: a threshold, K / N and the bet, of a task that was drawn where distances above the threshold are expected
    predicted_above: tuple[float, float, float] | None = None
    prediction: dict[str, Any] | None = None  #: the prediction of the execution, as JSON, and of which distance
    thinking: dict[str, Any] | None = None  #: the speed of the machine, and what the choice of the task took
    sensitivity: dict[str, Any] | None = None  #: how far small changes move closed loops of M; in the first trial
    comparison: dict[str, Any] | None = None  #: what a comparison of candidates stores
    converged: bool | None = None  #: whether the design of the controller converged, if the controller tells
    unsteady: int | None = None  #: the number of tasks that were not executed because their controllers jump
    at_least: float | None = None  #: the distance that the steps before a failure have already
    #: when closed loops ended early, by a fall or an instability; if S alone did, M was wrong by more than any distance
    ends: LoopTimes | None = None
    falls: LoopTimes | None = None  #: when robots fell

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Return the note of a table; what cannot be the value of a field is left out."""
        search = {name: value for name, value in values.items() if name not in RESERVED}
        own = {name: _field(name, value) for name, value in values.items() if name in RESERVED}
        return cls(search=search or None, **own)

    def to_json(self) -> dict[str, Any]:
        """Return the table of JSON; empty if nothing is recorded."""
        known = {name: value for name in RESERVED if (value := getattr(self, name)) is not None}
        loops = {name: value._asdict() for name, value in known.items() if isinstance(value, LoopTimes)}
        return {**(self.search or {}), **known, **loops}


NO_NOTE = TrialNote()
"""The note of a trial of which nothing more is recorded."""

RESERVED = tuple(field.name for field in fields(TrialNote) if field.name != "search")
"""Names that what a search attaches must not have."""


def _field(name: str, value: Any) -> Any:
    """Return the value of a field from JSON; None if it cannot be one."""
    match name, value:
        case "converged", bool():
            return value
        case (("draws" | "unsteady"), int()):
            return value
        case "at_least", _:
            return _number(value)
        case "hypercube", [int(number), float(share)] if number >= 0 and 0 < share <= 1:
            return number, share
        case "predicted_above", [float(threshold), float(part), float(bet)] if 0 < part <= 1 and 0 <= bet < 1:
            return threshold, part, bet
        case (("ends" | "falls"), dict()):
            return LoopTimes(*(_number(value.get(whose)) for whose in LoopTimes._fields))
        case (("prediction" | "thinking" | "sensitivity" | "comparison"), dict()):
            return value
    return None


def _number(value: Any) -> float | None:
    with suppress(OverflowError):
        return float(value) if isinstance(value, int | float) else None
    return None
