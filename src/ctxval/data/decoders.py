"""Decoders of messages, which interpret the definitions in a file; nothing in it is ever run. Needs the extra ``logs``.

The decoders of genpy and rosbags compile Python code from the definitions in a file. For ROS 1, rosbags only parses
them here. Its format: little-endian numbers without padding; strings and lists begin with their length as a uint32
(http://wiki.ros.org/msg). Messages of ROS 2 are decoded by mcap-ros2-support, and protobuf by mcap-protobuf-support.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr
from typing import Any

import numpy as np

from ctxval._util.extras import require_extra
from ctxval.errors import InputError

Decoder = Callable[[bytes], Any]
"""A function that decodes the bytes of one message."""


def ros2_decoder(source: str, topic: str, name: str, definition: str) -> Decoder:
    """Return the decoder of ROS 2 messages with a definition."""
    decoding = require_extra("mcap_ros2.decoder", "logs", "logs of messages")
    records = require_extra("mcap.records", "logs", "logs of messages")
    schema = records.Schema(id=1, name=name, encoding="ros2msg", data=definition.encode())
    try:
        with redirect_stderr(io.StringIO()):  # the parser prints the text of the file
            decoder: Decoder | None = decoding.DecoderFactory().decoder_for("cdr", schema)
        if decoder is None:
            raise ValueError(name)
        return decoder
    except Exception as error:
        raise InputError(f"{source}: the definition of the messages of {topic}, {name}, cannot be read.") from error


# Protobuf


def protobuf_decoder(source: str, topic: str, schema: Any) -> Decoder:
    """Return the decoder of messages in protobuf with the schema of an MCAP file, as plain dictionaries."""
    decoding = require_extra("mcap_protobuf.decoder", "logs", "logs of messages in protobuf")
    try:
        decode = decoding.DecoderFactory().decoder_for("protobuf", schema)
    except Exception as error:  # the schema of a file may be anything
        raise InputError(
            f"{source}: the definition of the messages of {topic}, {schema.name}, cannot be read."
        ) from error
    return lambda data: _fields(decode(data))


def _fields(message: Any) -> dict[str, Any]:
    return {
        field.name: _plain(getattr(message, field.name))
        for field in message.DESCRIPTOR.fields
        if not field.has_presence or message.HasField(field.name)
    }


def _plain(value: Any) -> Any:
    if hasattr(value, "DESCRIPTOR"):
        return _fields(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, bool | int | float | str | bytes):
        return value
    return [_plain(item) for item in value]


# ROS 1

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


def ros1_decoder(source: str, topic: str, name: str, definition: str) -> Decoder:
    """Return the decoder of ROS 1 messages with a definition."""
    typesys = require_extra("rosbags.typesys", "logs", "logs of messages")
    try:
        parsed = typesys.get_types_from_msg(definition, name)
        types = {of: [(field, _plain_type(kind)) for field, kind in fields] for of, (_, fields) in parsed.items()}
    except Exception as error:  # the parser raises many kinds
        raise InputError(f"{source}: the definition of the messages of {topic}, {name}, cannot be read.") from error
    for of, fields in _TIMES.items():
        types.setdefault(of, [(field, ("number", _NUMBERS[kind])) for field, kind in fields])
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
    """The bytes of one message, read from the front, with the fields of each type."""

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
        count = self.length() if count is None else count
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
