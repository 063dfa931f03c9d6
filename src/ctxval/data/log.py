"""Logs: named fields over time, as a file has them, before anything is resampled.

In a table, all fields share one column of times. In a log of topics, each message has its own times.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import call
from ctxval._util.texts import enumerated
from ctxval.data.units import conversion
from ctxval.errors import InputError

TIMES = ("t", "time", "times", "timestamp")
"""Names under which the times of a table are looked for."""

LISTED = 24
"""Largest number of fields that a message names."""

_INDEX = re.compile(r"(.+?)\[(\d{1,6})\]")


@dataclass(frozen=True, eq=False)
class Signal:
    """One field of a log over time.

    Attributes:
        times: seconds, in the order of the log, shape ``(N,)``.
        values: the values, NaN where the log has none, shape ``(N, k)``; k is 1 unless the field is a vector.
        first: the number of the first sample in messages: the line of a CSV file, the index of a message.
        word: what such a number counts: ``line``, ``row`` or ``message``.
    """

    times: Array
    values: Array
    first: int = 0
    word: str = "row"

    def __repr__(self) -> str:
        return call(self, times=self.times, values=self.values)


@dataclass(frozen=True)
class Clock:
    """Where the times of a log come from.

    Attributes:
        field: the column of the times of a table; None to look for ``t``, ``time``, ``times`` or ``timestamp``.
        unit: the unit of this column: s, ms, us or ns.
        period: seconds between two rows of a table that has no times; None if it has times.
        stamp: the time of a message: ``log``, when it was recorded; ``publish``, when it was sent; or ``header``, the
            ``header.stamp`` or the ``timestamp`` in it.
    """

    field: str | None = None
    unit: str = "s"
    period: float | None = None
    stamp: str = "log"


class Log(ABC):
    """One recording, such as a file or an episode of a data set.

    Attributes:
        source: the file, and the episode in it, for messages.
    """

    source: str

    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Return the names of the fields that hold numbers."""

    @abstractmethod
    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        """Return fields over time.

        Args:
            fields: names of fields; ``name[2]`` is one component of a vector.
            clock: where the times come from.

        Raises:
            InputError: if there is no such field, or it does not hold numbers; the message names file, field and row.
        """

    @property
    def period(self) -> float | None:
        """Seconds between two samples, if the log states it."""
        return None

    def missing(self, field: str) -> InputError:
        """Return the error that there is no such field; its message lists those that there are."""
        return InputError(f"{self.source} has no field {field!r}; it has {enumerated(self.fields(), LISTED)}.")

    def __repr__(self) -> str:
        return call(self, self.source)


class Table(Log):
    """A log whose fields share one column of times."""

    word = "row"
    first = 0

    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""

    @abstractmethod
    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return columns, each with shape ``(N,)``, or ``(N, k)`` for vectors.

        Raises:
            InputError: if a column does not hold numbers.
        """

    def fields(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return self.names()

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        """Return fields over time; see :meth:`Log.signals`."""
        names = set(self.names())
        split = {field: self._split(field, names) for field in fields}
        time = self._time(clock, names)
        wanted = dict.fromkeys([*(name for name, _ in split.values()), *([time] if time is not None else [])])
        arrays = self.columns(list(wanted))
        if time is None:
            rows = max(len(arrays[name]) for name, _ in split.values())
            times = np.asarray(np.arange(rows) * float(clock.period or 0), dtype=np.float64)
        else:
            times = self._seconds(time, arrays[time], clock)
        count = len(times)
        found = {}
        for field, (name, index) in split.items():
            values = self._oriented(name, arrays[name], count)
            if index is not None and index >= values.shape[1]:
                raise InputError(f"{self.source}: {name} has {values.shape[1]} components, so there is no {field}.")
            found[field] = Signal(times, values if index is None else values[:, [index]], self.first, self.word)
        return found

    def _split(self, field: str, names: set[str]) -> tuple[str, int | None]:
        if field in names:
            return field, None
        matched = _INDEX.fullmatch(field)
        if matched is None or matched[1] not in names:
            raise self.missing(field)
        return matched[1], int(matched[2])

    def _time(self, clock: Clock, names: set[str]) -> str | None:
        if clock.field is not None:
            if clock.field not in names:
                raise self.missing(clock.field)
            return clock.field
        if clock.period is None:
            found = next((name for name in TIMES if name in names), None)
            if found is None:
                raise InputError(
                    f"{self.source} has no column of times ({', '.join(TIMES)}): name it with time, or give the time "
                    "between two rows."
                )
            return found
        return None

    def _seconds(self, name: str, column: Array, clock: Clock) -> Array:
        times = self._oriented(name, column, column.size)[:, 0] * conversion(clock.unit, "s")
        if not len(times) or not np.isfinite(times).all():
            row = self.first + int(np.argmin(np.isfinite(times))) if len(times) else self.first
            raise InputError(f"{self.source}, {self.word} {row}: the time {name} must be a number.")
        return np.asarray(times)

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
    """A table whose columns are in memory.

    Args:
        source: the file, for messages.
        columns: the columns by name.
        first: the number of the first row in messages.
        period: seconds between two rows, if it is known.
    """

    def __init__(self, source: str, columns: Mapping[str, Array], first: int = 0, period: float | None = None) -> None:
        self.source, self.first = source, first
        self._columns, self._period = dict(columns), period

    @property
    def period(self) -> float | None:
        """Seconds between two rows, if the file states it."""
        return self._period

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self._columns)

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Return columns by name."""
        return {name: self._columns[name] for name in names}


