"""Trajectories of a closed loop, the transitions in them, and their files."""

from __future__ import annotations

import csv
import io
import re
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ctxval.arrays import Array, Mask, as_floats
from ctxval.errors import InputError, ShapeError
from ctxval.texts import guarded, unguarded, visible

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
            # Read here, as numpy leaves a damaged file open.
            content = source if isinstance(source, bytes) else Path(source).read_bytes()
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                ended = str(arrays["ended"]) if "ended" in arrays else COMPLETE
                return Trajectory(arrays["times"], arrays["states"], arrays["inputs"], ended)
        except _UNREADABLE as error:
            if isinstance(error, InputError):
                raise
            name = "these bytes" if isinstance(source, bytes) else str(source)
            raise InputError(
                f"{name} cannot be read as a trajectory: an NPZ with times, states and inputs is needed."
            ) from error

    def to_csv(
        self, path: str | Path, *, states: Sequence[str] | None = None, inputs: Sequence[str] | None = None
    ) -> None:
        """Write one trajectory as CSV with the columns ``t, x0.., u0..``, or named ones; the last row has no inputs.

        Raises:
            ShapeError: it is a batch, or there are not as many names as columns.
        """
        if self.batch_shape:
            raise ShapeError(f"a CSV file holds one trajectory, got a batch of shape {self.batch_shape}.")
        n, m = self.states.shape[-1], self.inputs.shape[-1]
        header = ["t", *_column_names("x", states, n), *_column_names("u", inputs, m)]
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([guarded(visible(name)) for name in header])
            for k, (time, state) in enumerate(zip(self.times.tolist(), self.states.tolist(), strict=True)):
                row = self.inputs[k].tolist() if k < self.horizon else [""] * m
                writer.writerow([time, *state, *row])

    @staticmethod
    def from_csv(
        path: str | Path, *, states: Sequence[str] | None = None, inputs: Sequence[str] | None = None
    ) -> Trajectory:
        """Read one trajectory from CSV with the columns ``t, x0.., u0..``, or with named ones.

        Units in brackets, as in ``angle [rad]``, may be left out, but must agree where both have one. Further columns
        do not matter, nor do the inputs in the last row.

        Args:
            path: the file.
            states, inputs: names of the columns, with units or without; those that are numbered are taken where none of
                the names is there.

        Raises:
            InputError: the file cannot be read, a column is missing or has another unit, or a cell is no number.
        """
        lines, rows = _read_csv(path)
        if len(rows) < 2:
            raise InputError(f"{path} must have a header and at least two rows.")
        columns = {_bare(name): name for name in rows[0] if name and _bare(name)}
        # Time stands in its own column; a state may be called "time" all the same.
        time = columns.get("t") or columns.get("time")
        x, u = _chosen(path, columns, "x", states), _chosen(path, columns, "u", inputs)
        if time is None or not x:
            raise InputError(
                f"{path} must have the columns t, {', '.join(states or ('x0', '...'))}, "
                f"{', '.join(inputs or ('u0', '...'))}; it has {', '.join(map(str, rows[0]))}."
            )
        return Trajectory(
            _column_block(path, lines, rows, [time])[:, 0],
            _column_block(path, lines, rows, x),
            _column_block(path, lines, rows[:-1], u),
        )

    def resampled(self, times: Array) -> Trajectory:
        """Return one recorded trajectory at other times after its first: states between, inputs as last applied.

        Args:
            times: shape ``(H + 1,)``, seconds, from 0 on.

        Raises:
            InputError: it is a batch, its own times do not increase, or it ends before the last of them.
        """
        own, wanted = self.times - self.times[0], as_floats("times", times)
        if self.batch_shape or not (np.diff(own) > 0).all():
            raise InputError("only one trajectory whose times increase can be resampled.")
        if not own[-1] >= wanted[-1] - _TIMES * (wanted[1] - wanted[0]):
            raise InputError(f"the recording ends after {own[-1]:g} s, and {wanted[-1]:g} s are needed.")
        states = np.stack([np.interp(wanted, own, column) for column in self.states.T], axis=-1)
        # A sample that was meant for a time may have been taken just after it.
        slack = 1e-6 * (wanted[1] - wanted[0])
        held = np.clip(np.searchsorted(own, wanted[:-1] + slack, side="right") - 1, 0, self.horizon - 1)
        return Trajectory(wanted, states, self.inputs[held], self.ended)


