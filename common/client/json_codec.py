"""The codec `msgpack` of zenoh-cli: decodes every topic to one line of text, encodes JSON to checked messages."""

from __future__ import annotations

import json

import msgpack
from pydantic import BaseModel

from common.config import check
from common.errors import ConfigError
from common.messages.schema import from_json, one_line

SHOWN_BYTES = 16  # of a payload that is not msgpack


def decode(key: str, value: bytes) -> str:
    """One line of JSON, a picture's description, or why the payload is neither; never raises."""
    if not value:
        return "<empty payload>"
    try:
        decoded = msgpack.unpackb(value, raw=False, strict_map_key=False)
    except Exception as error:  # noqa: BLE001 - a listener must outlive whatever somebody sends
        why = " ".join(str(error).split()) or type(error).__name__
        return f"<not msgpack: {len(value)} bytes {value[:SHOWN_BYTES].hex()}{_more(value)}: {why}>"
    if not isinstance(decoded, dict):
        # A byte or two of text is msgpack too; a message of ours is always a map.
        return f"<not a message: {type(decoded).__name__} {one_line(decoded)}>"
    return one_line(decoded)


def encode(key: str, value: str) -> bytes:
    """The message that a line of JSON says, checked against what the key carries.

    Raises:
        ConfigError: it is not JSON, or not the key's message; names the field and what would do.
    """
    try:
        given = from_json(json.loads(value))
    except (ValueError, RecursionError) as error:
        raise ConfigError(key, value, f"is not JSON: {error}") from None
    model = _model_of(key)
    if model is not None:
        if not isinstance(given, dict):
            raise ConfigError(key, value, f"must be a JSON object, a {model.__name__}")
        given = check(model, given, key).model_dump()
    try:
        packed: bytes = msgpack.packb(given, use_bin_type=True)
    except (ValueError, OverflowError) as error:
        raise ConfigError(key, value, f"cannot be sent: {error}") from None
    return packed


def _model_of(key: str) -> type[BaseModel] | None:
    """What the key carries, or None for a key that is not ours."""
    from common.application import find_topic

    topic = find_topic(str(key).partition("?")[0].partition("/")[2])
    return topic.message if topic else None


def _more(value: bytes) -> str:
    return "..." if len(value) > SHOWN_BYTES else ""
