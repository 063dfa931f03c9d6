"""Outputs y = h(x) of M, if the system records them in place of states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.representation import ShortRepr
from ctxval.core.controller import Controller, ControllerWithMemory
from ctxval.core.model import central_differences
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError

OutputsLike = Callable[[Array], Array] | Sequence[int]
"""A function ``h(x) -> y`` of states ``(..., n)`` to outputs ``(..., p)``, or the indices of the states to record."""


class Outputs(ShortRepr):
    """The outputs y = h(x) of states of M, shapes ``(..., n) -> (..., p)``.

    A function that takes one state ``(n,)`` at a time is called once for each.
    """

    def __init__(self, given: OutputsLike) -> None:
        if callable(given):
            self.function: OutputsLike = given
        else:
            self.function = [int(i) for i in given]
            if not self.function or len(set(self.function)) < len(self.function) or min(self.function) < 0:
                raise InputError(f"outputs must be a function h(x), or different indices of states, got {given!r}.")
        self._batched: bool | None = None

    def describe(self) -> dict[str, Any]:
        """Return what identifies these outputs in a store."""
        return {"of": self.function}

    @property
    def indices(self) -> list[int] | None:
        """The indices of the states that are recorded; None if a function gives the outputs."""
        return None if callable(self.function) else list(self.function)

    def __call__(self, x: Array) -> Array:
        """Return outputs ``(..., p)`` of states ``(..., n)``."""
        x = np.asarray(x, dtype=np.float64)
        if not callable(self.function):
            if max(self.function) >= x.shape[-1]:
                raise InputError(f"outputs must be indices of M's {x.shape[-1]} states, got {list(self.function)}.")
            return x[..., self.function]
        if x.ndim == 1:
            return self._of_one(x)
        rows = rows_of(x)
        if self._batched is None and len(rows):
            self._batched = self._takes_batches(x, rows)
        if self._batched:
            return np.asarray(self.function(x), dtype=np.float64)
        return np.stack([self._of_one(row) for row in rows]).reshape(*x.shape[:-1], -1)

    def _of_one(self, x: Array) -> Array:
        assert callable(self.function)
        y = np.asarray(self.function(x), dtype=np.float64)
        if y.ndim != 1 or not y.size:
            raise ShapeError(f"outputs of one state must have shape (p,), got {y.shape} for a state {x.shape}.")
        return y

    def _takes_batches(self, x: Array, rows: Array) -> bool:
        """Return whether the function returns for a batch what it returns for its first and last state alone."""
        assert callable(self.function)
        alone = [self._of_one(row) for row in (rows[0], rows[-1])]
        try:
            y = np.asarray(self.function(x), dtype=np.float64)
        except Exception:  # the user's function, which may take one state only
            return False
        if y.shape != (*x.shape[:-1], *alone[0].shape):
            return False
        ends = rows_of(y)[[0, -1]]
        return bool(np.allclose(ends, alone, rtol=1e-9, atol=0, equal_nan=True))

    def jacobian(self, x: Array) -> Array:
        """Return C = dh/dx, shape ``(..., p, n)``, at states ``(..., n)``."""
        n = x.shape[-1]
        if not callable(self.function):
            C = np.eye(n)[self.function]
            return np.broadcast_to(C, (*x.shape[:-1], *C.shape))
        return central_differences(lambda states, _: self(states), x, np.zeros((*x.shape[:-1], 0)))[0]

    def of(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory with its outputs in the place of states."""
        with np.errstate(all="ignore"):  # of a loop that diverged
            return replace(trajectory, states=self(trajectory.states))

    def seen_by(self, controller: Controller, task: Task | None = None) -> Controller:
        """Return a controller of the states for a controller that sees the outputs alone.

        A task is the one from which a controller with memory starts, if the states are not those of M.
        """
        if isinstance(controller, ControllerWithMemory):
            return _OutputController(controller, self, task)
        return lambda t, x: controller(t, self(x))


@dataclass(frozen=True)
class _OutputController:
    """A controller with memory that sees the outputs alone."""

    controller: ControllerWithMemory
    outputs: Outputs
    task: Task | None

    def start(self, task: Task) -> Any:
        return self.controller.start(task if self.task is None else self.task)

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        return self.controller.step(t, self.outputs(x), memory)


def as_outputs(given: OutputsLike | Outputs | None) -> Outputs | None:
    """Return outputs from any form in which users may give them; None stays None."""
    return given if given is None or isinstance(given, Outputs) else Outputs(given)
