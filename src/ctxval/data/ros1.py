"""Messages of ROS 1, decoded by interpreting their definitions.

The decoders of genpy and rosbags compile Python code from the definitions in a file. Here rosbags only parses them, so
that nothing in a file is ever run. The format: little-endian numbers without padding; strings and lists begin with
their length as a uint32 (http://wiki.ros.org/msg).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ctxval._util.extras import require_extra
from ctxval.errors import InputError

# The format of each type of numbers.
_NUMBERS = {
    **{"bool": "?", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "<h", "uint16": "<H"},
    **{"int32": "<i", "uint32": "<I", "int64": "<q", "uint64": "<Q", "float32": "<f", "float64": "<d", "octet": "B"},
}

# The types that ROS 1 calls time and duration, by the names that rosbags gives them.
_TIMES = {
    "builtin_interfaces/msg/Time": [("sec", "uint32"), ("nanosec", "uint32")],
    "builtin_interfaces/msg/Duration": [("sec", "int32"), ("nanosec", "int32")],
}


def ros1_decoder(source: str, topic: str, name: str, definition: str) -> Callable[[bytes], Any]:
    """Return the decoder of ROS 1 messages with a definition."""
    typesys = require_extra("rosbags.typesys", "logs", "logs of messages")
    try:
        parsed = typesys.get_types_from_msg(definition, name)
        types = {one: [(field, _plain_type(kind)) for field, kind in fields] for one, (_, fields) in parsed.items()}
    except Exception as error:  # the parser raises many kinds
        raise InputError(f"{source}: the definition of the messages of {topic}, {name}, cannot be read.") from error
    for one, fields in _TIMES.items():
        types.setdefault(one, [(field, ("number", _NUMBERS[kind])) for field, kind in fields])
    root = name if name in types else name.replace("/", "/msg/", 1)
    return lambda data: _Message(types, data).record(root, 0)


def _plain_type(kind: Any) -> tuple[str, Any]:
    """Return a parsed type as ``number``, ``string``, ``record``, or ``list`` with its elements and their count."""
    form, inner = kind[0].name, kind[1]
    if form == "BASE":
        return ("string", None) if inner[0] == "string" else ("number", _NUMBERS[inner[0]])
    if form == "NAME":
        return "record", inner
    return "list", (_plain_type(inner[0]), inner[1] if form == "ARRAY" else None)


class _Message:
    """The bytes of one message, read from the front.

    Args:
        types: the fields of each type, with their types.
        data: the bytes.
    """

    def __init__(self, types: Mapping[str, list[tuple[str, tuple[str, Any]]]], data: bytes) -> None:
        self.types, self.data, self.place = types, data, 0

    def record(self, name: str, depth: int) -> dict[str, Any]:
        if depth > 32:
            raise ValueError(f"{name} is nested too deeply")
        return {field: self.value(kind, depth + 1) for field, kind in self.types[name]}

    def value(self, kind: tuple[str, Any], depth: int) -> Any:
        form, inner = kind
        if form == "number":
            return struct.unpack(inner, self.taken(struct.calcsize(inner)))[0]
        if form == "string":
            return self.taken(self.length()).decode("utf-8", "replace")
        if form == "record":
            return self.record(inner, depth)
        element, count = inner
        return self.several(element, self.length() if count is None else count, depth)

    def several(self, element: tuple[str, Any], count: int, depth: int) -> Any:
        if element[0] == "number":
            whole = self.taken(count * struct.calcsize(element[1]))
            return np.frombuffer(whole, dtype=np.dtype(element[1]))
        if count > len(self.data):
            raise ValueError(f"a list of {count} elements is longer than its message")
        return [self.value(element, depth) for _ in range(count)]

    def length(self) -> int:
        return int(struct.unpack("<I", self.taken(4))[0])

    def taken(self, count: int) -> bytes:
        part = self.data[self.place : self.place + count]
        if len(part) != count:
            raise ValueError("the message is shorter than its definition")
        self.place += count
        return part
