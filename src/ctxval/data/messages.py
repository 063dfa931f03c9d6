"""Logs of messages: MCAP files and bags of ROS 1 and 2. Needs the extra ``logs``, and no ROS.

The definitions of messages in a file are interpreted; nothing in it is ever run. The decoders of genpy and rosbags
compile Python code from these definitions, so rosbags only parses them here. Messages of ROS 1 are numbers without
padding; strings and lists begin with their length as a uint32 (http://wiki.ros.org/msg). Those of ROS 2, in CDR, begin
with four bytes, numbers are aligned to their size, and strings end with a NUL byte (OMG, DDS-XTypes 1.3, section 7.4).
"""

from __future__ import annotations

import bz2
import io
import json
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import open_regular
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.texts import quoted, reason_of
from ctxval.data.log import Message, TopicLog, reading
from ctxval.errors import InputError

Decoder = Callable[[bytes], Any]  #: A function that decodes the bytes of one message

Definition = tuple[Callable[[str, bytes], Decoder], str, bytes]
"""A function that makes a decoder, and its arguments: the name of a type of messages, and the text that defines it."""


_library = partial(require_extra, extra="logs", needs="logs of messages need")


class _FileOfMessages(TopicLog):
    """A log of messages in a file or a folder; each of its channels has a decoder."""

    _kind = "an MCAP file"

    def __init__(self, path: Path) -> None:
        self.source, self._path = str(path), path
        self._topics: dict[str, Any] = {}
        self._decoders: dict[Any, Decoder] = {}

    def topics(self) -> tuple[str, ...]:
        return tuple(self._topics)

    def _read(self, records: Iterator[Any]) -> Iterator[Any]:
        while True:
            with reading(self._path, self._kind):
                record = next(records, None)
            if record is None:
                return
            yield record

    def _decoded(
        self, channel: Any, topic: str, data: bytes, message: str, definition: Callable[[], Definition]
    ) -> Any:
        if channel not in self._decoders:
            make, name, text = definition()
            with reworded(f"{self.source}: the definition of the messages of {topic}, {name}, cannot be read"):
                self._decoders[channel] = make(name, text)
        try:
            return self._decoders[channel](data)
        except Exception as error:  # decoders raise many kinds
            why = f"it cannot be decoded ({quoted(reason_of(error))})"
            raise InputError(f"{self.source}, message {message}: {why}.") from error


class McapLog(_FileOfMessages):
    """An MCAP file with messages in JSON or of ROS 1 and 2."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with self._opened() as file, reading(path, self._kind):
            file.seek(-(8 + 29), io.SEEK_END)  # the footer and the magic bytes, https://mcap.dev/spec
            summary = next(self._records(file)).summary_start  # 0 if there is none
            file.seek(summary)
            for record in self._records(file):
                if type(record).__name__ == "Channel":
                    self._topics[record.topic] = None
                if len(self._topics) > 10_000:
                    raise InputError("it has more than 10000 topics")

    def _opened(self) -> IO[bytes]:
        with reading(self._path):
            return open_regular(self._path, 64 * 2**30)  # it is read message by message

    def _records(self, file: Any) -> Iterator[Any]:
        """Yield the records from a place in the file on, and those within chunks, whose sizes are limited."""
        library, ended = _library("mcap.stream_reader"), _library("mcap.exceptions").EndOfFile
        inside = {"skip_magic": file.tell() > 0, "emit_chunks": True, "record_size_limit": self.limits.chunk}
        for record in library.StreamReader(file, **inside).records:
            if type(record).__name__ != "Chunk":
                yield record
                continue
            chunk = io.BytesIO(_decompressed(record.compression, self.limits.chunk, record.data))
            if record.uncompressed_crc not in (0, zlib.crc32(chunk.getbuffer())):
                raise ValueError("a chunk has another checksum")
            with suppress(ended):  # a chunk has no record that says where it ends
                yield from library.StreamReader(chunk, **{**inside, "skip_magic": True}).records

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        wanted = set(topics)
        schemas, channels = dict[int, Any](), dict[int, Any]()
        with self._opened() as file:
            for record in self._read(self._records(file)):
                match type(record).__name__:
                    case "Schema":
                        schemas[record.id] = record
                    case "Channel":
                        channels[record.id] = record
                    case "Message" if (channel := channels.get(record.channel_id)) and channel.topic in wanted:
                        definition = partial(self._definition, schemas.get(channel.schema_id), channel)
                        message = f"{record.sequence} of {channel.topic}"
                        content = self._decoded(channel.id, channel.topic, record.data, message, definition)
                        yield Message(channel.topic, record.log_time, record.publish_time, content)

    def _definition(self, schema: Any, channel: Any) -> Definition:
        match channel.message_encoding, getattr(schema, "encoding", None):
            case "json", _:
                return json_decoder, "", b""
            case ("cdr", "ros2msg") | ("ros1", "ros1msg") as kinds:
                return partial(ros_decoder, aligned=kinds[0] == "cdr"), schema.name, schema.data
        of = channel.message_encoding + ("" if schema is None else f" with a schema in {schema.encoding}")
        known = "messages in json, in cdr with ros2msg and in ros1 with ros1msg can be read"
        raise InputError(f"{self.source}: the messages of {channel.topic} are in {of}; {known}.")


class BagLog(_FileOfMessages):
    """A bag: one of ROS 2, a folder with ``metadata.yaml`` or one of its ``.db3`` files, or one of ROS 1, ``.bag``."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._version = 1 if path.suffix.lower() == ".bag" and path.is_file() else 2
        self._kind = f"a bag of ROS {self._version}"
        with self._reader() as reader:
            self._topics = {connection.topic: connection for connection in reader.connections}

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        with reading(self._path, self._kind):
            reader = _library(f"rosbags.rosbag{self._version}").Reader(self._path)
            reader.open()
            for place, chunk in getattr(reader, "chunks", {}).items():  # of a bag of ROS 1
                kind = next((name for name in ("bz2", "lz4") if name in chunk.decompressor.__module__), "")
                reader.chunks[place] = chunk._replace(decompressor=partial(_decompressed, kind, self.limits.chunk))
        try:
            yield reader
        finally:
            reader.close()

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        wanted = set(topics)
        with self._reader() as reader:
            records = reader.messages([connection for connection in reader.connections if connection.topic in wanted])
            for number, (connection, time, raw) in enumerate(self._read(records)):
                topic, definition = connection.topic, partial(self._definition, connection)
                content = self._decoded(topic, topic, raw, f"{number}, of {topic}", definition)
                yield Message(topic, time, time, content)

    def _definition(self, connection: Any) -> Definition:
        definition, text = connection.msgdef, connection.msgdef.data
        if self._version == 2 and definition.format.name != "MSG":
            # Bags before ROS 2 Iron do not hold the definitions of their messages.
            typesys = _library("rosbags.typesys")
            what = f"the definition of the messages of {connection.topic}, {connection.msgtype}"
            with reworded(f"{self.source}: {what}, is not in the bag, and is not one of ROS 2 itself"):
                known = typesys.get_typestore(typesys.Stores.LATEST)
                text, _ = known.generate_msgdef(connection.msgtype, ros_version=2)
        return partial(ros_decoder, aligned=self._version == 2), connection.msgtype, text.encode()


