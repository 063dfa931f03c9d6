"""Logs of messages on topics, each of which has times of its own."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import named_unit
from ctxval._util.representation import ShortRepr
from ctxval.data.log import Clock, Log, Signal
from ctxval.errors import InputError

_MOST_MEMORY = 2**30  # largest size of the numbers of a log in bytes; each message needs 256 bytes more


@dataclass(frozen=True, eq=False)
class Message(ShortRepr):
    """One message of a topic, and when it was recorded and sent, in nanoseconds.

    The content is a mapping, or an object with an attribute for each field.
    """

    topic: str
    logged: int
    published: int
    content: Any


class TopicLog(Log):
    """A log of messages on topics; a field is ``/topic.field.part[2]``."""

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
                names += [] if first is None else [f"{topic}.{path}" for path in _leaves(first.content)]
        return tuple(names)

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        split = {field: self._split(field) for field in fields}
        records: dict[str, list[tuple[dict[str, Any], dict[str, Array]]]] = {topic: [] for topic, _ in split.values()}
        size = 0
        for message in self.messages(records):
            of_topic = records[message.topic]
            values = {
                field: self._value(message, len(of_topic), path)
                for field, (topic, path) in split.items()
                if topic == message.topic
            }
            stamps = {"log": message.logged, "publish": message.published, "header": _header(message.content)}
            of_topic.append((stamps, values))
            size += sum(256 + value.nbytes for value in values.values())
            if size > _MOST_MEMORY:
                raise InputError(f"{self.source} has too many numbers: {_MOST_MEMORY} bytes of memory may be used.")
        for of_topic in records.values():
            of_topic.sort(key=lambda record: record[0]["log"])
        all_stamps = {topic: [stamps for stamps, _ in of_topic] for topic, of_topic in records.items()}
        chosen = ("header" if _plausible(all_stamps) else "log") if clock.stamp == "auto" else clock.stamp
        times = {topic: [stamps[chosen] for stamps in of_topic] for topic, of_topic in all_stamps.items()}
        for topic, of in times.items():
            if None in of:
                raise InputError(
                    f"{self.source}, message {of.index(None)} of {topic}: it has no header.stamp or timestamp."
                )
        origin = min((min(of) for of in times.values() if of), default=0)
        signals = {}
        for field, (topic, _) in split.items():
            if not times[topic]:
                raise InputError(f"{self.source} has no message with the field {field!r}.")
            column = [values[field] for _, values in records[topic]]
            row = next((row for row, value in enumerate(column) if len(value) != len(column[0])), None)
            if row is not None:
                raise InputError(
                    f"{self.source}, message {row} of {field}: it must have {len(column[0])} numbers, got "
                    f"{len(column[row])}."
                )
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
            raise InputError(
                f"{self.source}, message {number} of {message.topic}: {name} must be a number or a list of numbers, "
                f"got {shown}."
            ) from None


def _header(content: Any) -> int | None:
    """Return the ``header.stamp`` or the ``timestamp`` in a message, nanoseconds; None if there is none."""
    stamp = _first(content, ("header", "stamp"), ("timestamp",))
    whole, part = _first(stamp, ("sec",), ("seconds",)), _first(stamp, ("nanosec",), ("nsec",), ("nanos",))
    return None if whole is None or part is None else int(whole) * 10**9 + int(part)


def _plausible(stamps: Mapping[str, Sequence[Mapping[str, Any]]]) -> bool:
    """Return whether all messages have stamps that increase on each topic and agree with the log times up to 1 s.

    The stamps may be those of another clock, such as that of a simulator, if it is the same one for all topics.
    """
    late = list[int]()
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
            case _, Mapping():
                content = content.get(step)
            case _:
                # Only fields that the message's class declares: attributes of Python are not data.
                content = getattr(content, step, None) if step in getattr(type(content), "__slots__", ()) else None
    return content


def _first(content: Any, *paths: Sequence[str | int]) -> Any:
    return next((value for path in paths if (value := _resolved(content, path)) is not None), None)


def _leaves(content: Any, before: str = "", depth: int = 6) -> Iterator[str]:
    parts: Iterable[tuple[str, Any]] = ()
    match content:
        case int() | float() | np.number():
            yield before
        case str() | bytes():
            return
        case Mapping():
            parts = ((f"{before}.{name}", part) for name, part in content.items())
        case list() | tuple() | np.ndarray():
            parts = ((f"{before}[{index}]", part) for index, part in enumerate(content[:16]))
        case _:
            names = getattr(type(content), "__slots__", ())
            parts = ((f"{before}.{name}", getattr(content, name)) for name in names)
    for path, part in parts if depth else ():
        yield from _leaves(part, path.removeprefix("."), depth - 1)
