"""The stamps of a payload: read without decoding the rest, and moved to another time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import msgpack

from common.messages.basics import MAX_STAMP

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
