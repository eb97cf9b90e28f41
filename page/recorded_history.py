"""A recording as the history of a page. Images are read only when they are displayed."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from common import topics
from common.messages import Image, Message, MotionStatus, PointCloud2, Rejections, TaskStatus
from common.topics import Topic
from page.feeds import Feeds
from page.history import FAST_PERIOD, FAST_TOPICS, SLOW_PERIOD, Event, RecentHistory
from page.status_text import state_name
from recording.reader import Recording
from recording.sample import Decoder, RecordingError, Sample

M = TypeVar("M", bound=Message)

SUFFIX = ".mcap"
MAX_BYTES = 200 << 20  # of messages in memory
MAX_FILES = 30  # offered
_IMAGE_WINDOWS = (0.2, 2.0)  # [s] in which an image is searched: most cameras publish often


def recordings_folder(configured: str) -> Path:
    """Return the folder of recordings; by default the one in which the cell was started."""
    return Path(configured or ".").expanduser()


def recordings_in(folder: Path) -> list[str]:
    """Return the names of the recordings in a folder, newest first."""
    try:
        found = [(path.stat().st_mtime, path.name) for path in folder.glob(f"*{SUFFIX}") if path.is_file()]
    except OSError:
        return []
    return [name for _, name in sorted(found, reverse=True)[:MAX_FILES]]


class RecordedHistory:
    """An open recording of this cell."""

    def __init__(self, path: Path, cell: str, needed: Collection[Topic[Any]], states: Mapping[str, str]) -> None:
        """Read all messages except images; takes seconds.

        Args:
            path: of the file.
            cell: name of this cell.
            needed: topics of the page.
            states: names of the states of the task.

        Raises:
            RecordingError: it cannot be read, is too large, or is of another cell.
        """
        self._recording = Recording(path)
        try:
            if self._recording.cell not in ("", cell):
                raise RecordingError(f"{path.name}: is a recording of the cell {self._recording.cell}, not of {cell}")
            self.name = path.name
            self._states, self._decoder = states, Decoder(topic.message for topic in needed)
            self._classes = {topic.key: topic.message for topic in needed}
            self._samples: dict[str, tuple[list[float], list[Sample]]] = {}
            self._decoded: dict[str, tuple[Sample, Any]] = {}
            self._image_keys = {topic.key for topic in needed if topic.message is Image}
            self._read({topic.key for topic in needed} - self._image_keys)
            self._events = self._find_events()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._recording.file.close()

    @property
    def start(self) -> float:
        """Its start [s]."""
        return 0.0

    @property
    def end(self) -> float:
        """Its end [s]."""
        return self._recording.seconds

    @property
    def events(self) -> Sequence[Event]:
        """Events, in order."""
        return self._events

    def latest(self, topic: Topic[M], at: float) -> M | None:
        """Return the newest message of a topic at a time [s], or None."""
        times, samples = self._samples.get(topic.key, ([], []))
        count = bisect_right(times, at)
        return self._cached(samples[count - 1]) if count else None

    def between(self, topic: Topic[M], start: float, end: float) -> list[tuple[float, M]]:
        """Return the messages of a topic after `start` and up to `end` [s], each with its time."""
        times, samples = self._samples.get(topic.key, ([], []))
        chosen = range(bisect_right(times, start), bisect_right(times, end))
        found = [(times[i], self._decode(samples[i])) for i in chosen]
        return [(at, message) for at, message in found if message is not None]

    def image(self, topic: Topic[Any], at: float) -> Any:
        """Return the newest image of a topic at a time [s] as a message, or None."""
        if topic.key not in self._image_keys:
            return None
        until = self._recording.start + round(at * 1e9)
        newest = None
        for window in _IMAGE_WINDOWS:
            since = max(0, until - round(window * 1e9))
            for sample in self._recording.samples(lambda key: key == topic.key, since, until):
                newest = sample
            if newest is not None:
                return self._cached(newest)
        return None

    def _cached(self, sample: Sample) -> Any:
        """Return the message of a sample; the same object for repeated requests of the same sample."""
        known = self._decoded.get(sample.key)
        if known is None or known[0] != sample:
            known = self._decoded[sample.key] = (sample, self._decode(sample))
        return known[1]

    def _decode(self, sample: Sample) -> Any:
        """Return the message of a sample; None if its class differs from that of the topic."""
        message = self._decoder.message(sample)
        return message if isinstance(message, self._classes[sample.topic]) else None

    def _read(self, keys: set[str]) -> None:
        size = 0
        for sample in self._recording.samples(lambda key: key in keys):
            times, samples = self._samples.setdefault(sample.topic, ([], []))
            at = (sample.log_time - self._recording.start) * 1e-9
            period = FAST_PERIOD if sample.topic in FAST_TOPICS else SLOW_PERIOD if sample.kind == "stream" else 0.0
            if times and 0 <= at - times[-1] < period:
                continue
            if samples and sample.kind == "state" and samples[-1].payload == sample.payload:
                continue  # states are repeated each second
            size += len(sample.payload)
            if size > MAX_BYTES:
                raise RecordingError(f"{self.name}: has more than {MAX_BYTES >> 20} MB of messages without images, too "
                                     "much for the page; `zencell play` plays it")
            times.append(at)
            samples.append(sample)
        for key, (times, samples) in self._samples.items():  # the recorder's clock may have been set back
            order = sorted(range(len(times)), key=times.__getitem__)
            self._samples[key] = [times[i] for i in order], [samples[i] for i in order]

    def _find_events(self) -> list[Event]:
        events: list[Event] = []
        for times, samples in self._samples.values():
            detector = EventDetector(self._states)
            for at, sample in zip(times, samples, strict=True):
                if sample.topic == topics.JOINT_STATES.key or sample.kind == "stream":
                    break
                if (message := self._decoder.message(sample)) is not None:
                    events += [Event(at, text, kind) for text, kind in detector.detect(message)]
        return sorted(events, key=lambda event: event.at)


class EventDetector:
    """Finds events in messages: changes of the task's state, failed motions, rejections."""

    def __init__(self, states: Mapping[str, str]) -> None:
        """Start; `states` has the names of the task's states."""
        self._states = states
        self._state, self._goal = "", ""

    def detect(self, message: Any) -> list[tuple[str, str]]:
        """Return the events of a new message, each with its kind."""
        if isinstance(message, TaskStatus):
            return self._task(message)
        if isinstance(message, MotionStatus):
            return self._motion(message)
        if isinstance(message, Rejections):
            return [(f"rejected: {each.reason}", "busy") for each in message.rejected]
        return []

    def _task(self, status: TaskStatus) -> list[tuple[str, str]]:
        state = f"{status.state} {status.subject} {status.paused}"
        if state == self._state:
            return []
        self._state = state
        name = "Paused" if status.paused else state_name(status, self._states)
        kind = {"ERROR": "bad", "DONE": "good"}.get(status.state, "busy" if status.paused else "")
        return [(f"{name} {status.subject}".rstrip(), kind)]

    def _motion(self, status: MotionStatus) -> list[tuple[str, str]]:
        goal = f"{status.id} {status.state}"
        if goal == self._goal or status.state not in ("aborted", "cancelled", "rejected"):
            return []
        self._goal = goal
        return [(f"motion {status.state}" + (f": {status.message or status.error}" if status.error else ""),
                 "busy" if status.state == "cancelled" else "bad")]


class HistoryRecorder:
    """Stores new messages of the cell in the recent history, and their events.

    Attributes:
        recent: the last minutes.
    """

    def __init__(self, feeds: Feeds, states: Mapping[str, str]) -> None:
        """Record all topics of the feeds but events, images and point clouds; `states` names the task's states."""
        self.recent = RecentHistory()
        self._feeds, self._detector = feeds, EventDetector(states)
        self._topics = [topic for topic in feeds.topics
                        if topic.kind != "event" and not issubclass(topic.message, Image | PointCloud2)]

    def record(self, now: float) -> None:
        """Store new messages at a wall time [s], monotonic."""
        for topic in self._topics:
            if (message := self._feeds.latest(topic)) is not None and self.recent.add(now, topic, message):
                self.record_events(message, now)

    def record_events(self, message: Any, now: float) -> None:
        """Store the events of a message at a wall time [s], monotonic."""
        for text, kind in self._detector.detect(message):
            self.recent.add_event(now, text, kind)
