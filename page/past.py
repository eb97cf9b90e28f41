"""The last minutes of what the cell said, kept so that somebody may look back, as one may at a recording.

Times are seconds: of the last minutes those of the page's own clock, of a recording those since its beginning.
"""

from __future__ import annotations

import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from common import topics
from common.messages import Message
from common.topics import Topic
from common.transport.codec import decode, encode

M = TypeVar("M", bound=Message)

SECONDS = 180.0  # [s] that are kept
MOST_BYTES = 48 << 20  # of pictures that are kept
MOST_TOLD = 4 << 20  # [bytes] that are kept of a topic: of large messages fewer minutes
MOST_EVENTS = 300
OFTEN, SELDOM = 0.09, 0.45  # [s] least time between two messages of a topic that are kept
PICTURES = 1.0  # [s] between pictures that are kept
OFTEN_KEPT = (topics.JOINT_STATES.key, topics.SCENE_OBJECTS.key)


@dataclass(frozen=True)
class Event:
    """Something that somebody may want to look at again."""

    at: float  # [s]
    words: str
    kind: str = ""  # how good that is, as of a colour


class Past(Protocol):
    """What was said, by when."""

    @property
    def start(self) -> float:
        """The earliest time [s] of which anything is known."""

    @property
    def end(self) -> float:
        """The latest."""

    @property
    def events(self) -> Sequence[Event]:
        """What happened, in order."""

    def latest(self, topic: Topic[M], at: float) -> M | None:
        """The newest message of a topic at a time [s]; None where none is known."""

    def between(self, topic: Topic[M], start: float, end: float) -> list[tuple[float, M]]:
        """The messages of a topic that came after a time, up to another [s]."""

    def picture(self, topic: Topic[Any], at: float) -> Any:
        """The newest picture of a topic at a time [s], as a message; None where none is known."""

    def close(self) -> None:
        """Be looked at no more."""


@dataclass
class _Kept:
    times: deque[float] = field(default_factory=deque)
    values: deque[bytes] = field(default_factory=deque)
    size: int = 0  # [bytes]

    def before(self, at: float) -> int:
        """How many came up to a time."""
        return bisect_right(self.times, at)

    def add(self, at: float, value: bytes) -> None:
        self.times.append(at)
        self.values.append(value)
        self.size += len(value)

    def replace(self, at: float, value: bytes) -> None:
        """In place of the newest."""
        self.times.pop()
        self.size -= len(self.values.pop())
        self.add(at, value)

    def drop(self) -> None:
        self.times.popleft()
        self.size -= len(self.values.popleft())


class Memory:
    """The last minutes, in this process: at most `SECONDS` of messages, and `MOST_BYTES` of pictures.

    Messages are kept packed, which takes a twentieth of the room of objects.
    """

    def __init__(self) -> None:
        """Know nothing yet."""
        self.now = 0.0
        self._begun: float | None = None
        self._kept: dict[str, _Kept] = {}
        self._newest: dict[str, Message] = {}
        self._decoded: dict[str, tuple[bytes, Any]] = {}  # what was asked for last, which is asked for again and again
        self._pictures: dict[str, _Kept] = {}
        self._order: deque[tuple[str, int]] = deque()  # keys and sizes of pictures, oldest first
        self._bytes = 0
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)

    @property
    def start(self) -> float:
        """The earliest time [s] of which anything is known."""
        return max(self._begun if self._begun is not None else self.now, self.now - SECONDS)

    @property
    def end(self) -> float:
        """The latest."""
        return self.now

    @property
    def events(self) -> Sequence[Event]:
        """What happened, in order."""
        return [event for event in self._events if event.at >= self.start]

    def happened(self, now: float, words: str, kind: str = "") -> None:
        """Take note of an event at a time [s]."""
        self._events.append(Event(now, words, kind))

    def note(self, now: float, topic: Topic[Any], message: Message) -> bool:
        """Take note of the newest message of a topic at a time [s]; whether it is another than the last."""
        self._tick(now)
        kept = self._kept.setdefault(topic.key, _Kept())
        if self._newest.get(topic.key) is message:
            return False
        self._newest[topic.key] = message
        least = OFTEN if topic.key in OFTEN_KEPT else SELDOM
        if len(kept.times) > 1 and now - kept.times[-2] < least:  # the last one had no successor for long enough
            kept.replace(now, _packed(message))
        else:
            kept.add(now, _packed(message))
        # one from before the last minutes says how it was at their start
        while len(kept.times) > 1 and (kept.times[1] < now - SECONDS or kept.size > MOST_TOLD):
            kept.drop()
        return True

    def note_picture(self, now: float, topic: Topic[Any], rgb: Any) -> None:
        """Take note of a picture (height, width, 3) RGB of a topic at a time [s], once a second at most."""
        import cv2

        self._tick(now)
        kept = self._pictures.setdefault(topic.key, _Kept())
        if kept.times and now - kept.times[-1] < PICTURES:
            return
        done, data = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
        if not done:
            return
        kept.add(now, data.tobytes())
        self._order.append((topic.key, len(kept.values[-1])))
        self._bytes += self._order[-1][1]
        while self._bytes > MOST_BYTES or self._pictures[self._order[0][0]].times[0] < now - SECONDS:
            key, size = self._order.popleft()
            self._pictures[key].drop()
            self._bytes -= size

    def latest(self, topic: Topic[M], at: float) -> M | None:
        """The newest message of a topic at a time [s]; None where none is known."""
        kept = self._kept.get(topic.key)
        count = kept.before(at) if kept is not None else 0
        if kept is None or not count:
            return None
        if count == len(kept.times):
            return self._newest[topic.key]  # type: ignore[return-value]
        payload = kept.values[count - 1]
        known = self._decoded.get(topic.key)
        if known is None or known[0] is not payload:
            known = self._decoded[topic.key] = (payload, _unpacked(topic, payload))
        return known[1]

    def between(self, topic: Topic[M], start: float, end: float) -> list[tuple[float, M]]:
        """The messages of a topic that came after a time, up to another [s]."""
        kept = self._kept.get(topic.key)
        if kept is None:
            return []
        return [(kept.times[i], _unpacked(topic, kept.values[i]))
                for i in range(kept.before(start), kept.before(end))]

    def picture(self, topic: Topic[Any], at: float) -> Any:
        """The newest picture of a topic at a time [s], as a message; None where none is known."""
        import cv2
        import numpy as np

        from common.perception.image import array_to_image

        kept = self._pictures.get(topic.key)
        count = kept.before(at) if kept is not None else 0
        if kept is None or not count:
            return None
        decoded = cv2.imdecode(np.frombuffer(kept.values[count - 1], np.uint8), cv2.IMREAD_COLOR)
        return array_to_image(np.asarray(decoded, np.uint8), "bgr8")

    def close(self) -> None:
        """Go on: it is the page's own."""

    def _tick(self, now: float) -> None:
        self.now = now
        if self._begun is None:
            self._begun = now


def _packed(message: Message) -> bytes:
    return zlib.compress(encode(message), 1)


def _unpacked(topic: Topic[M], packed: bytes) -> M:
    return decode(topic.message, zlib.decompress(packed))
