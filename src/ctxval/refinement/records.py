"""What the executions of all rounds teach, and the errors of a model on those that it was not learned from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.errors import CtxvalError, InputError


@dataclass(frozen=True, eq=False)
class Records(ShortRepr):
    """Executions of the system, and transitions that belong to none of them.

    Attributes:
        executed: the trajectories of the system, in the order of the rounds.
        own: the data of the first model; None if it has none.
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
        data = getattr(model, "data", None)
        return cls(tuple(executed), data if isinstance(data, Transitions) and len(data) else None)

    @property
    def transitions(self) -> Transitions:
        """All transitions, those of the first model first."""
        data = [] if self.own is None else [self.own]
        return Transitions.joined([*data, *(run.transitions() for run in self.executed)])

    @property
    def sources(self) -> Rows:
        """The execution of each transition; -1 for the data of the first model."""
        count = 0 if self.own is None else len(self.own)
        of = np.repeat(np.arange(len(self.executed)), [run.horizon for run in self.executed])
        return np.concatenate([np.full(count, -1), of])

    def folds(self) -> list[tuple[Records, Records]]:
        """Return pairs of records: those to learn from, and those that are held out.

        One execution is held out at a time. If there is only one and the model carries no data, its halves are; if
        there is none, halves of the data.
        """
        count = len(self.executed)
        if count == 0 and self.own is not None:
            halves = np.array_split(np.random.default_rng(0).permutation(len(self.own)), 2)
            first, second = (Records((), self.own[half]) for half in halves)
            return [(first, second), (second, first)]
        if count == 1 and self.own is None:
            run = self.executed[0]
            middle = run.horizon // 2
            if middle < 1:
                raise InputError("the only execution has one step: too few to hold a part out.")
            first = Records((Trajectory(run.times[: middle + 1], run.states[: middle + 1], run.inputs[:middle]),))
            second = Records((Trajectory(run.times[middle:], run.states[middle:], run.inputs[middle:]),))
            return [(first, second), (second, first)]
        parts = min(count, 10)  # of more executions, some are held out together
        return [
            (
                replace(self, executed=tuple(run for k, run in enumerate(self.executed) if k % parts != part)),
                Records(self.executed[part::parts]),
            )
            for part in range(parts)
        ]


@dataclass(frozen=True, eq=False)
class HeldOut(ShortRepr):
    """One-step errors ``S(x, u) - M(x, u)`` on N transitions that the model was not learned from.

    Attributes:
        pairs: the states and inputs, shape ``(N, n + m)``.
        errors: those of the learned model, shape ``(N, n)``.
        before: those of the first model, shape ``(N, n)``.
        changes: the recorded changes of the states in one step, shape ``(N, n)``.
        groups: the part that was held out together with each transition, shape ``(N,)``.
    """

    pairs: Array
    errors: Array
    before: Array
    changes: Array
    groups: Array

    @property
    def better(self) -> Mask:
        """The states whose error became smaller, in the root mean square, shape ``(n,)``.

        A correction of the states that are chosen by these errors is also reported with them, so the reported errors
        are slightly too small. Those of the last round's executions, which chose nothing, are not.
        """
        return np.asarray((self.errors**2).mean(axis=0) < (self.before**2).mean(axis=0))

    @property
    def rms(self) -> Array:
        """The root mean square of each state's error, shape ``(n,)``."""
        return np.asarray(np.sqrt((self.errors**2).mean(axis=0)))

    @property
    def rms_before(self) -> Array:
        """That of the first model, shape ``(n,)``."""
        return np.asarray(np.sqrt((self.before**2).mean(axis=0)))

    def kept(self, chosen: Mask) -> HeldOut:
        """Return the errors if only the chosen states ``(n,)`` are corrected."""
        return replace(self, errors=np.where(chosen, self.errors, self.before))

    def with_executions(self, model: Model, before: Model, executed: tuple[Trajectory, ...]) -> HeldOut:
        """Return these errors and those on executions that the model itself was not learned from."""
        if not executed:
            return self
        last = int(self.groups.max(initial=-1))
        parts = [_compared(run.transitions(), model, before, last + 1 + k) for k, run in enumerate(executed)]
        return _joined([self, *parts])


def held_out(learn: Callable[[Records], Model], before: Model, records: Records) -> HeldOut:
    """Return the errors on each part of the records, of the model that is learned from the other parts.

    Transitions on which a model is not finite count with the error of the first model, and so do parts that leave too
    few records to learn from.
    """
    parts = []
    for group, (known, held) in enumerate(records.folds()):
        try:
            model = learn(known)
        except CtxvalError:
            model = before
        parts.append(_compared(held.transitions, model, before, group))
    return _joined(parts)


def _compared(data: Transitions, model: Model, before: Model, group: int) -> HeldOut:
    with np.errstate(all="ignore"):
        errors, first = (data.x_next - one.step(data.x, data.u) for one in (model, before))
    usable = np.isfinite(first).all(axis=1)
    errors = np.where(np.isfinite(errors), errors, first)
    pairs, changes = np.concatenate([data.x, data.u], axis=1), data.x_next - data.x
    groups = np.full(len(data), group)
    return HeldOut(*(array[usable] for array in (pairs, errors, first, changes, groups)))


def _joined(parts: list[HeldOut]) -> HeldOut:
    names = ("pairs", "errors", "before", "changes", "groups")
    return HeldOut(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
