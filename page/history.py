"""History of the cell: the last minutes in memory, and the position in time that the page displays.

Times are in seconds: for the last minutes by the page's monotonic clock, for a recording since its start.
"""

from __future__ import annotations

import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from common import topics
from common.errors import ZencellError
from common.messages import Message
from common.topics import Topic
from common.transport.codec import decode, encode
from page.feeds import Latest

M = TypeVar("M", bound=Message)

SECONDS = 180.0  # [s] of messages in memory
MAX_IMAGE_BYTES = 48 << 20  # of all images in memory
MAX_TOPIC_BYTES = 4 << 20  # of the messages of a topic: large ones are stored for a shorter time
MAX_EVENTS = 300
FAST_PERIOD, SLOW_PERIOD = 0.09, 0.45  # [s] minimum time between two stored messages of a topic
FAST_TOPICS = (topics.JOINT_STATES.key, topics.SCENE_OBJECTS.key)
IMAGE_PERIOD = 1.0  # [s]
_PRESENT_TOLERANCE = 0.3  # [s] from the end of the last minutes, which counts as the present
_EVENT_TOLERANCE = 0.05  # [s] from an event, which counts as its time


@dataclass(frozen=True)
class Event:
    """An event that an operator may want to see again."""

    at: float  # [s]
    text: str
    kind: str = ""  # of its color


class History(Protocol):
    """Messages by time."""

    @property
    def start(self) -> float:
        """Earliest time [s]."""

    @property
    def end(self) -> float:
        """Latest time [s]."""

    @property
    def events(self) -> Sequence[Event]:
        """Events, in order."""

    def latest(self, topic: Topic[M], at: float) -> M | None:
        """Return the newest message of a topic at a time [s], or None."""

    def between(self, topic: Topic[M], start: float, end: float) -> list[tuple[float, M]]:
        """Return the messages of a topic after `start` and up to `end` [s], each with its time."""

    def image(self, topic: Topic[Any], at: float) -> Any:
        """Return the newest image of a topic at a time [s] as a message, or None."""

    def close(self) -> None:
        """Release its resources."""


@dataclass
class _Series:
    times: deque[float] = field(default_factory=deque)
    values: deque[bytes] = field(default_factory=deque)
    size: int = 0  # [bytes]

    def count(self, at: float) -> int:
        """Return the number of values up to a time."""
        return bisect_right(self.times, at)

    def add(self, at: float, value: bytes) -> None:
        self.times.append(at)
        self.values.append(value)
        self.size += len(value)

    def replace_last(self, at: float, value: bytes) -> None:
        self.times.pop()
        self.size -= len(self.values.pop())
        self.add(at, value)

    def drop_first(self) -> None:
        self.times.popleft()
        self.size -= len(self.values.popleft())


