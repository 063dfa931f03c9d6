"""Trajectories of a closed loop, the transitions in them, and their files."""

from __future__ import annotations

import csv
import io
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ctxval.arrays import Array, Mask, as_floats
from ctxval.errors import InputError, ShapeError

COMPLETE = "complete"

_UNREADABLE = (OSError, EOFError, ValueError, TypeError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What numpy and zipfile raise for damaged or foreign bytes."""


@dataclass(frozen=True, eq=False)
class Transitions:
    """Recorded steps of a system: at state x, input u led to x_next.

    Shapes ``(N, n)``, ``(N, m)``, ``(N, n)``.

    Raises:
        ShapeError: the three do not fit together.
    """

    x: Array
    u: Array
    x_next: Array

    def __post_init__(self) -> None:
        for name in ("x", "u", "x_next"):
            array = as_floats(name, getattr(self, name))
            object.__setattr__(self, name, array)
        if self.x.ndim != 2 or self.u.ndim != 2 or self.x.shape != self.x_next.shape or len(self.x) != len(self.u):
            raise ShapeError(
                "transitions need x (N, n), u (N, m) and x_next (N, n), "
                f"got {self.x.shape}, {self.u.shape} and {self.x_next.shape}."
            )

    def __len__(self) -> int:
        return len(self.x)

    @staticmethod
    def joined(parts: Sequence[Transitions]) -> Transitions:
        """Return several sets of transitions as one."""
        return Transitions(
            np.concatenate([part.x for part in parts]),
            np.concatenate([part.u for part in parts]),
            np.concatenate([part.x_next for part in parts]),
        )


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What a closed loop did, for one task or a batch of tasks.

    Attributes:
        times: shape ``(H + 1,)``, seconds.
        states: shape ``(..., H + 1, n)``.
        inputs: shape ``(..., H, m)``.
        ended: how it ended: ``"complete"``, or the reason why it stopped before its horizon.

    Raises:
        ShapeError: the three arrays do not fit together.
    """

    times: Array
    states: Array
    inputs: Array
    ended: str = COMPLETE

    def __post_init__(self) -> None:
        for name in ("times", "states", "inputs"):
            object.__setattr__(self, name, as_floats(name, getattr(self, name)))
        if (
            self.times.ndim != 1
            or self.states.ndim < 2
            or self.inputs.ndim != self.states.ndim
            or self.states.shape[:-2] != self.inputs.shape[:-2]
            or self.states.shape[-2] != len(self.times)
            or self.inputs.shape[-2] != len(self.times) - 1
        ):
            raise ShapeError(
                "a trajectory needs times (H+1,), states (..., H+1, n) and inputs (..., H, m), "
                f"got {self.times.shape}, {self.states.shape} and {self.inputs.shape}."
            )

    @property
    def horizon(self) -> int:
        """The number of steps H."""
        return len(self.times) - 1

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading axes; ``()`` for one task."""
        return self.states.shape[:-2]

    @property
    def final_state(self) -> Array:
        """The last state, shape ``(..., n)``."""
        return self.states[..., -1, :]

    @property
    def finite(self) -> Mask:
        """Whether every state and input is finite, shape ``(...)``."""
        whole = np.isfinite(self.states).all(axis=(-1, -2)) & np.isfinite(self.inputs).all(axis=(-1, -2))
        return np.asarray(whole)

    def __getitem__(self, index: int) -> Trajectory:
        """Return one trajectory of the batch; how the batch ended is said of those that are not finite."""
        one = Trajectory(self.times, self.states[index], self.inputs[index])
        return one if self.ended == COMPLETE or one.finite.all() else replace(one, ended=self.ended)

    def transitions(self) -> Transitions:
        """Return every step as a transition, all tasks of a batch in one."""
        n, m = self.states.shape[-1], self.inputs.shape[-1]
        return Transitions(
            self.states[..., :-1, :].reshape(-1, n), self.inputs.reshape(-1, m), self.states[..., 1:, :].reshape(-1, n)
        )

    # Files

    def to_npz(self) -> bytes:
        """Return the trajectory as the bytes of an NPZ file."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer, times=self.times, states=self.states, inputs=self.inputs, ended=np.array(self.ended)
        )
        return buffer.getvalue()

    @staticmethod
    def from_npz(source: bytes | str | Path) -> Trajectory:
        """Read a trajectory from NPZ bytes or an NPZ file; no code in it is ever run.

        Raises:
            InputError: it is not such a file.
        """
        try:
            handle = io.BytesIO(source) if isinstance(source, bytes) else source
            with np.load(handle, allow_pickle=False) as arrays:
                ended = str(arrays["ended"]) if "ended" in arrays else COMPLETE
                return Trajectory(arrays["times"], arrays["states"], arrays["inputs"], ended)
        except _UNREADABLE as error:
            if isinstance(error, InputError):
                raise
            name = "these bytes" if isinstance(source, bytes) else str(source)
            raise InputError(
                f"{name} cannot be read as a trajectory: an NPZ with times, states and inputs is needed."
            ) from error

    def to_csv(self, path: str | Path) -> None:
        """Write one trajectory as CSV with the columns ``t, x0.., u0..``; the last row has no inputs.

        Raises:
            ShapeError: it is a batch.
        """
        if self.batch_shape:
            raise ShapeError(f"a CSV file holds one trajectory, got a batch of shape {self.batch_shape}.")
        n, m = self.states.shape[-1], self.inputs.shape[-1]
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["t", *(f"x{i}" for i in range(n)), *(f"u{i}" for i in range(m))])
            for k, (time, state) in enumerate(zip(self.times.tolist(), self.states.tolist(), strict=True)):
                inputs = self.inputs[k].tolist() if k < self.horizon else [""] * m
                writer.writerow([time, *state, *inputs])

    @staticmethod
    def from_csv(path: str | Path) -> Trajectory:
        """Read one trajectory from CSV with the columns ``t, x0.., u0..``.

        Raises:
            InputError: the file cannot be read, or a column is missing, or a cell is no number.
        """
        try:
            with open(path, newline="", encoding="utf-8-sig") as file:
                rows = list(csv.DictReader(file))
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{path} cannot be read as CSV: {error}.") from error
        if len(rows) < 2:
            raise InputError(f"{path} must have a header and at least two rows.")
        states, inputs = _numbered_columns(rows[0], "x"), _numbered_columns(rows[0], "u")
        if "t" not in rows[0] or not states:
            raise InputError(
                f"{path} must have the columns t, x0, ..., u0, ...; it has {', '.join(map(str, rows[0]))}."
            )
        return Trajectory(
            _column_block(path, rows, ["t"])[:, 0],
            _column_block(path, rows, states),
            _column_block(path, rows[:-1], inputs),
        )


def _numbered_columns(row: dict[str, str], letter: str) -> list[str]:
    found = [name for name in row if name and name[0] == letter and name[1:].isdigit()]
    names = [f"{letter}{i}" for i in range(len(found))]
    missing = [name for name in names if name not in row]
    if missing:
        raise InputError(f"the column {missing[0]} is missing; there are {', '.join(found)}.")
    return names


def _column_block(path: str | Path, rows: list[dict[str, str]], names: list[str]) -> Array:
    block = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        for j, name in enumerate(names):
            try:
                block[i, j] = float(row[name])
            except (TypeError, ValueError):
                raise InputError(f"{path}, line {i + 2}: {name} must be a number, got {row[name]!r}.") from None
    return block
