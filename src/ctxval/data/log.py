"""Logs: named fields over time, as a file has them, before anything is resampled.

In a table, all fields share one column of times. In a log of topics, each message has its own times.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import KW_ONLY, dataclass
from dataclasses import field as attribute
from functools import partial
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.columns import EPISODES, TIMES, column_of, in_seconds, named_unit, require_distinct, time_column
from ctxval._util.representation import ShortRepr, counted
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
    remarks: Sequence[str] = ()  #: what was left out of signals that were read, one sentence each

    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Return the names of the fields that hold numbers."""

    @abstractmethod
    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        """Return fields over time by their names; ``name[2]`` is one component of a vector."""

    def numbered_times(self, clock: Clock) -> tuple[str, str] | None:
        """Return the column of numbers that are the times, and its unit, empty if not stated; None without one."""
        return None

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


@dataclass(eq=False)
class Table(Log):
    """A log whose fields share one column of times."""

    source: str  #: the file, and the episode in it, for messages
    names: Sequence[str] = attribute(repr=False)
    #: a function that returns columns by name, each of shape ``(N,)``, or ``(N, k)`` for vectors
    columns: Callable[[Sequence[str]], Mapping[str, Array]] = attribute(repr=False)
    _: KW_ONLY
    word: str = "row"  #: what counts the rows in messages: ``line`` or ``row``
    first: int = 0  #: the number of the first row in messages
    period: float | None = None  #: seconds between two rows, if the log states it
    #: a function that returns a column whose values are only compared with each other; ``columns`` by default
    marks: Callable[[str], Array] | None = attribute(default=None, repr=False)
    #: a function that returns a column of dates or clock times in seconds; None if it holds numbers
    clock: Callable[[str], Array | None] | None = attribute(default=None, repr=False)

    def __post_init__(self) -> None:
        self.remarks: list[str] = []

    def fields(self) -> tuple[str, ...]:
        return tuple(self.names)

    def has(self, field: str) -> bool:
        """Return whether a column is meant by a field, with or without its unit."""
        return column_of(self.source, self.names, field) is not None

    def numbered_times(self, clock: Clock) -> tuple[str, str] | None:
        name, unit = self._time(clock)
        dated = name is not None and self.clock is not None and self.clock(name) is not None
        return None if name is None or dated else (name, unit)

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        require_distinct(self.source, self.names)
        find = partial(column_of, self.source, self.names)
        located = {field: self._located(field, find) for field in fields}
        time, time_unit = self._time(clock)
        clocked = self.clock(time) if self.clock is not None and time is not None else None
        wanted = [*(name for (name, _), _ in located.values()), *filter(None, [time] if clocked is None else [])]
        arrays = dict(self.columns(list(dict.fromkeys(wanted))))
        if time is None:
            times = np.asarray(np.arange(max(map(len, arrays.values()))) * float(clock.period or 0), dtype=np.float64)
        else:
            if clocked is not None:
                arrays[time], time_unit = clocked, "s"
            times = self._oriented(time, arrays[time], arrays[time].size)[:, 0]
        columns = {name: self._oriented(name, arrays[name], len(times)) for (name, _), _ in located.values()}
        first, word = self.first, self.word
        if time is not None:
            kept = self._kept(times, np.hstack([*columns.values()]))
            if not kept.all():  # the lines of the file no longer count the rows
                times, columns = times[kept], {name: values[kept] for name, values in columns.items()}
                first, word = 0, "row"
            if not len(times) or not np.isfinite(times).all():
                row = first + int(np.argmin(np.isfinite(times))) if len(times) else first
                raise InputError(f"{self.source}, {word} {row}: the time {time} must be a number.")
            times = in_seconds(self.source, times, time_unit)
        signals = {}
        for field, ((name, unit), index) in located.items():
            signals[field] = Signal(times, self._component(field, columns[name], index), first, word, unit)
        return signals

    def _kept(self, times: Array, values: Array) -> Mask:
        """Return which rows count: rows without any number separate sessions, and a logger may write a row twice."""
        rows = np.column_stack([times, values])
        empty: Mask = np.asarray(np.isnan(rows).all(axis=1))
        same = (rows[1:] == rows[:-1]) | (np.isnan(rows[1:]) & np.isnan(rows[:-1]))
        twice: Mask = np.asarray(np.append(False, same.all(axis=1)) & ~empty)
        for rows_of, what in ((empty, "no number in it"), (twice, "a copy of the one before")):
            count = int(rows_of.sum())
            if count and (text := f"{self.source}: {counted(count, self.word)} left out ({what})") not in self.remarks:
                self.remarks.append(text)
        return ~(empty | twice)

    def episodes(self, used: Sequence[str]) -> list[Log]:
        """Return one table for each run of rows with one number in a column such as ``episode``."""
        counters = [name for name in self.names if name.lower() in EPISODES and name not in used]
        counts = [self.marks(name) if self.marks else self.columns([name])[name] for name in counters]
        marks = [values for values in counts if values.ndim == 1 and len(values) > 1]
        if not marks or len({len(values) for values in marks}) > 1:
            return [self]
        changed = np.any([mark[1:] != mark[:-1] for mark in marks], axis=0)
        count, read, clocks = len(marks[0]), dict[str, Array](), dict[str, Array | None]()

        def rows(start: int, stop: int, names: Sequence[str]) -> dict[str, Array]:
            if missing := [name for name in names if name not in read]:  # each column is read once for all episodes
                read.update(self.columns(missing))
            for name in names:
                if len(read[name]) not in (count, count - 1):
                    wanted = f"{count} rows, as the numbers of recordings have"
                    raise InputError(f"{self.source}: {name} must have {wanted}, got {read[name].shape}.")
            return {name: read[name][start:stop] for name in names}

        def clocked(start: int, stop: int, name: str) -> Array | None:
            if name not in clocks:
                clocks[name] = self.clock(name) if self.clock else None
            return None if (times := clocks[name]) is None else times[start:stop]

        def episode(start: int, stop: int) -> Table:
            number = str(marks[0][start]).removesuffix(".0")
            source, columns = f"{self.source}, {counters[0].partition('_')[0]} {number}", partial(rows, start, stop)
            part = Table(source, self.names, columns, word=self.word, first=self.first + start, period=self.period)
            part.clock, part.remarks = self.clock and partial(clocked, start, stop), self.remarks
            return part

        return [episode(*ends) for ends in pairwise([0, *(np.flatnonzero(changed) + 1).tolist(), count])]

    def _time(self, clock: Clock) -> tuple[str | None, str]:
        """Return the column of the times and its unit; None if rows have equal steps."""
        if clock.field is not None:
            column = column_of(self.source, self.names, clock.field)
            if column is None:
                plain, stated, _ = named_unit(clock.field)
                if stated and (column := column_of(self.source, self.names, plain)) is not None:
                    how = f"rename it if its times are in {stated}"
                    raise InputError(f"{self.source} states the times of {column[0]} in {column[1]}: {how}.")
                raise self.missing(clock.field)
        elif clock.period is not None:
            return None, ""
        elif (column := time_column(self.source, self.names)) is None:
            how = "name it with time, or give the time between two rows"
            raise InputError(f"{self.source} has no column of times ({', '.join(TIMES)}): {how}.")
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


