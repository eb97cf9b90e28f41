"""Summary of a recording: each topic with its count, rate, size and type, and lost messages."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from recording.reader import Recording
from recording.writer import ABOUT, RUN


@dataclass
class TopicSummary:
    """One topic of a recording."""

    type: str
    kind: str
    messages: int = 0
    bytes: int = 0  # of payload
    first: int = 0  # log time [ns]
    last: int = 0
    writers: set[str] = field(default_factory=set)
    dropped: int = 0  # by the recorder: the disk was too slow
    missed: int = 0  # lost on the network

    @property
    def hz(self) -> float:
        """Messages per second between the first and the last; 0 for a single one."""
        return (self.messages - 1) / ((self.last - self.first) * 1e-9) if self.last > self.first else 0.0


@dataclass
class Summary:
    """Contents of a recording."""

    path: str
    size: int  # [bytes] on disk
    finished: bool
    flaw: str  # why it is not finished
    start: int  # log time [ns]
    seconds: float
    messages: int
    about: dict[str, Any]
    run: dict[str, Any]
    topics: dict[str, TopicSummary]

    @property
    def lost(self) -> int:
        """Number of messages that were sent but not recorded."""
        return sum(topic.dropped + topic.missed for topic in self.topics.values())

    def as_dict(self) -> dict[str, Any]:
        """Return all values for JSON."""
        topics = {
            name: {**asdict(topic), "hz": round(topic.hz, 3), "writers": sorted(topic.writers)}
            for name, topic in self.topics.items()
        }
        return {**asdict(self), "lost": self.lost, "topics": topics}


def summarise(recording: Recording) -> Summary:
    """Read all of a recording and return its summary.

    Raises:
        RecordingError: a chunk is damaged; names where.
    """
    topics: dict[str, TopicSummary] = {}
    for sample in recording.samples():
        topic = topics.setdefault(sample.topic, TopicSummary(sample.message, sample.kind, first=sample.log_time))
        topic.messages += 1
        topic.bytes += len(sample.payload)
        topic.last = sample.log_time
        topic.writers.add(sample.writer)
    for field_name in ("dropped", "missed"):
        for name, count in recording.lost(field_name).items():
            setattr(topics.setdefault(name, TopicSummary("", "")), field_name, count)
    return Summary(
        str(recording.path), recording.layout.size, recording.finished, recording.flaw, recording.start,
        recording.seconds, sum(topic.messages for topic in topics.values()), recording.metadata(ABOUT),
        recording.metadata(RUN), dict(sorted(topics.items())),
    )
