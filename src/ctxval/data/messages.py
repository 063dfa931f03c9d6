"""Logs of messages: MCAP files and bags of ROS 1 and 2. Needs the extra ``logs``, and no ROS."""

from __future__ import annotations

import bz2
import io
import itertools
import json
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from ctxval._util.extras import require_extra
from ctxval._util.files import open_regular
from ctxval._util.texts import quoted, reason_of
from ctxval.data.decoders import Decoder, protobuf_decoder, ros1_decoder, ros2_decoder
from ctxval.data.topics import Message, TopicLog
from ctxval.errors import InputError

_MOST_CHUNK = 128 * 2**20  # largest size of a record, and of a chunk of records after it is decompressed, in bytes

_PURPOSE = "logs of messages"


class _FileOfMessages(TopicLog):
    """A log of messages in a file or a folder; each of its channels has a decoder."""

    def __init__(self, path: Path) -> None:
        self.source, self._path = str(path), path
        self._topics: dict[str, Any] = {}
        self._decoders: dict[Any, Decoder] = {}

    def topics(self) -> tuple[str, ...]:
        """Return the names of the topics."""
        return tuple(self._topics)

    def _decoded(self, channel: Any, decoder: Callable[[], Decoder], data: bytes, message: str) -> Any:
        if channel not in self._decoders:
            self._decoders[channel] = decoder()
        try:
            return self._decoders[channel](data)
        except Exception as error:  # decoders raise many kinds
            why = quoted(reason_of(error))
            raise InputError(f"{self.source}, message {message}: it cannot be decoded ({why}).") from error


class McapLog(_FileOfMessages):
    """An MCAP file with messages in JSON, in protobuf or of ROS 1 and 2."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with self._opened() as file, _damage(path, "an MCAP file"):
            file.seek(-(8 + 29), io.SEEK_END)  # the footer and the magic bytes, https://mcap.dev/spec
            summary = next(self._records(file)).summary_start  # 0 if there is none
            file.seek(summary)
            for record in self._records(file):
                if type(record).__name__ == "Channel":
                    self._topics[record.topic] = None
                if len(self._topics) > 10_000:
                    raise InputError(f"{path} has more than 10000 topics.")

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
                        decoder = partial(self._decoder, schemas.get(channel.schema_id), channel)
                        message = f"{record.sequence} of {channel.topic}"
                        content = self._decoded(channel.id, decoder, record.data, message)
                        yield Message(channel.topic, record.log_time, record.publish_time, content)
                    case "NoneType":
                        return

    def _decoder(self, schema: Any, channel: Any) -> Decoder:
        match channel.message_encoding, getattr(schema, "encoding", None):
            case "json", _:
                return lambda data: json.loads(data, object_pairs_hook=_distinct)
            case "cdr", "ros2msg":
                return ros2_decoder(self.source, channel.topic, schema.name, schema.data.decode("utf-8", "replace"))
            case "ros1", "ros1msg":
                return ros1_decoder(self.source, channel.topic, schema.name, schema.data.decode("utf-8", "replace"))
            case "protobuf", "protobuf":
                return protobuf_decoder(self.source, channel.topic, schema)
        of = f" with a schema in {schema.encoding}" if schema is not None else ""
        raise InputError(
            f"{self.source}: the messages of {channel.topic} are in {channel.message_encoding}{of}; messages in json, "
            "in protobuf, in cdr with ros2msg and in ros1 with ros1msg can be read."
        )


class BagLog(_FileOfMessages):
    """A bag: one of ROS 2, a folder with ``metadata.yaml`` or one of its ``.db3`` files, or one of ROS 1, ``.bag``."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with self._reader() as reader:
            self._topics = {connection.topic: connection for connection in reader.connections}

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

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Yield decoded messages; see :meth:`TopicLog.messages`."""
        wanted = set(topics)
        with self._reader() as reader:
            records = reader.messages([connection for connection in reader.connections if connection.topic in wanted])
            for number in itertools.count():
                with _damage(self._path, self._kind):
                    record = next(records, None)
                if record is None:
                    return
                connection, time, raw = record
                message, decoder = f"{number}, of {connection.topic}", partial(self._decoder, connection)
                yield Message(connection.topic, time, time, self._decoded(connection.topic, decoder, raw, message))

    def _decoder(self, connection: Any) -> Decoder:
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
