"""A recording as the page looks at it: what was said by when, read from its file, pictures only when they are seen."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from common import topics
from common.messages import Image, Message, MotionStatus, Rejections, TaskStatus
from common.topics import Topic
from page.past import OFTEN, OFTEN_KEPT, SELDOM, Event
from recording.reader import Recording
from recording.sample import Decoder, RecordingError, Sample

M = TypeVar("M", bound=Message)

SUFFIX = ".mcap"
MOST_BYTES = 200 << 20  # of messages that are kept
MOST_FILES = 30  # that are offered
_PICTURE_WITHIN = (0.2, 2.0)  # [s] before a time in which a picture may have come: most do so often


def folder_of(given: str) -> Path:
    """The folder of the recordings that the page opens: where the cell was started, if none was given."""
    return Path(given or ".").expanduser()


def recordings_in(folder: Path) -> list[str]:
    """Names of the recordings in a folder, the newest first."""
    try:
        found = [(path.stat().st_mtime, path.name) for path in folder.glob(f"*{SUFFIX}") if path.is_file()]
    except OSError:
        return []
    return [name for _, name in sorted(found, reverse=True)[:MOST_FILES]]


class RecordedPast:
    """An open recording of this cell."""

    def __init__(self, path: Path, cell: str, wanted: Collection[Topic[Any]], told: Mapping[str, str]) -> None:
        """Read what there is but pictures; takes seconds.

        Args:
            path: of the file.
            cell: of which it has to be.
            wanted: what the page shows.
            told: what states of the task are called.

        Raises:
            RecordingError: it cannot be read, or is of another cell.
        """
        self._recording = Recording(path)
        try:
            if self._recording.cell not in ("", cell):
                raise RecordingError(f"{path.name}: is of the cell {self._recording.cell}, not of {cell}")
            self.name = path.name
            self._told, self._decoder = told, Decoder(topic.message for topic in wanted)
            self._classes = {topic.key: topic.message for topic in wanted}
            self._kept: dict[str, tuple[list[float], list[Sample]]] = {}
            self._decoded: dict[str, tuple[Sample, Any]] = {}
            self._pictures = {topic.key for topic in wanted if topic.message is Image}
            self._read({topic.key for topic in wanted} - self._pictures)
            self._events = self._found()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._recording.file.close()

    @property
    def start(self) -> float:
        """Its beginning [s]."""
        return 0.0

    @property
    def end(self) -> float:
        """Its end [s]."""
        return self._recording.seconds

    @property
    def events(self) -> Sequence[Event]:
        """What happened, in order."""
        return self._events

    def latest(self, topic: Topic[M], at: float) -> M | None:
        """The newest message of a topic at a time [s]; None where none is known."""
        times, samples = self._kept.get(topic.key, ([], []))
        count = bisect_right(times, at)
        return self._message(samples[count - 1]) if count else None

    def between(self, topic: Topic[M], start: float, end: float) -> list[tuple[float, M]]:
        """The messages of a topic that came after a time, up to another [s]."""
        times, samples = self._kept.get(topic.key, ([], []))
        chosen = range(bisect_right(times, start), bisect_right(times, end))
        found = [(times[i], self._decoded_as_told(samples[i])) for i in chosen]
        return [(at, message) for at, message in found if message is not None]

    def picture(self, topic: Topic[Any], at: float) -> Any:
        """The newest picture of a topic at a time [s], as a message; None where none is known."""
        if topic.key not in self._pictures:
            return None
        until = self._recording.start + round(at * 1e9)
        newest = None
        for within in _PICTURE_WITHIN:
            since = max(0, until - round(within * 1e9))
            for sample in self._recording.samples(lambda key: key == topic.key, since, until):
                newest = sample
            if newest is not None:
                return self._message(newest)
        return None

    def _message(self, sample: Sample) -> Any:
        """The message of a sample, always the same object while it is the newest of its topic that was asked for."""
        known = self._decoded.get(sample.key)
        if known is None or known[0] != sample:
            known = self._decoded[sample.key] = (sample, self._decoded_as_told(sample))
        return known[1]

    def _decoded_as_told(self, sample: Sample) -> Any:
        """The message of a sample; None for one of another class than its topic has, which nothing here can show."""
        message = self._decoder.message(sample)
        return message if isinstance(message, self._classes[sample.topic]) else None

    def _read(self, wanted: set[str]) -> None:
        size = 0
        for sample in self._recording.samples(lambda key: key in wanted):
            times, samples = self._kept.setdefault(sample.topic, ([], []))
            at = (sample.log_time - self._recording.start) * 1e-9
            least = OFTEN if sample.topic in OFTEN_KEPT else SELDOM if sample.kind == "stream" else 0.0
            if times and 0 <= at - times[-1] < least:
                continue
            if samples and sample.kind == "state" and samples[-1].payload == sample.payload:
                continue  # states are said again each second
            size += len(sample.payload)
            if size > MOST_BYTES:
                raise RecordingError(f"{self.name}: has more than {MOST_BYTES >> 20} MB beside pictures, which is more "
                                     "than the page looks at; `zencell play` plays it")
            times.append(at)
            samples.append(sample)
        for key, (times, samples) in self._kept.items():  # the clock of who recorded may have been set back
            order = sorted(range(len(times)), key=times.__getitem__)
            self._kept[key] = [times[i] for i in order], [samples[i] for i in order]

    def _found(self) -> list[Event]:
        """The events that are in it."""
        events: list[Event] = []
        for times, samples in self._kept.values():
            watch = Watch(self._told)
            for at, sample in zip(times, samples, strict=True):
                if sample.topic == topics.JOINT_STATES.key or sample.kind == "stream":
                    break
                if (message := self._decoder.message(sample)) is not None:
                    events += [Event(at, words, kind) for words, kind in watch.news(message)]
        return sorted(events, key=lambda event: event.at)


class Watch:
    """Tells what is an event of what comes."""

    def __init__(self, told: Mapping[str, str]) -> None:
        """Begin; `told` is what states of the task are called."""
        self._told = told
        self._state, self._goal, self._holding = "", "", False

    def news(self, message: Any) -> list[tuple[str, str]]:
        """What is new with a message, in words, and how good that is."""
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
        word = "Paused" if status.paused else self._told.get(status.state, status.state.replace("_", " ").capitalize())
        kind = {"ERROR": "bad", "DONE": "good"}.get(status.state, "busy" if status.paused else "")
        return [(f"{word} {status.subject}".rstrip(), kind)]

    def _motion(self, status: MotionStatus) -> list[tuple[str, str]]:
        goal = f"{status.id} {status.state}"
        if goal == self._goal or status.state not in ("aborted", "cancelled", "rejected"):
            return []
        self._goal = goal
        return [(f"motion {status.state}" + (f": {status.message or status.error}" if status.error else ""),
                 "busy" if status.state == "cancelled" else "bad")]
