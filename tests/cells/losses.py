"""Counts messages that are lost on the way, by the sequence numbers of each writer."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from common import topics
from common.application import all_topics
from common.errors import DecodeError
from common.transport.bus import Bus
from common.transport.codec import decode_attachment
from common.transport.session import RawSample

WATCHED = [topic for topic in all_topics().values()
           if topic.kind in ("state", "event") or topic in (topics.JOINT_STATES, topics.TF)]


@dataclass
class Arrivals:
    """Messages of one topic that arrived and that were lost."""

    came: int = 0
    lost: int = 0
    first: float = 0.0  # [s, monotonic]
    last: float = 0.0
    longest: float = 0.0  # between two [s]
    newest: dict[str, int] = field(default_factory=dict)  # number by writer

    @property
    def rate(self) -> float:
        """Messages per second."""
        return (self.came - 1) / (self.last - self.first) if self.came > 1 else 0.0

    def add(self, sample: RawSample) -> None:
        """Count a message."""
        now = time.monotonic()
        try:
            attachment = decode_attachment(sample.attachment)
        except DecodeError:
            attachment = None
        if attachment is None:
            return
        before = self.newest.get(attachment.writer)
        if before is not None:
            if attachment.sequence <= before:
                return  # a repeated state
            self.lost += attachment.sequence - before - 1
        self.newest[attachment.writer] = attachment.sequence
        if self.came:
            self.longest = max(self.longest, now - self.last)
        else:
            self.first = now
        self.came, self.last = self.came + 1, now


class Losses:
    """Arrivals of all state and event topics of a cell, and of its fast small streams."""

    def __init__(self, bus: Bus) -> None:
        """Subscribe."""
        self._prefix = f"{bus.cell}/"
        self.of: dict[str, Arrivals] = {topic.key: Arrivals() for topic in WATCHED}
        # On the network's thread, so that a busy event loop of the test does not lose messages.
        self._declared = [bus.raw_subscriber(self._prefix + topic.expression, self._arrive) for topic in WATCHED]

    def _arrive(self, sample: RawSample) -> None:
        self.of[topics.general_key(sample.key.removeprefix(self._prefix))].add(sample)

    def stop(self) -> None:
        """Undeclare the subscribers."""
        while self._declared:
            self._declared.pop().undeclare()

    @staticmethod
    def kind(key: str) -> str:
        """Return the kind of a topic."""
        return all_topics()[key].kind

    def table(self) -> list[str]:
        """Return lines of a table of the topics with messages."""
        lines = ["| topic | kind | came | lost | rate [Hz] | longest gap [ms] |", "|---|---|---|---|---|---|"]
        lines += [
            f"| {key} | {self.kind(key)} | {one.came} | {one.lost} | {one.rate:.2f} | "
            f"{one.longest * 1000:.0f} |" for key, one in self.of.items() if one.came
        ]
        return lines
