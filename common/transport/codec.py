"""Encode and decode messages: msgpack maps, validated on receive. No payload can do more than be refused."""

from __future__ import annotations

import asyncio
import gc
import zlib
from collections.abc import Callable
from contextvars import ContextVar
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import msgpack
from pydantic import ValidationError

from common.errors import DecodeError, expected_text
from common.messages import SCHEMA_VERSION, Message
from common.messages.basics import MAX_PAYLOAD_BYTES, MAX_STAMP, SMALL_BYTES, clean, is_name
from common.time_source import new_id

DEFAULT_LIMIT = MAX_PAYLOAD_BYTES  # [bytes]
MSGPACK = "application/msgpack"
CHECKED_BYTES = 64 * 1024  # of a payload that its checksum covers: a damaged pixel does no harm
_PIECE_LEVELS = 3  # of a large payload that are unpacked in pieces: down to the points of a trajectory
_MAX_FIELDS = 256  # of a map: each unknown field costs time to refuse
_MAX_YOUNG = 20_000  # objects that the garbage collector may visit at once: 5 ms
_MAX_SHOWN = 60  # characters of a value in an error

M = TypeVar("M", bound=Message)
T = TypeVar("T")


def encoding_of(model: type[Message]) -> str:
    """Return the Zenoh encoding of a message, such as `application/msgpack;Image`."""
    return f"{MSGPACK};{model.__name__}"


def encode(message: Message) -> bytes:
    """Return the message as a msgpack map; bytes stay bytes."""
    packed: bytes = msgpack.packb(message, default=_fields, use_bin_type=True)
    return packed


def _fields(value: object) -> dict[str, Any]:
    """Return the fields of one message; msgpack calls this for nested ones, in half the time of a dump of all."""
    if not isinstance(value, Message):
        raise TypeError(f"a {type(value).__name__} cannot be sent")
    fields = value.__dict__ if _is_plain(type(value)) else value.model_dump()
    if not value.omitted_defaults:
        return fields
    known = type(value).model_fields
    omitted = value.omitted_defaults
    return {name: own for name, own in fields.items() if name not in omitted or own != known[name].default}


@lru_cache
def _is_plain(model: type[Message]) -> bool:
    """Return whether a message is sent with its fields as they are."""
    own = model.__pydantic_decorators__
    return not (own.computed_fields or own.field_serializers or own.model_serializers)


async def decode_in_thread(model: type[M], payload: bytes, limit: int = DEFAULT_LIMIT) -> M:
    """Return the message of a payload; a large one is decoded in a thread.

    Raises:
        DecodeError: as `decode`.
    """
    if len(payload) <= SMALL_BYTES:
        return decode(model, payload, limit)
    return await asyncio.to_thread(decode, model, payload, limit, in_pieces=True)


def decode(model: type[M], payload: bytes, limit: int = DEFAULT_LIMIT, *, in_pieces: bool = False) -> M:
    """Return the message of a payload; `in_pieces` lets other threads run in between.

    Raises:
        DecodeError: one line: too large, not msgpack, trailing bytes, or the first invalid field.
    """
    if len(payload) <= SMALL_BYTES or not gc.isenabled():
        return _decode(model, payload, limit, in_pieces)
    gc.disable()  # it would visit the many new objects of a large payload again and again: half of the time
    try:
        return _decode(model, payload, limit, in_pieces)
    finally:
        if gc.get_count()[0] > _MAX_YOUNG:
            gc.freeze()  # else the next collection visits all of them at once and blocks all threads for 50 ms
        gc.enable()


def _decode(model: type[M], payload: bytes, limit: int, in_pieces: bool) -> M:
    value = _unpack(payload, min(limit, model.max_bytes), model.__name__, model.max_parts, in_pieces)
    if not isinstance(value, dict):
        raise DecodeError(f"{model.__name__}: payload is {_kind(value)}, not a map")
    try:
        message: M = model.__pydantic_validator__.validate_python(value)  # `model_validate` without its options
        return message
    except ValidationError as error:
        raise DecodeError(_first_error(error, model.__name__)) from None
    except Exception as error:  # from a validator of a user's message
        raise DecodeError(f"{model.__name__}: {type(error).__name__}: {_one_line(str(error))}") from None


def _part_counter(limit: int) -> Callable[[T], T]:
    """Return a function to call with each list and map of a payload; it raises beyond the limit."""
    left = limit

    def count(part: T) -> T:
        nonlocal left
        left -= 1
        if left < 0:
            raise ValueError(f"more than {limit} lists and maps")
        return part

    return count


def _unpack_pieces(unpacker: msgpack.Unpacker, payload: bytes, count: Callable[[Any], Any], levels: int) -> Any:
    """Return the next value; its upper levels are unpacked part by part, so that other threads run in between."""
    kind = payload[unpacker.tell()] if levels and unpacker.tell() < len(payload) else 0
    if 0x80 <= kind <= 0x8F or kind in (0xDE, 0xDF):
        read: dict[str, Any] = {}
        for _ in range(unpacker.read_map_header()):
            name = unpacker.unpack()
            if not isinstance(name, str):
                raise ValueError(f"{type(name).__name__} is not allowed for map key")
            read[name] = _unpack_pieces(unpacker, payload, count, levels - 1)
        return count(read)
    if 0x90 <= kind <= 0x9F or kind in (0xDC, 0xDD):
        length = unpacker.read_array_header()
        return count([_unpack_pieces(unpacker, payload, count, levels - 1) for _ in range(length)])
    return count(unpacker.unpack())  # unpacked on its own it costs as much as a list


