"""Logs of messages: MCAP files and bags of ROS 1 and 2. Needs the extra ``logs``, and no ROS.

Messages of ROS 2 are decoded by mcap-ros2-support, also those of bags: its decoder interprets the message definitions
in a file, whereas that of rosbags compiles Python code from them. Those of ROS 1 are decoded in the same way by
``ros1.py``.
"""

from __future__ import annotations

import bz2
import io
import json
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from functools import partial
from pathlib import Path
from typing import Any

from ctxval._util.extras import require_extra
from ctxval._util.files import open_regular
from ctxval._util.texts import quoted, reason_of
from ctxval.data.log import Log
from ctxval.data.protobuf import protobuf_decoder
from ctxval.data.ros1 import ros1_decoder
from ctxval.data.topics import Message, TopicLog
from ctxval.errors import InputError

_MOST_CHUNK = 128 * 2**20  # largest size of a record, and of a chunk of records after it is decompressed, in bytes

_MOST_TOPICS = 10_000

_PURPOSE = "logs of messages"


class McapLog(TopicLog):
    """An MCAP file with messages in JSON, in protobuf or of ROS 1 and 2.

    Args:
        path: the file.

    Raises:
        InputError: if the file is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.source, self._path = str(path), path
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        with self._opened() as file, _damage(path, "an MCAP file"):
            file.seek(-(8 + 29), io.SEEK_END)  # the footer and the magic bytes, https://mcap.dev/spec
            summary = next(self._records(file)).summary_start  # 0 if there is none
            file.seek(summary)
            self._topics = dict[str, None]()
            for record in self._records(file):
                if type(record).__name__ == "Channel":
                    self._topics[record.topic] = None
                if len(self._topics) > _MOST_TOPICS:
                    raise InputError(f"{path} has more than {_MOST_TOPICS} topics.")

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        try:
            file = open_regular(self._path, 64 * 2**30)  # it is read message by message
        except InputError as error:
            raise InputError(f"{self._path} cannot be read: {error}.") from error
        with file:
            yield file

    def _records(self, file: Any) -> Iterator[Any]:
        """Yield the records from a place in the file on, and those within chunks, whose sizes are limited."""
        library = require_extra("mcap.stream_reader", "logs", _PURPOSE)
        ended = require_extra("mcap.exceptions", "logs", _PURPOSE).EndOfFile
        inside = {"skip_magic": file.tell() > 0, "emit_chunks": True, "record_size_limit": _MOST_CHUNK}
        for record in library.StreamReader(file, **inside).records:
            if type(record).__name__ != "Chunk":
                yield record
                continue
            chunk = io.BytesIO(_decompressed(record.compression, record.data))
            if record.uncompressed_crc not in (0, zlib.crc32(chunk.getbuffer())):
                raise ValueError("a chunk has another checksum")
            with suppress(ended):  # a chunk has no record that says where it ends
                yield from library.StreamReader(chunk, **{**inside, "skip_magic": True}).records

    def topics(self) -> tuple[str, ...]:
        """Return the names of the topics."""
        return tuple(self._topics)

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Yield decoded messages; see :meth:`TopicLog.messages`."""
        wanted = set(topics)
        schemas, channels = dict[int, Any](), dict[int, Any]()
        with self._opened() as file:
            records = self._records(file)
            while True:
                with _damage(self._path, "an MCAP file"):
                    record: Any = next(records, None)
                match type(record).__name__:
                    case "Schema":
                        schemas[record.id] = record
                    case "Channel":
                        channels[record.id] = record
                    case "Message" if (channel := channels.get(record.channel_id)) and channel.topic in wanted:
                        content = self._decoded(schemas.get(channel.schema_id), channel, record)
                        yield Message(channel.topic, record.log_time, record.publish_time, content)
                    case "NoneType":
                        return

    def _decoded(self, schema: Any, channel: Any, raw: Any) -> Any:
        decoder = self._decoders.get(channel.id)
        if decoder is None:
            decoder = self._decoders[channel.id] = self._decoder(schema, channel)
        try:
            return decoder(raw.data)
        except Exception as error:  # decoders raise many kinds
            raise InputError(
                f"{self.source}, message {raw.sequence} of {channel.topic}: it cannot be decoded "
                f"({quoted(reason_of(error))})."
            ) from error

    def _decoder(self, schema: Any, channel: Any) -> Callable[[bytes], Any]:
        if channel.message_encoding == "json":
            return lambda data: json.loads(data, object_pairs_hook=_distinct)
        if channel.message_encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
            return ros2_decoder(self.source, channel.topic, schema.name, schema.data.decode("utf-8", "replace"))
        if channel.message_encoding == "ros1" and schema is not None and schema.encoding == "ros1msg":
            return ros1_decoder(self.source, channel.topic, schema.name, schema.data.decode("utf-8", "replace"))
        if channel.message_encoding == "protobuf" and schema is not None and schema.encoding == "protobuf":
            return protobuf_decoder(self.source, channel.topic, schema)
        of = f" with a schema in {schema.encoding}" if schema is not None else ""
        raise InputError(
            f"{self.source}: the messages of {channel.topic} are in {channel.message_encoding}{of}; messages in json, "
            "in protobuf, in cdr with ros2msg and in ros1 with ros1msg can be read."
        )


