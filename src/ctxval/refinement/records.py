"""What the executions of all rounds teach: their trajectories, and the data of the first model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import call
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.errors import InputError

# Largest number of parts that are held out one after the other; of more executions, some are held out together.
_FOLDS = 10


@dataclass(frozen=True, eq=False)
class Records:
    """Executions of the system, and transitions that belong to none of them.

    Attributes:
        executed: the trajectories of the system, in the order of the rounds.
        own: the data of the first model; None if it has none.

    Raises:
        InputError: if there are neither.
    """

    executed: tuple[Trajectory, ...]
    own: Transitions | None = None

    def __post_init__(self) -> None:
        if not self.executed and (self.own is None or not len(self.own)):
            raise InputError(
                "there is nothing to learn from: no execution is stored with its trajectory, and the model carries no "
                "data. Record the states and inputs of the executions, or give the model its data."
            )

    @classmethod
    def of(cls, model: Model, executed: Sequence[Trajectory]) -> Records:
        """Return the records of executions, and the data of the first model."""
        own = getattr(model, "data", None)
        return cls(tuple(executed), own if isinstance(own, Transitions) and len(own) else None)

    @property
    def transitions(self) -> Transitions:
        """All transitions, those of the first model first."""
        own = [] if self.own is None else [self.own]
        return Transitions.joined([*own, *(one.transitions() for one in self.executed)])

    @property
    def sources(self) -> Rows:
        """The execution of each transition; -1 for the data of the first model."""
        own = 0 if self.own is None else len(self.own)
        of = np.repeat(np.arange(len(self.executed)), [one.horizon for one in self.executed])
        return np.concatenate([np.full(own, -1), of])

    def folds(self) -> list[tuple[Records, Records]]:
        """Return pairs of records: those to learn from, and those that are held out.

        One execution is held out at a time. If there is only one and the model carries no data, its halves are; if
        there is none, halves of the data.
        """
        count = len(self.executed)
        if count == 0 and self.own is not None:
            halves = np.array_split(np.random.default_rng(0).permutation(len(self.own)), 2)
            first, second = (Records((), _rows(self.own, half)) for half in halves)
            return [(first, second), (second, first)]
        if count == 1 and self.own is None:
            middle = self.executed[0].horizon // 2
            first, second = (Records((part,)) for part in _halves(self.executed[0], middle))
            return [(first, second), (second, first)]
        groups = [list(range(count))[k :: min(count, _FOLDS)] for k in range(min(count, _FOLDS))]
        return [(self._without(group), replace(self._only(group), own=None)) for group in groups]

    def _without(self, group: list[int]) -> Records:
        return replace(self, executed=tuple(one for k, one in enumerate(self.executed) if k not in group))

    def _only(self, group: list[int]) -> Records:
        return replace(self, executed=tuple(self.executed[k] for k in group))

    def __repr__(self) -> str:
        return call(self, executed=len(self.executed), transitions=len(self.sources))


def _rows(data: Transitions, rows: Array | Rows) -> Transitions:
    return Transitions(data.x[rows], data.u[rows], data.x_next[rows])


def _halves(one: Trajectory, middle: int) -> tuple[Trajectory, Trajectory]:
    if middle < 1:
        raise InputError("the only execution has one step: too few to hold a part out.")
    return (
        Trajectory(one.times[: middle + 1], one.states[: middle + 1], one.inputs[:middle]),
        Trajectory(one.times[middle:], one.states[middle:], one.inputs[middle:]),
    )
