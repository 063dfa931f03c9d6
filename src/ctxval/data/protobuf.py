"""Messages in protobuf, with the schema that an MCAP file holds. Needs mcap-protobuf-support (extra ``logs``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ctxval._util.extras import require_extra
from ctxval.errors import InputError


def protobuf_decoder(source: str, topic: str, schema: Any) -> Callable[[bytes], dict[str, Any]]:
    """Return the decoder of messages in protobuf; its messages are plain dictionaries."""
    decoding = require_extra("mcap_protobuf.decoder", "logs", "logs of messages in protobuf")
    try:
        decode = decoding.DecoderFactory().decoder_for("protobuf", schema)
    except Exception as error:  # the schema of a file may be anything
        raise InputError(
            f"{source}: the definition of the messages of {topic}, {schema.name}, cannot be read."
        ) from error
    return lambda data: _fields(decode(data))


def _fields(message: Any) -> dict[str, Any]:
    """Return the fields of a message; those that it does not have are left out."""
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