class BagLog(TopicLog):
    """A bag: one of ROS 2, a folder with ``metadata.yaml`` or one of its ``.db3`` files, or one of ROS 1, ``.bag``.

    Args:
        path: the folder or the file.

    Raises:
        InputError: if it is not a bag.
    """

    def __init__(self, path: Path) -> None:
        self.source, self._path = str(path), path
        self._decoders: dict[str, Callable[[bytes], Any]] = {}
        with self._reader() as reader:
            self._topics = {one.topic: one for one in reader.connections}

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        version = 1 if self._path.suffix.lower() == ".bag" and self._path.is_file() else 2
        self._kind = f"a bag of ROS {version}"
        library = require_extra(f"rosbags.rosbag{version}", "logs", _PURPOSE)
        with _damage(self._path, self._kind):
            reader = library.Reader(self._path)
            reader.open()
            for place, chunk in getattr(reader, "chunks", {}).items():  # of a bag of ROS 1
                kind = next((name for name in ("bz2", "lz4") if name in chunk.decompressor.__module__), "")
                reader.chunks[place] = chunk._replace(decompressor=partial(_decompressed, kind))
        try:
            yield reader
        finally:
            reader.close()

    def topics(self) -> tuple[str, ...]:
        """Return the names of the topics."""
        return tuple(self._topics)

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Yield decoded messages; see :meth:`TopicLog.messages`."""
        wanted = set(topics)
        with self._reader() as reader:
            found = reader.messages([one for one in reader.connections if one.topic in wanted])
            number = 0
            while True:
                with _damage(self._path, self._kind):
                    one = next(found, None)
                if one is None:
                    return
                connection, time, raw = one
                yield Message(connection.topic, time, time, self._decoded(connection, raw, number))
                number += 1

    def _decoded(self, connection: Any, raw: bytes, number: int) -> Any:
        decoder = self._decoders.get(connection.topic)
        if decoder is None:
            decoder = self._decoders[connection.topic] = self._decoder(connection)
        try:
            return decoder(raw)
        except Exception as error:
            raise InputError(
                f"{self.source}, message {number}, of {connection.topic}: it cannot be decoded "
                f"({quoted(reason_of(error))})."
            ) from error

    def _decoder(self, connection: Any) -> Callable[[bytes], Any]:
        definition = connection.msgdef
        if self._kind.endswith("1"):
            return ros1_decoder(self.source, connection.topic, connection.msgtype, definition.data)
        if definition.format.name == "MSG":
            return ros2_decoder(self.source, connection.topic, connection.msgtype, definition.data)
        # Bags before ROS 2 Iron do not hold the definitions of their messages.
        typesys = require_extra("rosbags.typesys", "logs", _PURPOSE)
        try:
            known = typesys.get_typestore(typesys.Stores.LATEST)
            text, _ = known.generate_msgdef(connection.msgtype, ros_version=2)
        except Exception as error:
            raise InputError(
                f"{self.source}: the definition of the messages of {connection.topic}, {connection.msgtype}, is not in "
                "the bag, and is not one of ROS 2 itself."
            ) from error
        return ros2_decoder(self.source, connection.topic, connection.msgtype, text)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise ValueError("a name is there twice")
    return content


def ros2_decoder(source: str, topic: str, name: str, definition: str) -> Callable[[bytes], Any]:
    """Return the decoder of ROS 2 messages with a definition."""
    decoding = require_extra("mcap_ros2.decoder", "logs", _PURPOSE)
    records = require_extra("mcap.records", "logs", _PURPOSE)
    schema = records.Schema(id=1, name=name, encoding="ros2msg", data=definition.encode())
    try:
        with redirect_stderr(io.StringIO()):  # the parser prints the text of the file
            decoder: Callable[[bytes], Any] | None = decoding.DecoderFactory().decoder_for("cdr", schema)
        if decoder is None:
            raise ValueError(name)
        return decoder
    except Exception as error:
        raise InputError(f"{source}: the definition of the messages of {topic}, {name}, cannot be read.") from error


def read_mcap(path: Path) -> list[Log]:
    """Return the log in an MCAP file."""
    return [McapLog(path)]


def read_bag(path: Path) -> list[Log]:
    """Return the log in a bag of ROS 1 or 2."""
    return [BagLog(path)]


def _decompressed(kind: str, data: bytes) -> bytes:
    """Return the content of a chunk, of which no more is decompressed than may be read.

    The sizes that a file declares may be wrong, and libraries believe them or those in the compressed data.
    """
    match kind:
        case "zstd":
            zstandard = require_extra("zstandard", "logs", _PURPOSE)
            content = zstandard.ZstdDecompressor().stream_reader(data).read(_MOST_CHUNK + 1)
        case "lz4":
            frame = require_extra("lz4.frame", "logs", _PURPOSE)
            content = frame.LZ4FrameDecompressor().decompress(data, max_length=_MOST_CHUNK + 1)
        case "bz2":
            content = bz2.BZ2Decompressor().decompress(data, max_length=_MOST_CHUNK + 1)
        case "":
            content = data
        case _:
            raise ValueError(f"the compression {kind}")
    if len(content) > _MOST_CHUNK:
        raise ValueError(f"a chunk has more than {_MOST_CHUNK} bytes")
    return bytes(content)


@contextmanager
def _damage(path: Path, kind: str) -> Iterator[None]:
    """Turn the many exceptions for damaged files into one."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path} cannot be read as {kind} ({quoted(reason_of(error))}).") from error