_TIMES = 0.01
"""By how much the times of a recording may miss a task's, in steps."""


def require_times(trajectory: Trajectory, times: Array) -> None:
    """Check that a trajectory has these times ``(H + 1,)``, counted from its first.

    Raises:
        InputError: it has another number of them or another step; the message says which.
    """
    dt = times[1] - times[0]
    if len(trajectory.times) != len(times):
        raise InputError(
            f"the trajectory must have {len(times)} times, {len(times) - 1} steps of {dt:g} s, "
            f"got {len(trajectory.times)}."
        )
    own = trajectory.times - trajectory.times[0]
    misses = np.abs(own - times)
    if not (misses <= _TIMES * dt).all():
        k = int(np.argmax(~(misses <= _TIMES * dt)))
        raise InputError(
            f"the trajectory must have steps of {dt:g} s: time {k} must be {times[k]:g} s after the first, "
            f"got {own[k]:g} s."
        )


def _column_names(letter: str, names: Sequence[str] | None, count: int) -> list[str]:
    if names is None:
        return [f"{letter}{i}" for i in range(count)]
    if len(names) != count:
        raise ShapeError(f"there must be {count} names of columns, got {', '.join(names) or 'none'}.")
    return list(names)


def _read_csv(path: str | Path) -> tuple[list[int], list[dict[str, str]]]:
    """Return the rows, and the line of the file at which each ends."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            reader.fieldnames = [unguarded(name) for name in reader.fieldnames or ()]
            numbered = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as CSV: {error}.") from error
    return [line for line, _ in numbered], [row for _, row in numbered]


def _bare(name: str) -> str:
    """Return a column's name without its unit."""
    return name.partition("[")[0].strip()


def _chosen(path: str | Path, columns: dict[str, str], letter: str, names: Sequence[str] | None) -> list[str]:
    """Return which columns are the states, or the inputs."""
    named = [_bare(name) for name in names or ()]
    if not any(name in columns for name in named):
        return [columns[name] for name in _numbered_columns(columns, letter)]
    missing = [name for name in named if name not in columns]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}; there are {', '.join(columns)}.")
    for wanted in names or ():
        _require_unit(path, columns[_bare(wanted)], wanted)
    return [columns[name] for name in named]


def _require_unit(path: str | Path, column: str, wanted: str) -> None:
    has, needs = _unit(column), _unit(wanted)
    if has and needs and has != needs:
        raise InputError(
            f"{path} has {_bare(column)} in {has}, and {needs} is needed; convert it, or if only the unit is written "
            "in another way, write it so or leave it out."
        )


def _unit(name: str) -> str:
    """Return a column's unit, empty where it has none; signs of products do not matter."""
    return re.sub(r"[\s*·.]", "", name.partition("[")[2].rpartition("]")[0])


def _numbered_columns(columns: dict[str, str], letter: str) -> list[str]:
    found = [name for name in columns if name[0] == letter and name[1:].isdigit()]
    names = [f"{letter}{i}" for i in range(len(found))]
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(f"the column {missing[0]} is missing; there are {', '.join(found)}.")
    return names


def _column_block(path: str | Path, lines: list[int], rows: list[dict[str, str]], names: list[str]) -> Array:
    block = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        for j, name in enumerate(names):
            try:
                block[i, j] = float(row[name])
            except (TypeError, ValueError):
                raise InputError(f"{path}, line {lines[i]}: {name} must be a number, got {row[name]!r}.") from None
    return block
