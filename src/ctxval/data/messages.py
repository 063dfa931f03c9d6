"""Logs of messages: MCAP files and bags of ROS 1 and 2. Needs the extra ``logs``, and no ROS.

Messages of ROS 2 are decoded by mcap-ros2-support, also those of bags: its decoder interprets the message definitions
in a file, whereas that of rosbags compiles Python code from them. Those of ROS 1 are decoded in the same way by
``ros1.py``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ctxval._util.extras import require_extra
from ctxval._util.files import open_regular
from ctxval.data.log import Log, Message, TopicLog
from ctxval.data.protobuf import protobuf_decoder
from ctxval.data.ros1 import ros1_decoder
from ctxval.errors import InputError

_MOST_FILE = 64 * 2**30
"""Largest size of a file in bytes. It is read message by message."""

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
        with self._reader() as reader, _damage(path, "an MCAP file"):
            summary = reader.get_summary()
            self._topics = {} if summary is None else {one.topic: one for one in summary.channels.values()}
            if summary is None:
                self._topics = {channel.topic: channel for _, channel, _ in reader.iter_messages()}

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        library = require_extra("mcap.reader", "logs", _PURPOSE)
        try:
            file = open_regular(self._path, _MOST_FILE)
        except InputError as error:
            raise InputError(f"{self._path} cannot be read: {error}.") from error
        with file:
            with _damage(self._path, "an MCAP file"):
                reader = library.make_reader(file)
            yield reader

    def topics(self) -> tuple[str, ...]:
        """Return the names of the topics."""
        return tuple(self._topics)

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Yield decoded messages; see :meth:`TopicLog.messages`."""
        with self._reader() as reader:
            found = reader.iter_messages(topics=list(topics))
            while True:
                with _damage(self._path, "an MCAP file"):
                    one = next(found, None)
                if one is None:
                    return
                schema, channel, raw = one
                yield Message(channel.topic, raw.log_time, raw.publish_time, self._decoded(schema, channel, raw))

    def _decoded(self, schema: Any, channel: Any, raw: Any) -> Any:
        decoder = self._decoders.get(channel.id)
        if decoder is None:
            decoder = self._decoders[channel.id] = self._decoder(schema, channel)
        try:
            return decoder(raw.data)
        except Exception as error:  # decoders raise many kinds
            raise InputError(
                f"{self.source}, message {raw.sequence} of {channel.topic}: it cannot be decoded "
                f"({type(error).__name__}: {str(error)[:100]})."
            ) from error

    def _decoder(self, schema: Any, channel: Any) -> Callable[[bytes], Any]:
        if channel.message_encoding == "json":
            return json.loads
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
                f"({type(error).__name__}: {str(error)[:100]})."
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


def ros2_decoder(source: str, topic: str, name: str, definition: str) -> Callable[[bytes], Any]:
    """Return the decoder of ROS 2 messages with a definition.

    Raises:
        InputError: if the definition cannot be read.
    """
    decoding = require_extra("mcap_ros2.decoder", "logs", _PURPOSE)
    records = require_extra("mcap.records", "logs", _PURPOSE)
    schema = records.Schema(id=1, name=name, encoding="ros2msg", data=definition.encode())
    try:
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


@contextmanager
def _damage(path: Path, kind: str) -> Iterator[None]:
    """Turn the many exceptions for damaged files into one."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as {kind} ({type(error).__name__}: {str(error)[:100].partition(chr(10))[0]})."
        ) from error
