"""Trajectories of closed loops, their transitions, and their files."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, Rows, as_floats, held_means, read_only, rows_of
from ctxval._util.columns import (
    EPISODES,
    FAR,
    column_of,
    conversion,
    in_seconds,
    named_unit,
    time_column,
    unit_advice,
)
from ctxval._util.files import MOST_BYTES, Archive, read_bytes, written_whole
from ctxval._util.quaternions import interpolated
from ctxval._util.representation import ShortRepr, Shown, call, counted, number
from ctxval._util.tables import CsvTable
from ctxval._util.texts import enumerated, guarded, parted, visible
from ctxval.core.labels import require_same_units
from ctxval.errors import InputError, ShapeError

COMPLETE = "complete"
ENORMOUS = 1e100  # states from which sums of inputs may overflow
TERMINATED, DIVERGED = "terminated", "diverged"
"""First words of the reason why a closed loop itself ended early: by a fall or an instability, or without bounds."""


@dataclass(frozen=True, eq=False)
class Transitions(ShortRepr):
    """Recorded steps of a system: in state x ``(N, n)``, the input u ``(N, m)`` led to x_next ``(N, n)``.

    The length of a step, dt in seconds, is None if it is not known. The states and inputs may have names with units;
    these are empty if they are not known.

    Raises:
        ShapeError: if the arrays do not have as many rows and states.
    """

    x: Array
    u: Array
    x_next: Array
    dt: float | None = None
    memory: Array | None = None  #: the memory of M in each step ``(N, k)``, NaN if it is not known; None if M has none
    states: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("x", "u", "x_next"):
            object.__setattr__(self, name, as_floats(name, getattr(self, name)))
        if self.x.ndim != 2 or self.u.ndim != 2 or self.x.shape != self.x_next.shape or len(self.x) != len(self.u):
            got = f"{self.x.shape}, {self.u.shape} and {self.x_next.shape}"
            raise ShapeError(f"transitions need x (N, n), u (N, m) and x_next (N, n), got {got}.")

    def __getitem__(self, rows: slice | Rows | Mask) -> Transitions:
        memory = None if self.memory is None else self.memory[rows]
        return replace(self, x=self.x[rows], u=self.u[rows], x_next=self.x_next[rows], memory=memory)

    def __len__(self) -> int:
        return len(self.x)

    @staticmethod
    def joined(parts: Sequence[Transitions]) -> Transitions:
        """Return several sets of transitions as one set.

        Raises:
            InputError: if steps have different lengths.
            ShapeError: if numbers of states or inputs differ.
        """
        sizes = sorted({(part.x.shape[1], part.u.shape[1]) for part in parts})
        if len(sizes) > 1:
            different = " and ".join(f"{n} states and {m} inputs" for n, m in sizes)
            raise ShapeError(f"recorded steps must have the same numbers of states and inputs, got {different}.")
        steps = [part.dt for part in parts if part.dt is not None]
        if steps and not np.allclose(steps, steps[0], rtol=1e-3, atol=0):
            raise InputError(f"recorded steps must have one length, got {min(steps):g} s and {max(steps):g} s.")
        x, u, x_next = (np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "u", "x_next"))
        width = max((part.memory.shape[1] for part in parts if part.memory is not None), default=0)
        memories = [np.full((len(part), width), np.nan) if part.memory is None else part.memory for part in parts]
        memory = np.concatenate(memories) if width else None
        named = dict[str, Mapping[str, str]]()
        for kind in ("states", "inputs"):
            known = [getattr(part, kind) for part in parts if getattr(part, kind)]
            for other in known[1:]:
                require_same_units("recorded steps", known[0], "others", other)
            named[kind] = known[0] if known else {}
        return Transitions(x, u, x_next, steps[0] if steps else None, memory, **named)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The times, states and inputs of a closed loop, for one task or a batch of tasks.

    Raises:
        ShapeError: if times, states and inputs do not belong together.
    """

    times: Array  #: seconds, shape ``(H + 1,)``
    states: Array  #: shape ``(..., H + 1, n)``
    inputs: Array  #: shape ``(..., H, m)``
    ended: str = COMPLETE  #: ``"complete"``, or the reason why the trajectory ended before its horizon

    def __post_init__(self) -> None:
        for name in ("times", "states", "inputs"):
            object.__setattr__(self, name, as_floats(name, getattr(self, name)))
        times, states, inputs = self.times.shape, self.states.shape, self.inputs.shape
        axes = len(times) == 1 and len(states) >= 2 and len(inputs) == len(states) and states[:-2] == inputs[:-2]
        if not axes or states[-2] != times[0] or inputs[-2] != times[0] - 1:
            wanted = "times (H+1,), states (..., H+1, n) and inputs (..., H, m)"
            raise ShapeError(f"a trajectory needs {wanted}, got {times}, {states} and {inputs}.")

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
        with np.errstate(all="ignore"):
            # A sum over all axes is much faster, and it is finite only if all numbers are.
            if np.isfinite(self.states.sum()) and np.isfinite(self.inputs.sum()):
                return np.ones(self.batch_shape, dtype=np.bool_)
        return np.asarray(np.isfinite(self.states).all(axis=(-1, -2)) & np.isfinite(self.inputs).all(axis=(-1, -2)))

    @property
    def is_outcome(self) -> bool:
        """Whether the closed loop itself ended early, by a fall or an instability; a failed execution is none."""
        return self.ended.startswith((TERMINATED, DIVERGED))

    @property
    def lengths(self) -> Rows:
        """The number of steps before the first value that is not finite, shape ``(...)``."""
        bad = ~(np.isfinite(self.states[..., 1:, :]).all(axis=-1) & np.isfinite(self.inputs).all(axis=-1))
        return np.where(bad.any(axis=-1), bad.argmax(axis=-1), self.horizon)

    @property
    def predicts(self) -> Mask:
        """Whether a closed loop on M is finite, or M had no next state after at least one step, shape ``(...)``.

        A loop that grows without bounds, or whose controller gives NaN, predicts nothing.
        """
        finite = self.finite
        if finite.all():
            return finite
        end = self.lengths
        ended = np.minimum(end, self.horizon - 1)[..., None, None]
        inputs, before, after = (
            np.take_along_axis(part, place, axis=-2)[..., 0, :]
            for part, place in ((self.inputs, ended), (self.states, ended), (self.states, ended + 1))
        )
        ordinary = np.abs(before).max(axis=-1, initial=0.0) < ENORMOUS
        without = np.isfinite(inputs).all(axis=-1) & np.isnan(after).any(axis=-1) & ~np.isinf(after).any(axis=-1)
        return np.asarray(finite | ((end > 0) & ordinary & without))

    def held(self, steps: ArrayLike, times: Array) -> Trajectory:
        """Return the first steps, as many as ``steps`` ``(...)`` says, with the last state and input held to the end.

        The times ``(H + 1,)`` are those of the whole horizon.
        """
        last, t = np.asarray(steps, dtype=np.intp)[..., None], np.arange(len(times))
        rows, acting = np.minimum(t, last), np.minimum(t[:-1], np.maximum(last - 1, 0))
        inputs = self.inputs if self.horizon else np.zeros((*self.batch_shape, 1, self.inputs.shape[-1]))
        states = np.take_along_axis(self.states, rows[..., None], axis=-2)
        return Trajectory(times, states, np.take_along_axis(inputs, acting[..., None], axis=-2), self.ended)

    def copy(self) -> Trajectory:
        """Return the same trajectory with arrays of its own, which may be changed."""
        return Trajectory(self.times.copy(), self.states.copy(), self.inputs.copy(), self.ended)

    def frozen(self) -> Trajectory:
        """Return the same trajectory with arrays that cannot be changed."""
        return Trajectory(read_only(self.times), read_only(self.states), read_only(self.inputs), self.ended)

    def __getitem__(self, index: int) -> Trajectory:
        """Return one trajectory of the batch; the batch's ``ended`` applies to trajectories that are not finite."""
        single = Trajectory(self.times, self.states[index], self.inputs[index])
        return single if self.ended == COMPLETE or single.finite.all() else replace(single, ended=self.ended)

    def first(self, steps: int) -> Trajectory:
        """Return the first steps."""
        states, inputs = self.states[..., : steps + 1, :], self.inputs[..., :steps, :]
        return Trajectory(self.times[: steps + 1], states, inputs, self.ended)

    def transitions(self) -> Transitions:
        """Return all steps of all tasks of the batch as one set of transitions."""
        return Transitions(rows_of(self.states[..., :-1, :]), rows_of(self.inputs), rows_of(self.states[..., 1:, :]))

    # Files

    def to_npz(self) -> bytes:
        """Return the trajectory as the bytes of an NPZ file."""
        buffer, arrays = io.BytesIO(), {name: getattr(self, name) for name in ("times", "states", "inputs")}
        np.savez_compressed(buffer, allow_pickle=False, **arrays, ended=np.array(self.ended))
        return buffer.getvalue()

    @staticmethod
    def from_npz(
        source: bytes | str | Path, *, shape: tuple[int, int] | None = None, most: int = MOST_BYTES
    ) -> Trajectory:
        """Read a trajectory from NPZ bytes or an NPZ file of at most so many bytes; no code in it is ever run.

        The states of a complete trajectory must have the shape ``(H + 1, n)``, if it is given.

        Raises:
            InputError: if the file cannot be read as a trajectory.
            ShapeError: if the states have another shape.
        """
        name = "these bytes" if isinstance(source, bytes) else str(source)
        try:
            arrays = Archive(source if isinstance(source, bytes) else read_bytes(source, most), most)
            ended = arrays.text("ended") if "ended" in arrays.names else COMPLETE
            held = arrays.header("states")[0]
            if shape is not None and ended == COMPLETE and held != shape:
                raise ShapeError(f"the trajectory must have states of shape {shape}, got {held}.")
            times, states, inputs = (arrays.numbers(name) for name in ("times", "states", "inputs"))
            return Trajectory(times, states, inputs, ended)
        except ShapeError:
            raise
        except InputError as error:
            wanted = "an NPZ with times, states and inputs is needed"
            raise InputError(f"{name} cannot be read as a trajectory: {wanted}; {error}.") from error

    def to_csv(
        self, path: str | Path, *, states: Sequence[str] | None = None, inputs: Sequence[str] | None = None
    ) -> None:
        """Write one trajectory as CSV; the last row has no inputs.

        The columns are ``t`` and the named states and inputs, ``x0, x1, ...`` and ``u0, u1, ...`` by default.

        Raises:
            ShapeError: if it is a batch, or if there is not a name for each column.
        """
        if self.batch_shape:
            raise ShapeError(f"a CSV file must hold one trajectory, got a batch of shape {self.batch_shape}.")
        header = ["t"]
        for letter, names, count in (("x", states, self.states.shape[-1]), ("u", inputs, self.inputs.shape[-1])):
            columns = [f"{letter}{i}" for i in range(count)] if names is None else list(names)
            if len(columns) != count:
                raise ShapeError(f"there must be {count} names of columns, got {', '.join(columns) or 'none'}.")
            header += columns
        with written_whole(path, text=True) as file:
            writer = csv.writer(file)
            writer.writerow([guarded(visible(name)) for name in header])
            rows = [*self.inputs.tolist(), [""] * self.inputs.shape[-1]]
            for time, state, row in zip(self.times.tolist(), self.states.tolist(), rows, strict=True):
                writer.writerow([time, *state, *row])

    @staticmethod
    def from_csv(
        path: str | Path,
        *,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        most_rows: int | None = None,
    ) -> Trajectory:
        """Read one trajectory from CSV with the columns ``t, x0.., u0..``, or with named columns.

        A column may state its unit, as in ``angle [deg]`` or ``angle_deg``, and is converted to that of its name; times
        are in seconds. Other columns and the inputs in the last row are ignored. Columns are separated by commas, or by
        semicolons or tabs, with which decimal commas are read.

        Args:
            states, inputs: names of the columns, with or without units. If the file has none of the names, the
                numbered columns ``x0, x1, ...`` and ``u0, u1, ...`` are read.
            most_rows: largest number of rows below the header; a file with more rows is refused.

        Raises:
            InputError: if columns are missing, there are fewer than two rows, or several recordings.
        """
        table = CsvTable(path)
        time = time_column(str(path), table.names)
        x, u = _chosen(table, "x", states), _chosen(table, "u", inputs)
        if any(table.names) and (time is None or not x):
            wanted = ", ".join(["t", *(states or ("x0", "...")), *(inputs or ("u0", "..."))])
            raise InputError(f"{path} must have the columns {wanted}; it has {_listed(table.names)}.")
        column, unit = time or ("", "s")
        clock = table.clock_times(column) if time else None
        read = table.columns([*([] if clock is not None else [column]), *x, *u], last=list(u), most=most_rows)
        if len(times := read[column] if clock is None else clock) < 2:
            raise InputError(f"{path} must have a header and at least two rows.")
        if any(len(set(table.texts(name))) > 1 for name in table.names if name in EPISODES and name not in read):
            raise InputError(f"{path} has several recordings, which a column numbers; a file must hold one.")
        unit = "s" if clock is not None else unit or ("s" if column == "t" else "")
        seconds = in_seconds(str(path), times, unit)
        chosen = (np.array([factor * read[name] for name, factor in part.items()]) for part in (x, u))
        rows = [part.reshape(-1, len(times)).T for part in chosen]
        return Trajectory(seconds, np.ascontiguousarray(rows[0]), np.ascontiguousarray(rows[1][:-1]))

    def resampled(self, times: Array) -> Trajectory:
        """Return one recorded trajectory at other times ``(H + 1,)``, in seconds after its first time, from 0.

        States are interpolated linearly, unit quaternions on the sphere. Inputs, which hold until the next sample, are
        averaged over the steps.
        A record that is there twice counts once.

        Raises:
            InputError: if times do not increase, steps are too long, or the end is missing.
        """
        if self.batch_shape:
            raise InputError("only a single trajectory can be resampled.")
        recorded, wanted, steps = self.times - self.times[0], as_floats("times", times), np.diff(self.times)
        repeated = (steps == 0) & (np.diff(self.states, axis=0) == 0).all(axis=-1)
        repeated[:-1] &= (np.diff(self.inputs, axis=0) == 0).all(axis=-1)
        if repeated.any():  # loggers write records twice
            kept = np.append(True, ~repeated)
            inputs = self.inputs[kept[:-1]][: int(kept.sum()) - 1]
            return Trajectory(self.times[kept], self.states[kept], inputs, self.ended).resampled(wanted)
        if not (steps > 0).all():
            row = int(np.argmin(steps > 0)) + 1
            before, after = self.times[row - 1 : row + 1]
            raise InputError(f"the times must increase, and record {row} is at {after:.6g} s after {before:.6g} s.")
        dt, period = float(wanted[1] - wanted[0]), float(np.median(steps))
        advice = f"; {text}" if (text := unit_advice(period, dt)) else ""
        if period > FAR * dt:
            raise InputError(f"the recording has steps of {period:g} s instead of {dt:g} s{advice}.")
        gaps = np.where(recorded[:-1] < wanted[-1], steps, 0.0)  # what comes after the end of the task is not used
        if gaps.max() > FAR * dt:
            row = int(np.argmax(gaps))
            gap = f"nothing was recorded for {gaps[row]:.4g} s from {self.times[row]:.6g} s on"
            raise InputError(f"{gap}, which is more than {FAR:g} steps of {dt:g} s.")
        if not recorded[-1] >= wanted[-1] - _TIMES * dt:
            ends = f"the recording ends after {recorded[-1]:g} s, and {wanted[-1]:g} s are needed"
            raise InputError(f"{ends}{advice}.")
        states = interpolated(wanted, recorded, self.states)
        # A sample that belongs to a time may have been recorded just after it.
        inputs = held_means(recorded[:-1], self.inputs, wanted, 1e-6 * dt)
        return Trajectory(wanted, states, inputs, self.ended)

    def __repr__(self) -> str:
        length = Shown(f"{counted(self.horizon, 'step')} in {number(self.times[-1] - self.times[0])} s")
        return call(self, length, self.ended, states=self.states, inputs=self.inputs)


