"""The task that is chosen for a new trial, and the trial that is opened for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ctxval._util.arrays import Array
from ctxval._util.representation import call, fields_of, lines, shown
from ctxval.core.plan import Plan
from ctxval.core.trial import Origin, Trial


@dataclass(frozen=True, eq=False)
class OpenTrial:
    """A trial to be executed, with everything that an operator needs for the execution.

    Attributes:
        trial: the stored trial.
        plan: its task, its controller and the trajectory of the model.
    """

    trial: Trial
    plan: Plan

    @property
    def number(self) -> int:
        """The number of the trial."""
        return self.trial.number

    def __repr__(self) -> str:
        parts = (f"{name}: {shown(part)}" for name, part in fields_of(self.plan).items())
        return lines(call(self, self.number, origin=self.trial.origin), *parts)


@dataclass(frozen=True, eq=False)
class Choice:
    """The task of a new trial.

    Attributes:
        unit_point: point of the unit cube, shape ``(d,)``; None if the search chooses it.
        origin: the reason for this point; not used if the search chooses the point.
        because: the change that was made to the system since the task was executed before.
        planned_draws: the planned number of independent draws, which is stored with each draw; 0 if the results decide
            the number, None if it is not known.
        note: what is recorded about the choice, in types that JSON has.
        rejected: the number of tasks that were tested and are not steady; None if this task is to be tested.
        parameters: the task parameters as a person gave them; None if they are those of the point, rounded.
    """

    unit_point: Array | None = None
    origin: Origin = "acquisition"
    because: str | None = None
    planned_draws: int | None = None
    note: dict[str, Any] | None = None
    rejected: int | None = None
    parameters: Mapping[str, Any] | None = None
