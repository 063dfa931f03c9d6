"""A trial: one p with everything known of it; and what was changed in the trials of a store."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ctxval._util.arrays import Array
from ctxval._util.representation import call, line, lines, record, table
from ctxval.core.space import Point

Origin = Literal["iid", "initial", "acquisition", "covering", "manual"]
"""Why a trial was chosen. Only iid trials enter a scenario bound."""

State = Literal["open", "completed", "failed", "unmeasured"]
"""Unmeasured: S was executed and its trajectory is stored, but the distance gave nothing usable."""


TOLD_ALONE = "its distance was told without a trajectory, and the distance has changed since: execute the task again."
"""Why a trial is unmeasured that can never be measured."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One p with everything known of it.

    Attributes:
        number: from 0, in the order of asking.
        origin: why it was chosen: iid, initial, acquisition, covering (nothing had come near to it, or the bound
            was put to the test there) or manual.
        state: open, completed, failed, or unmeasured.
        unit_point: p in the unit cube, shape ``(d,)``.
        parameters: p by name.
        attempts: how often its execution was started.
        executed: whether an execution of S ended, well or badly; this is what the budget counts.
        distance: d(p), if completed.
        failure: why it failed, or why its distance could not be measured.
        seconds: how long the execution took.
        note: what the search thought when it chose the point, plain enough for JSON; it is reminded of it on resuming.
        because: what was changed on the system after an earlier trial of the same task had ended otherwise.
    """

    number: int
    origin: Origin
    state: State
    unit_point: Array
    parameters: dict[str, Point]
    attempts: int = 0
    executed: bool = False
    distance: float | None = None
    failure: str | None = None
    seconds: float | None = None
    note: dict[str, Any] | None = None
    because: str | None = None

    def __repr__(self) -> str:
        ended = {"distance": self.distance, "seconds": self.seconds, "attempts": self.attempts}
        head = call(self, self.number, origin=self.origin, state=self.state, **ended, parameters=self.parameters)
        texts = {"failure": self.failure, "because": self.because}
        return lines(head, *(f"{name}: {line(text)}" for name, text in texts.items() if text is not None))

    def _repr_html_(self) -> str:
        return table(
            f"Trial {self.number}",
            [
                ("origin", self.origin),
                ("state", self.state),
                ("distance", self.distance),
                ("failure", self.failure),
                ("seconds", self.seconds),
                ("attempts", self.attempts),
                ("because", self.because),
                *self.parameters.items(),
            ],
        )


@dataclass(frozen=True)
class Change:
    """What was changed in a store after it was written.

    Attributes:
        what: the kind of change.
        why: the reason that was given.
        content: what it was before, or what differs, plain enough for JSON.
        at: when, in UTC; empty until it is stored.
    """

    what: str
    why: str
    content: dict[str, Any]
    at: str = ""

    def __repr__(self) -> str:
        return record(self)