def _decompressed(kind: str, most: int, data: bytes) -> bytes:
    """Return the content of a chunk of at most so many bytes: the sizes that a file declares may be wrong."""
    match kind:
        case "zstd":
            content = _library("zstandard").ZstdDecompressor().stream_reader(data).read(most + 1)
        case "lz4":
            content = _library("lz4.frame").LZ4FrameDecompressor().decompress(data, max_length=most + 1)
        case "bz2":
            content = bz2.BZ2Decompressor().decompress(data, max_length=most + 1)
        case "":
            content = data
        case _:
            raise ValueError(f"the compression {kind}")
    if len(content) > most:
        raise ValueError(f"a chunk has more than {most} bytes")
    return bytes(content)


# Decoders


def json_decoder(name: str, definition: bytes) -> Decoder:
    """Return the decoder of messages in JSON, which need no definition."""

    def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) != len(pairs):
            raise ValueError("a name is there twice")
        return content

    return lambda data: json.loads(data, object_pairs_hook=distinct)


# The format of each type of numbers.
_NUMBERS = {
    **{"bool": "?", "byte": "i1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1", "int16": "i2"},
    **{"uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}


def ros_decoder(name: str, definition: bytes, *, aligned: bool) -> Decoder:
    """Return the decoder of messages of ROS 1, or of ROS 2 in CDR, which are ``aligned``."""
    parse = _library("rosbags.typesys").get_types_from_msg
    parsed = parse(definition.decode("utf-8", "replace"), name)
    # The types that ROS 1 calls time and duration, by the names that rosbags gives them.
    for of, kind in (("Time", "uint32"), ("Duration", "int32")):
        parsed = {**parse(f"{kind} sec\n{kind} nanosec", f"builtin_interfaces/msg/{of}"), **parsed}
    fields = {of: [(field, kind[0].name, kind[1]) for field, kind in kinds] for of, (_, kinds) in parsed.items()}
    root = name if name in fields else name.replace("/", "/msg/", 1)
    first = 4 if aligned else 0

    def decode(data: bytes) -> Any:
        place, order = first, ">" if aligned and data[1:2] == b"\0" else "<"

        def numbers(kind: str, count: int) -> Array:
            nonlocal place
            format_ = np.dtype(order + _NUMBERS[kind])
            if aligned and count:
                place += (first - place) % format_.itemsize
            start, place = place, place + count * format_.itemsize
            if place > len(data):
                raise ValueError("the message is shorter than its definition")
            return np.frombuffer(data[start:place], dtype=format_).astype(_NUMBERS[kind], copy=False)

        def length() -> int:
            return int(numbers("uint32", 1)[0])

        def value(form: str, inner: Any, depth: int) -> Any:
            match form:
                case "NAME" if depth > 32:
                    raise ValueError(f"{inner} is nested too deeply")
                case "NAME":
                    return {field: value(of, kind, depth + 1) for field, of, kind in fields[inner]}
                case "BASE" if inner[0] == "string":
                    text = numbers("uint8", length()).tobytes()
                    return text.removesuffix(b"\0" if aligned else b"").decode("utf-8", "replace")
                case "BASE":
                    return numbers(inner[0], 1).item()
            (of, element), count = inner[0], inner[1] if form == "ARRAY" else length()
            if of.name == "BASE" and element[0] != "string":
                return numbers(element[0], count)
            if count > len(data):
                raise ValueError(f"a list of {count} elements is longer than its message")
            return [value(of.name, element, depth + 1) for _ in range(count)]

        return value("NAME", root, 0)

    return decode