_TIMES = 0.01  # largest difference between the times of a recording and those of its task, in steps


_JITTER = 0.25  # largest difference between measured times and those of a task, in steps, that interpolation mends


def at_times(trajectory: Trajectory, times: Array) -> Trajectory:
    """Return a trajectory at the times of a task ``(H + 1,)``, counted from its first time, from its measured times.

    States are interpolated linearly, unit quaternions on the sphere. The inputs stay, because each was applied when its
    state was measured. An InputError refuses times that are further away than a quarter of a step.
    """
    recorded, dt = trajectory.times - trajectory.times[0], np.diff(times)[:1]
    misses = np.abs(recorded - times) if len(recorded) == len(times) else np.array([np.inf])
    if (misses <= _TIMES * dt).all() or not (misses <= _JITTER * dt).all():
        require_times(trajectory, times)
        return trajectory
    states = interpolated(times, recorded, trajectory.states)
    return Trajectory(times, states, trajectory.inputs, trajectory.ended)


def require_times(trajectory: Trajectory, times: Array) -> None:
    """Check that a trajectory has these times ``(H + 1,)``, counted from its first time."""
    dt, recorded = times[1] - times[0], trajectory.times - trajectory.times[0]
    misses = np.abs(recorded - times) if len(recorded) == len(times) else np.array([np.inf])
    if (misses <= _TIMES * dt).all():
        return
    period = float(np.median(np.diff(recorded)))
    advice = unit_advice(period, dt)
    if not advice and recorded[-1] >= times[-1] - _TIMES * dt:
        advice = "if it is a recording, --resample of `ctxval tell` interpolates it to these times"
    advice = f"; {advice}" if advice else ""
    if len(recorded) != len(times):
        got = f"{len(recorded)} with steps of {period:g} s{advice}"
        raise InputError(f"the trajectory must have {len(times)} times, {len(times) - 1} steps of {dt:g} s, got {got}.")
    k = int(np.argmax(~(misses <= _TIMES * dt)))
    first = f"time {k} must be {times[k]:g} s after the first, got {recorded[k]:g} s"
    largest = f"The measured period is {period:g} s. The largest difference is {np.max(misses):.3g} s{advice}"
    raise InputError(f"the trajectory must have steps of {dt:g} s: {first}. {largest}.")


def _listed(names: Sequence[str]) -> str:
    return enumerated((name[:60] for name in names), 20)


def _chosen(table: CsvTable, letter: str, names: Sequence[str] | None) -> dict[str, float]:
    path, wanted = str(table.path), dict(parted(name) for name in names or ())
    columns = {name: column_of(path, table.names, name) for name in wanted}
    if not any(columns.values()):
        units = {plain: (name, unit) for name in table.names for plain, unit, _ in (named_unit(name),)}
        count = sum(1 for plain in units if plain[:1] == letter and plain[1:].isdigit())
        columns = {f"{letter}{i}": units.get(f"{letter}{i}") for i in range(count)}
        wanted = dict(zip(columns, wanted.values(), strict=False)) if len(wanted) == count else {}
    factors = dict[str, float]()
    for name, column in columns.items():
        if column is None:
            raise InputError(f"{path} has no column {name}; there are {_listed(table.names)}.")
        try:
            factors[column[0]] = conversion(column[1], wanted.get(name) or column[1]) if column[1] else 1.0
        except InputError:
            raise InputError(f"{path} has {name} in {column[1]}, and {wanted[name]} is needed.") from None
    return factors
