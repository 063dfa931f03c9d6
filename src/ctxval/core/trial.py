"""Trials, each one task p with all its results; and changes of a store's trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import Array, read_only
from ctxval._util.representation import ShortRepr, call, counted
from ctxval.core.space import Point
from ctxval.core.trial_note import NO_NOTE, TrialNote

Origin = Literal["iid", "spread", "initial", "acquisition", "covering", "manual"]
"""The reason why a trial was chosen. Only iid trials, which are independent draws, enter a scenario bound."""

State = Literal["open", "completed", "failed", "unmeasured"]
"""The state of a trial. Unmeasured: S was executed and its trajectory is stored, but d has no usable value."""


REDEFINED = "the distance has changed"
"""The reason in the history of a store whose distances were measured again by another definition."""

TOLD_ALONE = "its distance was told without a trajectory, and the distance has changed since: execute the task again."
"""The failure of a trial that was reported without a trajectory, so that a new distance cannot be computed."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One task p with all its results."""

    number: int  #: number of the trial, from 0, in the order in which the search proposed them
    origin: Origin  #: the reason why p was chosen; covering: p was far from all other trials, or tests the bound
    state: State
    unit_point: Array  #: p in the unit cube, shape ``(d,)``
    parameters: dict[str, Point]  #: p by name
    attempts: int = 0  #: number of times that the execution was started
    executed: bool = False  #: whether an execution of S ended, successfully or not; the budget counts these
    distance: float | None = None  #: d(p); None if the trial is not completed
    failure: str | None = None  #: the reason why the trial failed or its distance could not be measured
    seconds: float | None = None  #: duration of the execution, if known
    note: TrialNote = NO_NOTE  #: what is recorded beside the task and the result
    #: what was changed on the system since an earlier trial of the same task that had another result
    because: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit_point", read_only(self.unit_point))

    @property
    def told(self) -> bool:
        """Whether a person has told the result of the execution."""
        return self.executed and self.state != "open" and not self.attempts

    @property
    def least(self) -> float:
        """What d(p) is at least: the distance, or that of the steps before a failure; 0 if neither is known.

        It is infinite if the closed loop of S ended by a fall or an instability, and that of M did not.
        """
        if self.ended_alone is not None:
            return np.inf
        return (self.note.at_least or 0.0) if self.distance is None else self.distance

    @property
    def ended_alone(self) -> float | None:
        """The seconds after which S fell or became unstable, if M did not; else None."""
        return self.note.ends.system if self.state == "failed" and self.note.ends is not None else None

    def __repr__(self) -> str:
        ended = {"distance": self.distance, "seconds": self.seconds, "attempts": self.attempts}
        about = {"parameters": self.parameters, "failure": self.failure, "because": self.because}
        return call(self, self.number, origin=self.origin, state=self.state, **ended, **about)


class Trials(tuple[Trial, ...]):
    """Trials in the order of asking."""

    __slots__ = ()

    def in_state(self, *states: State) -> Trials:
        """Return the trials in one of these states."""
        return Trials(trial for trial in self if trial.state in states)

    @property
    def open(self) -> Trials:
        """The trials that are being executed, or wait for it."""
        return self.in_state("open")

    @property
    def ended(self) -> Trials:
        """The trials that are not open."""
        return self.in_state("completed", "failed", "unmeasured")

    @property
    def completed(self) -> Trials:
        """The trials with a distance."""
        return self.in_state("completed")

    @property
    def executions(self) -> int:
        """The number of executions of S that have ended, with or without success."""
        return sum(trial.executed for trial in self)

    @property
    def worst(self) -> Trial | None:
        """The first trial with the largest distance; None if no distance is known."""
        return max(self.completed, key=lambda trial: trial.distance or 0.0, default=None)

    @property
    def largest(self) -> float:
        """The largest distance; 0 if none is known."""
        return max((trial.distance or 0.0 for trial in self), default=0.0)

    @property
    def numbers(self) -> list[int]:
        """The numbers of the trials."""
        return [trial.number for trial in self]

    @property
    def distances(self) -> Array:
        """The distances ``(n,)``; NaN if a distance is not known."""
        return np.array([np.nan if trial.distance is None else trial.distance for trial in self])

    def points(self, dimension: int) -> Array:
        """Return the tasks as points of the unit cube ``(n, d)``."""
        return np.array([trial.unit_point for trial in self]).reshape(-1, dimension)


def designs_sentence(trials: Sequence[Trial]) -> str | None:
    """Return which controllers of executed tasks did not converge or jump; None if nothing of the kind is recorded."""
    executed = [trial for trial in trials if trial.executed]
    designs = [trial.note.converged for trial in executed if trial.note.converged is not None]
    worst = max(executed, key=lambda trial: -1.0 if trial.distance is None else trial.distance, default=None)
    among = worst is not None and worst.note.converged is False
    parts = []
    if failed := designs.count(False):
        where = f"{failed} of {len(designs)} executed tasks{', among them the worst one' if among else ''}"
        parts.append(f"the design of the controller did not converge at {where}")
    if early := sum(trial.note.ends is not None for trial in executed if trial.distance is not None):
        what = f"{early} of {len(executed)} executions ended early on M and S, by a fall or an instability"
        parts.append(f"{what}, and distances are over the common part")
    if falls := [trial.note.falls for trial in executed if trial.note.falls is not None]:
        of_model, of_system = (sum(seconds is not None for seconds in loop) for loop in zip(*falls, strict=True))
        parts.append(f"the robot fell in {of_system} of {len(executed)} executions, and on M in {of_model}")
    rejected = sum(trial.note.unsteady or 0 for trial in trials)
    if rejected:
        tasks = f"{counted(rejected, 'task')} {'was' if rejected == 1 else 'were'} not executed"
        parts.append(f"{tasks}, because the controller jumps if the task changes by 1e-9 of its range")
    return "; ".join(parts) or None


@dataclass(frozen=True)
class Change(ShortRepr):
    """A later change of a store: its kind, the user's reason, and the previous values or the differences."""

    what: str
    why: str
    content: dict[str, Any]
    at: str = ""  #: the time in UTC; empty until the change is stored


@dataclass(frozen=True)
class StatedThreshold(ShortRepr):
    """A threshold that was stated to a campaign, and how many distances were known when it was first stated."""

    threshold: float
    distances: int
    at: str = ""  #: the time in UTC