def _unpack(payload: bytes, limit: int, name: str, parts: int = 64, in_pieces: bool = False) -> Any:
    if len(payload) > limit:
        raise DecodeError(f"{name}: payload has {len(payload)} bytes, the limit is {limit}")
    if not payload:
        raise DecodeError(f"{name}: payload is empty")
    try:
        limits: dict[str, Any] = {"max_map_len": _MAX_FIELDS, "max_array_len": 4 * parts, "max_ext_len": 0}
        count = _part_counter(parts) if len(payload) > SMALL_BYTES else None
        if count is None or not in_pieces:
            return msgpack.unpackb(
                payload, raw=False, strict_map_key=True, object_hook=count, list_hook=count, **limits)
        unpacker = msgpack.Unpacker(
            raw=False, strict_map_key=True, max_buffer_size=len(payload), max_str_len=len(payload),
            max_bin_len=len(payload), object_hook=count, list_hook=count, **limits,
        )
        unpacker.feed(payload)
        value = _unpack_pieces(unpacker, payload, count, _PIECE_LEVELS)
        if left := len(payload) - unpacker.tell():
            raise msgpack.ExtraData(value, payload[-left:])
        return value
    except msgpack.ExtraData as error:
        raise DecodeError(f"{name}: {len(error.extra)} bytes after the end of the message") from None
    except Exception as error:
        raise DecodeError(f"{name}: not msgpack: {_one_line(str(error) or type(error).__name__)}") from None


def _first_error(error: ValidationError, name: str) -> str:
    errors = error.errors(include_url=False)
    first = errors[0]
    field = ".".join([name, *(str(part) for part in first["loc"])])
    reason = expected_text(first)
    if first["type"] == "string_pattern_mismatch":  # messages have no other pattern
        reason = "must be a name without control characters"
    given = "" if first["type"] in ("missing", "value_error") else f", not {_shown(first['input'])}"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return _one_line(f"{field}: {reason}{given}{more}")


def _shown(value: object) -> str:
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, list | dict):
        return _kind(value)
    text = repr(value)
    return text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."


def _kind(value: object) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "a map" if isinstance(value, dict) else f"{type(value).__name__} {_shown(value)}"


def _one_line(text: str) -> str:
    return clean(" ".join(text.split()))


class Attachment(NamedTuple):
    """Sent with a payload: its writer, sequence number, schema version, trace id of its cause, and checksum."""

    writer: str
    sequence: int
    schema: int = SCHEMA_VERSION
    trace: str = ""
    checksum: int | None = None  # `checksum_of` key and payload


_PARTS = (str, int, int, str, int)  # of an attachment; the last may be missing


def checksum_of(key: str, payload: bytes) -> int:
    """Return CRC-32 of length, full key and first 64 kB of a payload: detects damage, not intent."""
    return zlib.crc32(payload[:CHECKED_BYTES], zlib.crc32(key.encode(), len(payload) & 0xFFFFFFFF))


def require_intact(attachment: Attachment | None, key: str, payload: bytes) -> None:
    """Return if the payload was sent under this full key, or carries no checksum.

    Raises:
        DecodeError: it was damaged on the way, or sent under another key.
    """
    if attachment is not None and attachment.checksum not in (None, checksum_of(key, payload)):
        raise DecodeError("payload does not fit its checksum: damaged on the way, or sent under another key")


def encode_attachment(attachment: Attachment) -> bytes:
    """Return the attachment as a small msgpack array."""
    fields: list[object] = [attachment.writer, attachment.sequence, attachment.schema, attachment.trace]
    packed: bytes = msgpack.packb(fields if attachment.checksum is None else [*fields, attachment.checksum])
    return packed


@lru_cache(maxsize=256)  # several readers of a process, and repeated states
def decode_attachment(data: bytes | None) -> Attachment | None:
    """Return the attachment; None for a sender without one, such as a put of zenoh-cli.

    Raises:
        DecodeError: it is malformed, or of another schema version.
    """
    if not data:
        return None
    value = _unpack(data, 1024, "attachment")
    if isinstance(value, list) and len(value) in (4, 5) and all(map(isinstance, value, _PARTS)):
        attachment = Attachment(*value)
        if is_name(attachment.writer) and is_name(attachment.trace) and 0 <= attachment.sequence <= MAX_STAMP:
            if attachment.schema != SCHEMA_VERSION:
                raise DecodeError(f"attachment: schema version {attachment.schema}, this side has {SCHEMA_VERSION}")
            return attachment
    raise DecodeError("attachment: not [writer, sequence, schema version, trace, checksum]")


def encode_error(code: str, message: str) -> bytes:
    """Return the payload of an error reply."""
    packed: bytes = msgpack.packb({"code": code, "message": message})
    return packed


def decode_error(payload: bytes) -> tuple[str, str] | None:
    """Return code and message of an error reply, or None for one of Zenoh itself, such as b"Timeout"."""
    try:
        value = _unpack(payload, 64 * 1024, "error")
    except DecodeError:
        return None
    match value:
        case {"code": str(code), "message": str(message)}:
            return clean(code), clean(message)
    return None


_trace: ContextVar[str] = ContextVar("trace", default="")


def current_trace() -> str:
    """Return the trace id of the message that this asyncio task read last, or a new one."""
    return _trace.get() or new_id(8)


def set_trace(trace: str) -> None:
    """Use this trace id for what the asyncio task publishes from now on."""
    _trace.set(trace)
