"""Messages as JSON text: the codec `msgpack` of zenoh-cli, and messages that users type."""

from __future__ import annotations

import json
from typing import Any

import msgpack
from pydantic import BaseModel

from common.clock import Clock
from common.config import check
from common.errors import ConfigError
from common.messages import Header, Message
from common.messages.schema import from_json, one_line
from common.topics import AnyTopic, Topic

SHOWN_BYTES = 16  # of a payload that is not msgpack


def decode(key: str, value: bytes) -> str:
    """Return a payload as one line of JSON, an image as its description, or why it is neither; never raises."""
    if not value:
        return "<empty payload>"
    try:
        decoded = msgpack.unpackb(value, raw=False, strict_map_key=False)
    except Exception as error:  # noqa: BLE001 - a subscriber must survive any payload
        why = " ".join(str(error).split()) or type(error).__name__
        more = "..." if len(value) > SHOWN_BYTES else ""
        return f"<not msgpack: {len(value)} bytes {value[:SHOWN_BYTES].hex()}{more}: {why}>"
    if not isinstance(decoded, dict):
        # A byte or two of text is msgpack too; our messages are always maps.
        return f"<not a message: {type(decoded).__name__} {one_line(decoded)}>"
    return one_line(decoded)


def encode(key: str, value: str) -> bytes:
    """Return the payload of a line of JSON, checked against the message of its key (with the cell).

    Raises:
        ConfigError: it is not JSON, or not the key's message; names the field and the choices.
    """
    from common.application import find_topic

    topic = find_topic(str(key).partition("?")[0].partition("/")[2])
    given = _parsed(key, value)
    if topic is not None:
        if not isinstance(given, dict):
            raise ConfigError(key, value, f"must be a JSON object, a {topic.message.__name__}")
        given = check(topic.message, given, key).model_dump()
    return _packed(key, value, given)


def message_from_json(topic: AnyTopic | None, key: str, body: str) -> Any:
    """Return the message of a line of JSON, or for an unknown key the JSON itself.

    Raises:
        ConfigError: it is not JSON, or not the key's message; names the field and the choices.
    """
    given = _parsed(key, body)
    if topic is None:
        _packed(key, body, given)
        return given
    if not isinstance(given, dict):
        what = f", a {topic.message.__name__}" if isinstance(topic, Topic) else ""
        raise ConfigError(key, body, f"must be a JSON object{what}")
    if "header" in topic.message.model_fields:
        given.setdefault("header", {})
    return check(topic.message, given, key)


def _parsed(key: str, body: str) -> Any:
    try:
        return from_json(json.loads(body))
    except (ValueError, RecursionError) as error:
        raise ConfigError(key, body, f"is not JSON: {error}") from None


def _packed(key: str, body: str, given: Any) -> bytes:
    try:
        packed: bytes = msgpack.packb(given, use_bin_type=True)
    except (ValueError, OverflowError) as error:
        raise ConfigError(key, body, f"cannot be sent: {error}") from None
    return packed


def stamped(message: Message, clock: Clock) -> Message:
    """Return the message with the current cell time in each header without a stamp."""
    now = clock.now_ns()

    def filled(value: Any) -> Any:
        if isinstance(value, Header):
            return value if "stamp" in value.model_fields_set else Header(stamp=now, frame_id=value.frame_id)
        if isinstance(value, BaseModel):
            return value.model_copy(update={name: filled(getattr(value, name)) for name in type(value).model_fields})
        return [filled(item) for item in value] if isinstance(value, list) else value

    result: Message = filled(message)
    return result
