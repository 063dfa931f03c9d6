"""Histories: what a record, the inputs and the errors of M before it say of the next record.

A controller acts on records, so the law of the next record given the recorded history fixes that of every closed loop,
whatever state the system has. With the predicted record ``y^ = M(x^, u) + r(z)`` and the innovation ``e = y' - y^``,
the estimate of the next state is ``x^' = y^ + K e`` (the innovations form; Ljung 1999, Sec. 4.3). Without measurement
noise K = 1, and the regressors z have lags: of the errors of M, which show states that are not recorded, and of the
changes of the inputs, which show delays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.core.model import Model

Residual = Callable[[Array], Array]  # r(z) of regressors (..., D), shape (..., n)


@dataclass(frozen=True)
class Structure:
    """How much history the next record depends on."""

    lags: int = 0  # number of earlier errors of M and changes of inputs among the regressors
    ratio: float = 0.0  # variance of measurement noise over that of process noise; 0 if records are the state


@dataclass(frozen=True, eq=False)
class Record:
    """One execution: its records ``(H + 1, n)``, its inputs ``(H, m)``, and the initial state of its task ``(n,)``."""

    states: Array
    inputs: Array
    start: Array


@dataclass(frozen=True, eq=False)
class Memory:
    """What is kept of a history; leading axes are those of a batch."""

    estimate: Array  # the estimated state, (..., n)
    errors: Array  # the latest errors of M, the newest first, (lags, ..., n)
    inputs: Array  # the latest inputs, the newest first, (lags, ..., m); 0 before the start, when all was at rest


@dataclass(frozen=True, eq=False)
class History:
    """The recursion from record to record for one structure."""

    model: Model
    structure: Structure
    gain: Array  # K, (n, n)

    @classmethod
    def of(cls, model: Model, structure: Structure, scales: Array, middle: tuple[Array, Array]) -> History:
        """Return the recursion with the gain of a Kalman filter, for M at its middle and process noise ``(n,)``."""
        n = len(scales)
        if not structure.ratio:
            return cls(model, structure, np.eye(n))
        steps = 1e-4 * np.maximum(np.abs(middle[0]), 1.0)
        A = jacobian(lambda x: model.step(x, np.broadcast_to(middle[1], (len(x), len(middle[1])))), middle[0], steps)
        process = np.diag(scales**2 + 1e-18)
        P = process
        for _ in range(300):
            gain = P @ np.linalg.inv(P + structure.ratio * process)
            P = A @ (P - gain @ P) @ A.T + process
        if not np.isfinite(P).all():
            raise np.linalg.LinAlgError
        return cls(model, structure, P @ np.linalg.inv(P + structure.ratio * process))

    def start(self, record: Array, start: Array, inputs: int) -> Memory:
        """Return the memory before the first step, from the first record ``(..., n)`` and the task's initial state."""
        lags, before = self.structure.lags, record.shape[:-1]
        estimate = start + (record - start) @ self.gain.T
        return Memory(estimate, np.zeros((lags, *record.shape)), np.zeros((lags, *before, inputs)))

    def regressors(self, memory: Memory, u: Array) -> Array:
        """Return z, shape ``(..., D)``: the estimate, the input, and lags of errors and of changes of the input."""
        parts, after = [memory.estimate, u], u
        for error, before in zip(memory.errors, memory.inputs, strict=True):
            # A filter's estimate holds what the earlier errors say.
            parts += [] if self.structure.ratio else [error]
            parts.append(before - after)
            after = before
        return np.concatenate(parts, axis=-1)

    def after(self, memory: Memory, u: Array, of_model: Array, predicted: Array, record: Array) -> Memory:
        """Return the memory after a step: the step of M, the prediction with the residual, and the record."""
        estimate = predicted + (record - predicted) @ self.gain.T if self.structure.ratio else record
        if not self.structure.lags:
            return Memory(estimate, memory.errors, memory.inputs)
        errors = np.concatenate([(record - of_model)[None], memory.errors[:-1]])
        return Memory(estimate, errors, np.concatenate([u[None], memory.inputs[:-1]]))

    def along(
        self,
        records: Sequence[Record],
        residual: Residual | None = None,
        visit: Callable[[Memory, Array, Array], None] | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return regressors ``(N, D)``, errors of M and innovations ``(N, n)`` of all steps.

        Records of one horizon are a batch; the steps are in the order horizon, step, record. ``visit`` is called with
        the memory, the inputs and the regressors of each step.
        """
        steps = []
        for alike in of_one_horizon(records):
            states, inputs, start = (
                np.stack([getattr(record, name) for record in alike]) for name in ("states", "inputs", "start")
            )
            memory = self.start(states[:, 0], start, inputs.shape[-1])
            for t in range(inputs.shape[1]):
                u, record = inputs[:, t], states[:, t + 1]
                z, of_model = self.regressors(memory, u), self.model.step(memory.estimate, u)
                predicted = of_model if residual is None else of_model + residual(z)
                if visit is not None:
                    visit(memory, u, z)
                steps.append((z, record - of_model, record - predicted))
                memory = self.after(memory, u, of_model, predicted, record)
        Z, E, innovations = (np.concatenate(parts) for parts in zip(*steps, strict=True))
        if not np.isfinite(innovations).all():
            raise np.linalg.LinAlgError  # the filter diverges
        return Z, E, innovations


def of_one_horizon(records: Sequence[Record]) -> Iterator[list[Record]]:
    """Yield the records of each horizon."""
    ordered = sorted(records, key=lambda record: len(record.inputs))
    for _, alike in groupby(ordered, key=lambda record: len(record.inputs)):
        yield list(alike)


def rows_of_executions(records: Sequence[Record]) -> list[Rows]:
    """Return the rows of each record in what :meth:`History.along` returns, in the order of time."""
    order = sorted(range(len(records)), key=lambda k: len(records[k].inputs))
    rows, first = [np.empty(0, dtype=np.intp)] * len(records), 0
    for alike in of_one_horizon(records):
        steps, many = len(alike[0].inputs), len(alike)
        for j in range(many):
            rows[order.pop(0)] = first + j + many * np.arange(steps)
        first += many * steps
    return rows


def jacobian(function: Callable[[Array], Array], x: Array, steps: Array) -> Array:
    """Return derivatives ``(..., n, n)`` of a function at states ``(..., n)``, by central differences in one call."""
    moves = np.diag(steps).reshape(len(steps), *(1,) * (x.ndim - 1), len(steps))
    up, down = np.split(function(np.concatenate([x + moves, x - moves])), 2)
    return np.asarray(np.moveaxis(up - down, 0, -1) / (2 * steps))