# Messages


@dataclass(frozen=True, eq=False)
class Message(ShortRepr):
    """One message of a topic."""

    topic: str
    logged: int  #: when it was recorded, nanoseconds
    published: int  #: when it was sent, nanoseconds
    content: Any  #: nested mappings and lists


@dataclass(frozen=True)
class MessageLimits:
    """What logs of messages may hold, so that reading them takes bounded memory."""

    numbers: int = 2**30  # bytes of the numbers of messages; each message needs 256 bytes more
    chunk: int = 128 * 2**20  # bytes of a record, and of a chunk of records after it is decompressed


class TopicLog(Log):
    """A log of messages on topics; a field is ``/topic.field.part[2]``."""

    limits = MessageLimits()

    @abstractmethod
    def topics(self) -> tuple[str, ...]:
        """Return the names of the topics."""

    @abstractmethod
    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of their log times."""

    def fields(self) -> tuple[str, ...]:
        """Return the names of the fields that hold numbers in the first message of each topic."""
        names: list[str] = []
        for topic in self.topics():
            with suppress(InputError):  # the topic has another encoding
                first = next(iter(self.messages([topic])), None)
                names += [] if first is None else [f"{topic}.{path}" for path in _numeric_fields(first.content)]
        return tuple(names)

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        split = {field: self._split(field) for field in fields}
        records: dict[str, list[tuple[dict[str, Any], dict[str, Array]]]] = {topic: [] for topic, _ in split.values()}
        size = 0
        for message in self.messages(records):
            of_topic = records[message.topic]
            paths = {field: path for field, (topic, path) in split.items() if topic == message.topic}
            values = {field: self._value(message, len(of_topic), path) for field, path in paths.items()}
            stamps = {"log": message.logged, "publish": message.published, "header": _header(message.content)}
            of_topic.append((stamps, values))
            size += sum(256 + value.nbytes for value in values.values())
            if size > self.limits.numbers:
                raise InputError(
                    f"{self.source} has too many numbers: {self.limits.numbers} bytes of memory may be used."
                )
        for of_topic in records.values():
            of_topic.sort(key=lambda record: record[0]["log"])
        all_stamps = {topic: [stamps for stamps, _ in of_topic] for topic, of_topic in records.items()}
        chosen = ("header" if _plausible(all_stamps) else "log") if clock.stamp == "auto" else clock.stamp
        times = {topic: [stamps[chosen] for stamps in of_topic] for topic, of_topic in all_stamps.items()}
        for topic, of in times.items():
            if None in of:
                message_text = f"{self.source}, message {of.index(None)} of {topic}"
                raise InputError(f"{message_text}: it has no header.stamp or timestamp.")
        origin = min((min(of) for of in times.values() if of), default=0)
        signals = {}
        for field, (topic, _) in split.items():
            if not times[topic]:
                raise InputError(f"{self.source} has no message with the field {field!r}.")
            column = [values[field] for _, values in records[topic]]
            for row, value in enumerate(column):
                if len(value) != len(column[0]):
                    must = f"it must have {len(column[0])} numbers, got {len(value)}"
                    raise InputError(f"{self.source}, message {row} of {field}: {must}.")
            seconds = np.array([1e-9 * (time - origin) for time in times[topic]])
            _, unit, weak = named_unit(field)
            array = np.array(column).reshape(len(seconds), -1)
            signals[field] = Signal(seconds, array, 0, "message", "" if weak else unit, chosen)
        return signals

    def _split(self, field: str) -> tuple[str, tuple[str | int, ...]]:
        for topic in sorted(self.topics(), key=len, reverse=True):
            if field.startswith(f"{topic}."):
                steps: list[str | int] = []  # such as pose.position[2].x
                for part in field[len(topic) + 1 :].split("."):
                    name, *indices = part.replace("]", "").split("[")
                    steps += [name, *(int(index) if index.isdigit() else index for index in indices)]
                return topic, tuple(step for step in steps if step != "")
        raise self.missing(field)

    def _value(self, message: Message, number: int, path: tuple[str | int, ...]) -> Array:
        value = _resolved(message.content, path)
        try:
            if value is None or isinstance(value, str | bytes):
                raise TypeError
            return np.asarray(value, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError):
            shown = "nothing" if value is None else repr(value)[:60]
            name = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).removeprefix(".")
            must = f"{name} must be a number or a list of numbers, got {shown}"
            raise InputError(f"{self.source}, message {number} of {message.topic}: {must}.") from None


def _header(content: Any) -> int | None:
    """Return the ``header.stamp`` or the ``timestamp`` in a message, nanoseconds; None if there is none."""
    stamp = _first(content, ("header", "stamp"), ("timestamp",))
    whole, part = _first(stamp, ("sec",)), _first(stamp, ("nanosec",), ("nsec",))
    return None if whole is None or part is None else int(whole) * 10**9 + int(part)


def _plausible(stamps: Mapping[str, Sequence[Mapping[str, Any]]]) -> bool:
    """Return whether all messages have stamps that increase on each topic and agree with the log times up to 1 s."""
    late = list[int]()  # the clock may be another one, such as that of a simulator, if all topics have the same one
    for of_topic in stamps.values():
        headers = [stamp["header"] for stamp in of_topic]
        if None in headers or any(b <= a for a, b in pairwise(headers)):
            return False
        late += [stamp["log"] - stamp["header"] for stamp in of_topic]
    return bool(late) and max(late) - min(late) <= 10**9


def _resolved(content: Any, path: Sequence[str | int]) -> Any:
    for step in path:
        match step, content:
            case int(), _:
                content = content[step] if hasattr(content, "__getitem__") and step < len(content) else None
            case _:
                content = content.get(step) if isinstance(content, Mapping) else None
    return content


def _first(content: Any, *paths: Sequence[str | int]) -> Any:
    return next((value for path in paths if (value := _resolved(content, path)) is not None), None)


def leaves(content: Mapping[str, Any], before: str = "", depth: int = 6) -> Iterator[tuple[str, Any]]:
    """Yield what nested tables hold by its path, such as ``pose.x``."""
    for name, value in content.items():
        path = f"{before}.{name}".removeprefix(".")
        if not isinstance(value, Mapping):
            yield path, value
        elif depth:
            yield from leaves(value, path, depth - 1)


def _numeric_fields(content: Any, before: str = "", depth: int = 6) -> Iterator[str]:
    parts: Iterable[tuple[str, Any]] = ()
    match content:
        case int() | float() | np.number():
            yield before
        case Mapping():
            parts = ((f"{before}.{name}", part) for name, part in content.items())
        case list() | tuple() | np.ndarray():
            parts = ((f"{before}[{index}]", part) for index, part in enumerate(content[:16]))
    for path, part in parts if depth else ():
        yield from _numeric_fields(part, path.removeprefix("."), depth - 1)
