"""Logs: named fields over time, as a file has them, before anything is resampled.

In a table, all fields share one column of times. In a log of topics, each message has its own times.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import EPISODES, TIMES, column_of, in_seconds, require_distinct, time_column
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import enumerated, quoted, reason_of
from ctxval.errors import InputError

LISTED = 24  #: largest number of fields that a message names

Located = TypeVar("Located")


@contextmanager
def reading(source: object, kind: str = "") -> Iterator[None]:
    """Turn the many exceptions for damaged files into one sentence."""
    what = f"{source} cannot be read as {kind}" if kind else f"{source} cannot be read"
    try:
        yield
    except InputError as error:
        raise InputError(f"{what}: {str(error).removesuffix('.')}.") from error
    except Exception as error:
        raise InputError(f"{what} ({quoted(reason_of(error))}).") from error


@dataclass(frozen=True, eq=False)
class Signal(ShortRepr):
    """One field of a log over time."""

    times: Array  #: seconds, in the order of the log, shape ``(N,)``
    values: Array  #: NaN where the log has none, shape ``(N, k)``; k is 1 unless the field is a vector
    first: int = 0  #: the number of the first sample in messages: the line of a CSV file, the index of a message
    word: str = "row"  #: what such a number counts: ``line``, ``row`` or ``message``
    unit: str = ""  #: the unit that the name of the column states; empty if it states none
    clock: str = ""  #: where the times of messages come from; empty for tables


@dataclass(frozen=True)
class Clock:
    """Where the times of a log come from."""

    #: the column of the times of a table; None to look for ``t``, ``time``, ``times`` or ``timestamp``
    field: str | None = None
    unit: str = ""  #: the unit of this column: s, ms, us, ns, min or h; empty for that in its name, else seconds
    period: float | None = None  #: seconds between two rows of a table that has no times; None if it has times
    #: the time of a message: ``log``, when it was recorded; ``publish``, when it was sent; ``header``, the
    #: ``header.stamp`` or the ``timestamp`` in it; or ``auto``, ``header`` if all messages have plausible ones, else
    #: ``log``
    stamp: str = "auto"


class Log(ShortRepr, ABC):
    """One recording, such as a file or an episode of a data set."""

    source: str  #: the file, and the episode in it, for messages
    period: float | None = None  #: seconds between two samples, if the log states it

    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Return the names of the fields that hold numbers."""

    @abstractmethod
    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        """Return fields over time by their names; ``name[2]`` is one component of a vector."""

    def episodes(self, used: Sequence[str]) -> list[Log]:
        """Return the recordings in this log, one for each number in a column such as ``episode``."""
        return [self]

    def missing(self, field: str) -> InputError:
        """Return the error that there is no such field; its message lists those that there are."""
        return InputError(f"{self.source} has no field {field!r}; it has {enumerated(self.fields(), LISTED)}.")

    def _located(self, field: str, find: Callable[[str], Located | None]) -> tuple[Located, int | None]:
        """Return the column that a field means, and the number of its component if only one is meant."""
        if (column := find(field)) is not None:
            return column, None
        matched = re.fullmatch(r"(.+?)\[(\d{1,6})\]", field)
        if matched is None or (column := find(matched[1])) is None:
            raise self.missing(field)
        return column, int(matched[2])

    def _component(self, field: str, values: Array, index: int | None) -> Array:
        if index is None:
            return values
        if index >= values.shape[1]:
            name = field.rpartition("[")[0]
            raise InputError(f"{self.source}: {name} has {values.shape[1]} components, so there is no {field}.")
        return values[:, [index]]