@dataclass(frozen=True, eq=False)
class Message:
    """One message of a topic.

    Attributes:
        topic: its topic.
        logged, published: when it was recorded and sent, nanoseconds.
        content: its decoded fields: a mapping, or an object with an attribute for each field.
    """

    topic: str
    logged: int
    published: int
    content: Any

    def __repr__(self) -> str:
        return call(self, self.topic, logged=self.logged)


class TopicLog(Log):
    """A log of messages on topics; a field is ``/topic.field.part[2]``."""

    @abstractmethod
    def topics(self) -> tuple[str, ...]:
        """Return the names of the topics."""

    @abstractmethod
    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of their log times.

        Raises:
            InputError: if a message cannot be decoded.
        """

    def fields(self) -> tuple[str, ...]:
        """Return the names of the fields that hold numbers in the first message of each topic."""
        left, found = set(self.topics()), list[str]()
        for topic in self.topics():
            try:
                first = next(iter(self.messages([topic])), None)
            except InputError:
                continue  # the topic has another encoding
            left.discard(topic)
            found += [] if first is None else [f"{topic}.{path}" for path in _leaves(first.content)]
        return tuple(found)

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        """Return fields over time; see :meth:`Log.signals`."""
        split = {field: self._split(field) for field in fields}
        times: dict[str, list[int]] = {topic: [] for topic, _ in split.values()}
        values: dict[str, list[Array]] = {field: [] for field in fields}
        for message in self.messages(times):
            number = len(times[message.topic])
            times[message.topic].append(self._time(message, number, clock))
            for field, (topic, path) in split.items():
                if topic == message.topic:
                    values[field].append(self._value(message, number, path))
        origin = min((min(own) for own in times.values() if own), default=0)
        return {field: self._signal(field, times[split[field][0]], values[field], origin) for field in fields}

    def _signal(self, field: str, times: list[int], values: list[Array], origin: int) -> Signal:
        if not times:
            raise InputError(f"{self.source} has no message with the field {field!r}.")
        widths = [len(value) for value in values]
        if len(set(widths)) > 1:
            row = next(i for i, width in enumerate(widths) if width != widths[0])
            raise InputError(
                f"{self.source}, message {row} of {field}: it must have {widths[0]} numbers, got {widths[row]}."
            )
        seconds = np.array([1e-9 * (time - origin) for time in times])
        return Signal(seconds, np.array(values).reshape(len(times), -1), 0, "message")

    def _split(self, field: str) -> tuple[str, tuple[str | int, ...]]:
        for topic in sorted(self.topics(), key=len, reverse=True):
            if field.startswith(f"{topic}."):
                return topic, _path(field[len(topic) + 1 :])
        raise self.missing(field)

    def _time(self, message: Message, number: int, clock: Clock) -> int:
        if clock.stamp == "log":
            return message.logged
        if clock.stamp == "publish":
            return message.published
        stamp = _first(message.content, ("header", "stamp"), ("timestamp",))
        whole, part = _first(stamp, ("sec",), ("seconds",)), _first(stamp, ("nanosec",), ("nsec",), ("nanos",))
        if whole is None or part is None:
            raise InputError(
                f"{self.source}, message {number} of {message.topic}: it has no header.stamp or timestamp."
            )
        return int(whole) * 10**9 + int(part)

    def _value(self, message: Message, number: int, path: tuple[str | int, ...]) -> Array:
        found = _resolved(message.content, path)
        try:
            if found is None or isinstance(found, str | bytes):
                raise TypeError
            return np.asarray(found, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError):
            shown = "nothing" if found is None else repr(found)[:60]
            raise InputError(
                f"{self.source}, message {number} of {message.topic}: {_joined(path)} must be a number or a list of "
                f"numbers, got {shown}."
            ) from None


def _path(text: str) -> tuple[str | int, ...]:
    """Return the steps of a path such as ``pose.position[2].x``."""
    steps: list[str | int] = []
    for part in text.split("."):
        name, *indices = part.replace("]", "").split("[")
        steps += [name, *(int(index) if index.isdigit() else index for index in indices)]
    return tuple(step for step in steps if step != "")


def _joined(path: Sequence[str | int]) -> str:
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).removeprefix(".")


def _resolved(content: Any, path: Sequence[str | int]) -> Any:
    """Return a part of a message; None if there is none."""
    for step in path:
        if isinstance(step, int):
            content = content[step] if hasattr(content, "__getitem__") and step < len(content) else None
        elif isinstance(content, Mapping):
            content = content.get(step)
        else:
            # Only fields that the message's class declares: attributes of Python are not data.
            content = getattr(content, step, None) if step in getattr(type(content), "__slots__", ()) else None
        if content is None:
            return None
    return content


def _first(content: Any, *paths: Sequence[str | int]) -> Any:
    """Return the first part of a message that exists; None if there is none."""
    return next((found for path in paths if (found := _resolved(content, path)) is not None), None)


def _leaves(content: Any, before: str = "", depth: int = 6) -> Iterator[str]:
    """Yield the paths of all numbers in a message."""
    if isinstance(content, bool | int | float | np.number):
        yield before
    elif depth and isinstance(content, Mapping):
        for name, part in content.items():
            yield from _leaves(part, f"{before}.{name}".removeprefix("."), depth - 1)
    elif depth and isinstance(content, list | tuple | np.ndarray):
        for index, part in enumerate(content[:16]):
            yield from _leaves(part, f"{before}[{index}]", depth - 1)
    elif depth and not isinstance(content, str | bytes):
        for name in getattr(type(content), "__slots__", ()):
            yield from _leaves(getattr(content, name), f"{before}.{name}".removeprefix("."), depth - 1)
