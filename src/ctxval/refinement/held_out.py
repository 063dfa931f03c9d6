"""Errors of a learned model on executions that it was not learned from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.errors import CtxvalError
from ctxval.refinement.records import Records


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
        parts = [_compared(one.transitions(), model, before, last + 1 + k) for k, one in enumerate(executed)]
        return _joined([self, *parts])


def held_out(learn: Callable[[Records], Model], before: Model, records: Records) -> HeldOut:
    """Return the errors on each part of the records, of the model that is learned from the other parts.

    Transitions on which a model is not finite count with the error of the first model, and so do parts that leave too
    few records to learn from.

    Args:
        learn: learns a model.
        before: the first model.
        records: the records.
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
