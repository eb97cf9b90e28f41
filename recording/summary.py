"""What is in a recording: each topic with its count, rate, size and type, and what was dropped."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from common.errors import ConfigError
from common.terminal import printable
from recording.reader import Recording
from recording.writer import ABOUT, RUN

if TYPE_CHECKING:
    from recording.sink import RecordingStats


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
    dropped: int = 0  # by the recorder, because the disk was too slow
    missed: int = 0  # on the way to the recorder

    @property
    def hz(self) -> float:
        """Messages per second between the first and the last; 0 for one."""
        return (self.messages - 1) / ((self.last - self.first) * 1e-9) if self.last > self.first else 0.0


@dataclass
class Summary:
    """What is in a recording."""

    path: str
    size: int  # [bytes] on disk
    finished: bool
    start: int  # log time [ns]
    seconds: float
    messages: int
    about: dict[str, Any]
    run: dict[str, Any]
    topics: dict[str, TopicSummary]

    @property
    def lost(self) -> int:
        """Messages that are not in it though they were sent."""
        return sum(topic.dropped + topic.missed for topic in self.topics.values())

    def as_dict(self) -> dict[str, Any]:
        """All of it for JSON."""
        topics = {
            name: {**asdict(topic), "hz": round(topic.hz, 3), "writers": sorted(topic.writers)}
            for name, topic in self.topics.items()
        }
        return {**asdict(self), "lost": self.lost, "topics": topics}


def summarise(recording: Recording) -> Summary:
    """What is in a recording; reads all of it.

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
        str(recording.path), recording.layout.size, recording.finished, recording.start, recording.seconds,
        sum(topic.messages for topic in topics.values()), recording.metadata(ABOUT), recording.metadata(RUN),
        dict(sorted(topics.items())),
    )


MOST_SHOWN = 200  # [characters] of what a recording tells of its run


def progress(now: RecordingStats, before: RecordingStats, missed: int) -> str:
    """How a recording goes, in one line."""
    apart = max(1e-3, now.seconds - before.seconds)
    rate = (now.size - before.size) / apart
    lost = sum(now.dropped.values()) + missed
    return (f"{now.seconds:6.1f} s  {now.messages:,} messages  {in_bytes(now.size)}  {in_bytes(rate)}/s  "
            f"{lost or 'none'} lost")


def outcome(files: list[str], figures: RecordingStats, missed: dict[str, int]) -> list[str]:
    """How a recording went, for the person who made it."""
    names = files[0] if len(files) == 1 else f"{files[0]} to {files[-1]}"
    line = f"recorded {figures.messages:,} messages, {in_bytes(figures.size)}, {figures.seconds:.1f} s: {names}"
    why = "the disk was too slow, or there were too many keys"
    lost = [f"  {key}: {count} dropped, {why}" for key, count in sorted(figures.dropped.items())]
    lost += [f"  {key}: {count} lost on the way here" for key, count in sorted(missed.items())]
    return [line, *(lost or ["nothing was lost"])]


def in_bytes(size: float) -> str:
    """A size for people."""
    for unit, least in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= least:
            return f"{size / least:.1f} {unit}"
    return f"{size:.0f} B"


def about(cell: str) -> dict[str, Any]:
    """What a recording says about its making."""
    from importlib.metadata import version

    versions = {name: version(name) for name in ("zencell", "eclipse-zenoh", "msgpack", "pydantic", "numpy", "mcap")}
    return {
        "cell": cell, "made": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "python": sys.version.split()[0],
        "versions": versions, "arguments": sys.argv[1:],
    }


def contents(file: str, cell: str, summary: Summary) -> list[str]:
    """What is in a recording, in lines for people."""
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(summary.start * 1e-9)) if summary.messages else "never"
    lines = [f"{file}: {cell}, {summary.seconds:.1f} s from {when}, "
             f"{summary.messages:,} messages, {in_bytes(summary.size)}"]
    if summary.run:
        told = {key: printable(value)[:MOST_SHOWN] for key, value in summary.run.items() if value and key != "epoch"}
        lines.append("  " + ", ".join(f"{printable(key)} {value}" for key, value in told.items()))
    if not summary.finished:
        lines.append(f"  not finished: the recorder was killed or still records. Make it whole: zencell recover {file}")
    lines.append(f"{'topic':<30} {'type':<16} {'messages':>9} {'Hz':>8} {'payload':>10}")
    for name, topic in summary.topics.items():
        rate = f"{topic.hz:8.2f}" if topic.messages > 1 else " " * 8
        lost = f"  {topic.dropped + topic.missed} lost" if topic.dropped + topic.missed else ""
        named = f"{printable(name):<30} {printable(topic.type):<16}"
        lines.append(f"{named} {topic.messages:>9,} {rate} {in_bytes(topic.bytes):>10}{lost}")
    return lines


def require_new(path: Path, option: str = "-o", suffix: str = ".mcap") -> None:
    """Return when a recording, or another file, can be made there.

    Raises:
        ConfigError: the folder is not there, or the file is.
    """
    if path.suffix != suffix:
        raise ConfigError(option, str(path), f"must end in {suffix}")
    if not path.absolute().parent.is_dir():
        raise ConfigError(option, str(path), "is in a folder that does not exist")
    if path.exists():
        raise ConfigError(option, str(path), "is there already; choose another name")
