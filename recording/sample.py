"""One message as it travelled, with when it came and who wrote it."""

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


class RecordingError(ZencellError):
    """A recording that cannot be read, written or used like this: names the file and what to do."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One message as it travelled. Times are wall clock, `publish_time` is cell time [ns since the Unix epoch]."""

    key: str  # full: <cell>/<topic>
    payload: bytes
    log_time: int  # of arrival
    publish_time: int = 0  # stamp of its header; the log time where it has none
    message: str = ""  # name of its class, empty where the sender does not say
    kind: str = "stream"  # or event, state
    writer: str = ""  # empty for a sender that does not say who it is
    sequence: int = 0
    trace: str = ""
    schema: bytes = field(default=b"", repr=False, compare=False)  # JSON, where a recording tells it

    @property
    def topic(self) -> str:
        """The key without the cell."""
        return self.key.partition("/")[2]

    @property
    def cell(self) -> str:
        """Name of the cell."""
        return self.key.partition("/")[0]


def message_of(encoding: str) -> str:
    """Name of the message class in an encoding such as `application/msgpack;Image`; empty if there is none."""
    return encoding.removeprefix(PREFIX) if encoding.startswith(PREFIX) else ""


def encoding_of(message: str) -> str:
    """The encoding under which messages of the class travel."""
    return PREFIX + message if message else PREFIX.rstrip(";")


# Whoever is on the network can make up any number of them: known are those heard of last, and counted the first.
MOST_WRITERS, MAX_KEYS = 10_000, 1000
SEEN_BYTES = 512  # from the front of a payload, where the header is


def stamp_of(payload: bytes) -> int | None:
    """The stamp [ns] of a payload's header, or of its first transform; None where it has none.

    Messages have their header in front, so that a picture is not decoded for it.
    """
    unpacker = msgpack.Unpacker(raw=False, strict_map_key=False)
    unpacker.feed(payload[:SEEN_BYTES])
    try:
        return _first_stamp(unpacker)
    except (msgpack.UnpackException, ValueError, TypeError, RecursionError):
        return None  # not msgpack, or no header in front


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
    """The payload with each stamp [ns] of its headers replaced by `moved(stamp)`; as it was where it has none.

    A stamp of 0 says that there is none and stays.
    """
    try:
        value = msgpack.unpackb(payload, raw=False, strict_map_key=False)
    except (ValueError, TypeError, msgpack.UnpackException, RecursionError):
        return payload  # whoever reads it refuses it as before
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
    except (ValueError, OverflowError):  # a stamp that no clock shows
        return payload
    return packed


class Sequences:
    """The newest sequence number of each key and writer. Not thread-safe: one thread calls it at a time."""

    def __init__(self) -> None:
        """Nothing came yet."""
        self.missed: Counter[str] = Counter()  # by key: numbers that never came
        self._newest: dict[tuple[str, str], int] = {}  # that which was heard of last at the end

    def is_new(self, key: str, writer: str, sequence: int) -> bool:
        """Whether a message is newer than what its writer said before; a gap before it is counted.

        A state comes again each second under the same number, and by a question beside the subscription.
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


class Decoder:
    """Turns samples into messages and counts, by topic, what could not be: somebody else's, or of another version."""

    def __init__(self, own: Iterable[type[Message]] = ()) -> None:
        """Nothing was skipped yet.

        Args:
            own: message classes of a person's own, beside those that come with the project.
        """
        self._own = {model.__name__: model for model in own}
        self.skipped: Counter[str] = Counter()

    def message(self, sample: Sample) -> Message | None:
        """The message that a sample holds, or None for one that cannot be told."""
        known = self._own.get(sample.message) or message_class(sample.message)
        if known is not None or sample.schema:
            try:
                model = known or _told(sample.message)
                values = msgpack.unpackb(sample.payload, raw=False, strict_map_key=True)
                # A field that the class has no more does not make the rest of an old recording worthless.
                return model.model_validate(values, extra="ignore" if known else "allow")
            except (ValidationError, ValueError, TypeError, msgpack.UnpackException, RecursionError):
                pass
        self.skipped[sample.topic] += 1
        return None


@cache
def _told(name: str) -> type[Message]:
    """What stands for a message class that is not here: whatever fields its messages have."""
    config = ConfigDict(extra="allow", ser_json_bytes="base64", ser_json_inf_nan="strings")
    return cast("type[Message]", type(name, (BaseModel,), {"model_config": config, "__module__": __name__}))


def schema_of(name: str) -> bytes:
    """The JSON schema of a message class as UTF-8; empty for one of somebody else's."""
    found = message_class(name)
    return json.dumps(found.model_json_schema(mode="serialization")).encode() if found else b""