class Table(Log):
    """A log whose fields share one column of times.

    Args:
        source: the file, and the episode in it, for messages.
        names: the names of the columns.
        columns: a function that returns columns by name, each of shape ``(N,)``, or ``(N, k)`` for vectors.
        word: what counts the rows in messages: ``line`` or ``row``.
        first: the number of the first row in messages.
        period: seconds between two rows, if the log states it.
        marks: a function that returns a column whose values are only compared with each other; ``columns`` by default.
    """

    def __init__(
        self,
        source: str,
        names: Sequence[str],
        columns: Callable[[Sequence[str]], Mapping[str, Array]],
        *,
        word: str = "row",
        first: int = 0,
        period: float | None = None,
        marks: Callable[[str], Array] | None = None,
    ) -> None:
        self.source, self.word, self.first, self.period = source, word, first, period
        self._names, self._columns = tuple(names), columns
        self._marks = marks or (lambda name: columns([name])[name])

    def fields(self) -> tuple[str, ...]:
        return self._names

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        require_distinct(self.source, self._names)
        find = partial(column_of, self.source, self._names)
        located = {field: self._located(field, find) for field in fields}
        time, time_unit = self._time(clock)
        wanted = [*(name for (name, _), _ in located.values()), *filter(None, [time])]
        arrays = self._columns(list(dict.fromkeys(wanted)))
        if time is None:
            times = np.asarray(np.arange(max(map(len, arrays.values()))) * float(clock.period or 0), dtype=np.float64)
        else:
            times = self._oriented(time, arrays[time], arrays[time].size)[:, 0]
            if not len(times) or not np.isfinite(times).all():
                row = self.first + int(np.argmin(np.isfinite(times))) if len(times) else self.first
                raise InputError(f"{self.source}, {self.word} {row}: the time {time} must be a number.")
            times = in_seconds(self.source, times, time_unit)
        signals = {}
        for field, ((name, unit), index) in located.items():
            values = self._component(field, self._oriented(name, arrays[name], len(times)), index)
            signals[field] = Signal(times, values, self.first, self.word, unit)
        return signals

    def episodes(self, used: Sequence[str]) -> list[Log]:
        """Return one table for each run of rows with one number in a column such as ``episode``."""
        counters = [name for name in self._names if name.lower() in EPISODES and name not in used]
        marks = [values for values in map(self._marks, counters) if values.ndim == 1 and len(values) > 1]
        if not marks or len({len(values) for values in marks}) > 1:
            return [self]
        changed = np.any([mark[1:] != mark[:-1] for mark in marks], axis=0)
        count, read = len(marks[0]), dict[str, Array]()

        def rows(start: int, stop: int, names: Sequence[str]) -> dict[str, Array]:
            if missing := [name for name in names if name not in read]:  # each column is read once for all episodes
                read.update(self._columns(missing))
            for name in names:
                if len(read[name]) not in (count, count - 1):
                    raise InputError(
                        f"{self.source}: {name} must have {count} rows, as the numbers of recordings have, got "
                        f"{read[name].shape}."
                    )
            return {name: read[name][start:stop] for name in names}

        def episode(start: int, stop: int) -> Table:
            number = str(marks[0][start]).removesuffix(".0")
            source, columns = f"{self.source}, {counters[0].partition('_')[0]} {number}", partial(rows, start, stop)
            return Table(source, self._names, columns, word=self.word, first=self.first + start, period=self.period)

        return [episode(*ends) for ends in pairwise([0, *(np.flatnonzero(changed) + 1).tolist(), count])]

    def _time(self, clock: Clock) -> tuple[str | None, str]:
        """Return the column of the times and its unit; None if rows have equal steps."""
        if clock.field is not None:
            column = column_of(self.source, self._names, clock.field)
            if column is None:
                raise self.missing(clock.field)
        elif clock.period is not None:
            return None, ""
        elif (column := time_column(self.source, self._names)) is None:
            raise InputError(
                f"{self.source} has no column of times ({', '.join(TIMES)}): name it with time, or give the time "
                "between two rows."
            )
        name, unit = column
        if unit and clock.unit and unit != clock.unit:
            raise InputError(f"{self.source} has its times in {unit}, and time_unit states {clock.unit}.")
        return name, unit or clock.unit

    def _oriented(self, name: str, values: Array, count: int) -> Array:
        """Return an array as ``(N, k)``; MATLAB users also keep one time in each column."""
        array = values.reshape(1, -1).T if values.ndim <= 1 or 1 in values.shape else values
        if array.ndim == 2 and len(array) != count and array.shape[1] == count:
            array = array.T
        if array.ndim == 2 and len(array) == count - 1:  # a trajectory has no input at its last time
            array = np.vstack([array, np.full((1, array.shape[1]), np.nan)])
        if array.ndim != 2 or len(array) != count:
            raise InputError(f"{self.source}: {name} must have {count} rows, as the times have, got {values.shape}.")
        return np.asarray(array)


class MemoryTable(Table):
    """A table whose columns are in memory."""

    def __init__(self, source: str, columns: Mapping[str, Array]) -> None:
        super().__init__(source, tuple(columns), lambda names: {name: columns[name] for name in names})
