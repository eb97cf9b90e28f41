"""A recorded message: its sample, header stamp, sequence number, and decoded form."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, cast

import msgpack
from pydantic import BaseModel, ConfigDict, ValidationError

from common.application import message_class
from common.errors import ZencellError
from common.messages import Message
from common.messages.basics import MAX_STAMP

PREFIX = "application/msgpack;"  # of an encoding; the name of the message class follows

# Any client of the network can invent writers and keys: the most recently seen and the first counted are remembered.
MOST_WRITERS, MAX_KEYS = 10_000, 1000
HEADER_BYTES = 512  # from the start of a payload, where the header is
BAD_PAYLOAD = (ValueError, TypeError, msgpack.UnpackException, RecursionError)


class RecordingError(ZencellError):
    """A recording that cannot be read, written or used like this: names the file and what to do."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One message as it travelled. `log_time` is wall time, `publish_time` cell time [ns since the Unix epoch]."""

    key: str  # complete: <cell>/<topic>
    payload: bytes
    log_time: int  # of arrival
    publish_time: int = 0  # stamp of its header; the log time if it has none
    message: str = ""  # name of its class; empty if unknown
    kind: str = "stream"  # or event, state
    writer: str = ""  # id; empty if the sender gives none
    sequence: int = 0
    trace: str = ""
    schema: bytes = field(default=b"", repr=False, compare=False)  # JSON schema from the recording
    foreign: tuple[str, dict[str, str], str] | None = field(default=None, repr=False, compare=False)
    """Message encoding, metadata and schema encoding of the channel in a recording of another program."""

    @property
    def topic(self) -> str:
        """The key without the cell."""
        return topic_of(self.key)

    @property
    def cell(self) -> str:
        """Name of the cell."""
        return self.key.partition("/")[0]


def topic_of(key: str) -> str:
    """Return a key without its cell; a key of another program may have only one part."""
    _, slash, topic = key.partition("/")
    return topic if slash else key


def message_of(encoding: str) -> str:
    """Return the message class named in an encoding such as `application/msgpack;Image`; empty if there is none."""
    return encoding.removeprefix(PREFIX) if encoding.startswith(PREFIX) else ""


def encoding_of(message: str) -> str:
    """Return the encoding of a message class."""
    return PREFIX + message if message else PREFIX.rstrip(";")


# --- stamps -----------------------------------------------------------------------------------------------------------


def stamp_of(payload: bytes) -> int | None:
    """Return the stamp [ns] of a payload's header, or of its first transform; None if it has none.

    Only the first bytes are decoded, since messages start with their header.
    """
    unpacker = msgpack.Unpacker(raw=False, strict_map_key=False)
    unpacker.feed(payload[:HEADER_BYTES])
    try:
        return _first_stamp(unpacker)
    except BAD_PAYLOAD:
        return None


def _first_stamp(unpacker: Any) -> int | None:
    for _ in range(unpacker.read_map_header()):
        name = unpacker.unpack()
        if name == "header":
            header = unpacker.unpack()
            stamp = header.get("stamp") if isinstance(header, dict) else None
            return stamp if isinstance(stamp, int) and 0 <= stamp <= MAX_STAMP else None
        if name == "transforms":
            return _first_stamp(unpacker) if unpacker.read_array_header() else None
        unpacker.skip()
    return None


def restamp(payload: bytes, moved: Callable[[int], int]) -> bytes:
    """Return the payload with each header stamp [ns] replaced by `moved(stamp)`; unchanged if it has none.

    A stamp of 0 means that there is none, and stays.
    """
    try:
        value = msgpack.unpackb(payload, raw=False, strict_map_key=False)
    except BAD_PAYLOAD:
        return payload  # readers reject it as before
    if not isinstance(value, dict):
        return payload
    transforms = value.get("transforms")
    holders = [value, *(transforms if isinstance(transforms, list) else [])]
    headers = [holder["header"] for holder in holders if isinstance(holder, dict) and "header" in holder]
    changed = False
    for header in headers:
        if isinstance(header, dict) and isinstance(header.get("stamp"), int) and header["stamp"]:
            header["stamp"] = max(0, moved(header["stamp"]))
            changed = True
    try:
        packed: bytes = msgpack.packb(value, use_bin_type=True) if changed else payload
    except (ValueError, OverflowError):  # a stamp out of range
        return payload
    return packed


class Sequences:
    """Newest sequence number of each key and writer. Not thread-safe."""

    def __init__(self) -> None:
        self.missed: Counter[str] = Counter()  # sequence numbers that never arrived, by key
        self._newest: dict[tuple[str, str], int] = {}  # least recently seen first

    def is_new(self, key: str, writer: str, sequence: int) -> bool:
        """Return whether a message is newer than the last of its writer, and count a gap before it.

        A state arrives again each second under the same number, and in the reply to a query.
        """
        before = self._newest.pop((key, writer), None)
        self._newest[key, writer] = sequence if before is None else max(sequence, before)
        if before is None:
            while len(self._newest) > MOST_WRITERS:
                del self._newest[next(iter(self._newest))]
        elif sequence <= before:
            return False
        elif sequence > before + 1 and (key in self.missed or len(self.missed) < MAX_KEYS):
            self.missed[key] += sequence - before - 1
        return True


# --- decoding ---------------------------------------------------------------------------------------------------------


class Decoder:
    """Decodes samples, and counts by topic those of unknown class or version in `skipped`.

    An export counts in `unfit` those that its format cannot hold.
    """

    def __init__(self, custom: Iterable[type[Message]] = ()) -> None:
        """Know message classes of the user besides those of the project."""
        self.custom = {model.__name__: model for model in custom}
        self.skipped: Counter[str] = Counter()
        self.unfit: Counter[str] = Counter()

    def message(self, sample: Sample) -> Message | None:
        """Return the message of a sample; None if it cannot be decoded."""
        known = self.custom.get(sample.message) or message_class(sample.message)
        if known is not None or sample.schema:
            try:
                model = known or _open_model(sample.message)
                values = msgpack.unpackb(sample.payload, raw=False, strict_map_key=True)
                # A field that the class no longer has must not invalidate the rest of an old recording.
                return model.model_validate(values, extra="ignore" if known else "allow")
            except (ValidationError, *BAD_PAYLOAD):
                pass
        self.skipped[sample.topic] += 1
        return None


@cache
def _open_model(name: str) -> type[Message]:
    """Return a substitute for a message class that is not installed: it accepts any fields."""
    config = ConfigDict(extra="allow", ser_json_bytes="base64", ser_json_inf_nan="strings")
    return cast("type[Message]", type(name, (BaseModel,), {"model_config": config, "__module__": __name__}))


def schema_of(name: str) -> bytes:
    """Return the JSON schema of a message class as UTF-8; empty for an unknown class."""
    found = message_class(name)
    return json.dumps(found.model_json_schema(mode="serialization")).encode() if found else b""