class RecentHistory:
    """The last minutes in memory: at most `SECONDS` of messages and `MAX_IMAGE_BYTES` of images.

    Messages are stored compressed, which takes a twentieth of the memory of objects.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.now = 0.0
        self._started: float | None = None
        self._messages: dict[str, _Series] = {}
        self._newest: dict[str, Message] = {}
        self._decoded: dict[str, tuple[bytes, Any]] = {}  # last result of `latest`, which is requested repeatedly
        self._images: dict[str, _Series] = {}
        self._image_order: deque[tuple[str, int]] = deque()  # keys and sizes, oldest first
        self._image_bytes = 0
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)

    @property
    def start(self) -> float:
        """Earliest time [s]."""
        return max(self._started if self._started is not None else self.now, self.now - SECONDS)

    @property
    def end(self) -> float:
        """Latest time [s]."""
        return self.now

    @property
    def events(self) -> Sequence[Event]:
        """Events, in order."""
        return [event for event in self._events if event.at >= self.start]

    def add_event(self, now: float, text: str, kind: str = "") -> None:
        """Store an event at a time [s]."""
        self._events.append(Event(now, text, kind))

    def add(self, now: float, topic: Topic[Any], message: Message) -> bool:
        """Store the newest message of a topic at a time [s]; return whether it is a new one."""
        self._advance(now)
        series = self._messages.setdefault(topic.key, _Series())
        if self._newest.get(topic.key) is message:
            return False
        self._newest[topic.key] = message
        period = FAST_PERIOD if topic.key in FAST_TOPICS else SLOW_PERIOD
        if len(series.times) > 1 and now - series.times[-2] < period:
            series.replace_last(now, _pack(message))
        else:
            series.add(now, _pack(message))
        # one message before the last minutes remains: it is the state at their start
        while len(series.times) > 1 and (series.times[1] < now - SECONDS or series.size > MAX_TOPIC_BYTES):
            series.drop_first()
        return True

    def add_image(self, now: float, topic: Topic[Any], rgb: Any) -> None:
        """Store an image (height, width, 3) RGB of a topic at a time [s], at most one per second."""
        import cv2

        self._advance(now)
        series = self._images.setdefault(topic.key, _Series())
        if series.times and now - series.times[-1] < IMAGE_PERIOD:
            return
        done, data = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
        if not done:
            return
        series.add(now, data.tobytes())
        self._image_order.append((topic.key, len(series.values[-1])))
        self._image_bytes += self._image_order[-1][1]
        while (self._image_bytes > MAX_IMAGE_BYTES
               or self._images[self._image_order[0][0]].times[0] < now - SECONDS):
            key, size = self._image_order.popleft()
            self._images[key].drop_first()
            self._image_bytes -= size

    def latest(self, topic: Topic[M], at: float) -> M | None:
        """Return the newest message of a topic at a time [s], or None."""
        series = self._messages.get(topic.key)
        count = series.count(at) if series is not None else 0
        if series is None or not count:
            return None
        if count == len(series.times):
            return self._newest[topic.key]  # type: ignore[return-value]
        packed = series.values[count - 1]
        known = self._decoded.get(topic.key)
        if known is None or known[0] is not packed:
            known = self._decoded[topic.key] = (packed, _unpack(topic, packed))
        return known[1]

    def between(self, topic: Topic[M], start: float, end: float) -> list[tuple[float, M]]:
        """Return the messages of a topic after `start` and up to `end` [s], each with its time."""
        series = self._messages.get(topic.key)
        if series is None:
            return []
        return [(series.times[i], _unpack(topic, series.values[i]))
                for i in range(series.count(start), series.count(end))]

    def image(self, topic: Topic[Any], at: float) -> Any:
        """Return the newest image of a topic at a time [s] as a message, or None."""
        import cv2
        import numpy as np

        from common.perception.image import array_to_image

        series = self._images.get(topic.key)
        count = series.count(at) if series is not None else 0
        if series is None or not count:
            return None
        decoded = cv2.imdecode(np.frombuffer(series.values[count - 1], np.uint8), cv2.IMREAD_COLOR)
        return array_to_image(np.asarray(decoded, np.uint8), "bgr8")

    def close(self) -> None:
        """Do nothing: it exists as long as the page."""

    def _advance(self, now: float) -> None:
        self.now = now
        if self._started is None:
            self._started = now


def _pack(message: Message) -> bytes:
    return zlib.compress(encode(message), 1)


def _unpack(topic: Topic[M], packed: bytes) -> M:
    return decode(topic.message, zlib.decompress(packed))


class Timeline:
    """The position in time that all pages display: the present, a time of the last minutes, or one of a recording.

    Attributes:
        at: displayed time [s] of the history; None: the present.
        playing: whether it advances.
        speed: of playing, relative to real time.
        recording: displayed in place of the last minutes.
        on_seek: called when the time changes other than by playing.
        on_error: called with the reason if something cannot be displayed.
    """

    def __init__(self, live: Latest, recent: History) -> None:
        """Display the present."""
        self._live, self._recent = live, recent
        self.at: float | None = None
        self.playing = False
        self.speed = 1.0
        self.recording: History | None = None
        self.on_seek: Callable[[], None] = lambda: None
        self.on_error: Callable[[str], None] = lambda _reason: None
        self._image_times: dict[str, float] = {}  # for which `image` has returned an image
        self._last_step: float | None = None

    @property
    def history(self) -> History:
        """The recording, else the last minutes."""
        return self.recording if self.recording is not None else self._recent

    @property
    def is_present(self) -> bool:
        """Whether the present is displayed."""
        return self.at is None

    def latest(self, topic: Topic[M], /) -> M | None:
        """Return the newest message of a topic at the displayed time, or None."""
        return self._live(topic) if self.at is None else self.history.latest(topic, self.at)

    def image(self, topic: Topic[Any]) -> Any:
        """Return the newest image at the displayed time; None for the present, and if it was returned already.

        Reading and sending an image repeatedly would delay other pages, STOP included.
        """
        if self.at is None or self._image_times.get(topic.key) == self.at:
            return None
        self._image_times[topic.key] = self.at
        try:
            return self.history.image(topic, self.at)
        except ZencellError as error:  # a recording that is damaged there
            self.on_error(str(error))
            return None

    def resend_images(self) -> None:
        """Make `image` return the images again, for new pages or other topics."""
        self._image_times.clear()

    def open(self, recording: History | None) -> None:
        """Display the start of a recording, paused; None: the present."""
        if self.recording is not None:
            self.recording.close()
        self.recording, self.playing = recording, False
        self.resend_images()
        self.at = recording.start if recording is not None else None
        self.on_seek()

    def return_to_present(self) -> None:
        """Display the present."""
        if self.at is not None or self.recording is not None:
            self.open(None)

    def seek(self, at: float) -> None:
        """Display a time [s]; the end of the last minutes is the present."""
        history = self.history
        if self.recording is None and at > history.end - _PRESENT_TOLERANCE:
            self.return_to_present()
            return
        self.at = min(max(at, history.start), history.end)
        self.on_seek()

    def step(self, now: float) -> None:
        """Advance at a wall time [s], monotonic, while playing; skip what is no longer in memory."""
        elapsed = now - self._last_step if self._last_step is not None else 0.0
        self._last_step = now
        if self.at is None:
            return
        history = self.history
        if self.playing:
            self.at += self.speed * elapsed
            if self.recording is None and self.at > history.end - _PRESENT_TOLERANCE and self.speed >= 1:
                self.return_to_present()
                return
            if self.at >= history.end:
                self.at, self.playing = history.end, False
        self.at = max(self.at, history.start)

    def adjacent_event(self, direction: int) -> Event | None:
        """Return the next (+1) or previous (-1) event, or None."""
        at = self.at if self.at is not None else self.history.end + _EVENT_TOLERANCE
        if direction > 0:
            return next((event for event in self.history.events if event.at > at + _EVENT_TOLERANCE), None)
        return next((event for event in reversed(self.history.events) if event.at < at - _EVENT_TOLERANCE), None)
