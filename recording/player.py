"""Publishes what was recorded, when it is due, and does what the person at the keys says meanwhile."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from recording.sample import encoding_of
from recording.selection import Playhead
from recording.stamps import restamp

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.writer import RawWriter
    from recording.reading import Recording
    from recording.sample import Sample

BACK = 5.0  # [s] that a key jumps back
PICTURE = "Image"


class _Jump(Exception):
    """The person wants to be elsewhere in the recording."""


class Player:
    """One playback."""

    def __init__(
        self, recording: Recording, wants: Callable[[str], bool], rename: Callable[[str], str], *, rate: float = 1.0,
        offset: float = 0.0, loop: bool = False, paused: bool = False, stamp_now: bool = False,
    ) -> None:
        """Prepare to play.

        Args:
            recording: open.
            wants: whether a topic is played.
            rename: the topic under which a topic is published.
            rate: seconds of recording per second.
            offset: where to begin [s].
            loop: begin again at the end.
            paused: wait for a key at the start.
            stamp_now: move all stamps to the present, so that ages are what they were when it was recorded.
        """
        self.published = 0
        self.quit = False
        self._recording = recording
        self._wants = wants
        self.renamed = rename
        self._loop = loop
        self._start = recording.start + round(offset * 1e9)
        self._stamp_now = stamp_now
        self._writers: dict[str, RawWriter] = {}
        self.head = Playhead(self._start, time.time_ns(), rate=rate, paused=paused)
        self._steps = 0
        self._to_picture = False
        self._jumped = False
        self._changed = asyncio.Event()
        run = recording.run
        self._speed, self._epoch = run.speed, run.epoch

    @property
    def position(self) -> float:
        """Where in the recording it is [s]."""
        now = self.head.position(time.time_ns())
        return max(0.0, min(now, self._recording.end) - self._recording.start) * 1e-9

    @property
    def heard(self) -> bool:
        """Whether anybody listens to what is played."""
        return any(writer.matched for writer in self._writers.values())

    def declare(self, bus: Bus, topics: dict[str, tuple[str, str]]) -> None:
        """Declare a writer for each topic, given with message class and kind: who listens is known before it speaks.

        Its ids and numbers are its own, so that readers which have heard the topic before take what it says for new.
        """
        for topic, (message, kind) in topics.items():
            key = f"{bus.cell}/{self.renamed(topic)}"
            known = kind if kind in ("event", "state") else "stream"
            self._writers[topic] = bus.raw_writer(key, encoding_of(message), known)  # type: ignore[arg-type]

    def on_key(self, name: str) -> None:
        """Do what a key says."""
        now = time.time_ns()
        if name == "space":
            (self.head.resume if self.head.paused else self.head.pause)(now)
        elif name in ("right", "down") and self.head.paused:
            self._steps, self._to_picture = 1, name == "down"
        elif name == "left":
            self.head.jump(max(self._recording.start, self.head.position(now) - round(BACK * 1e9)), now)
            self._jumped = True
        elif name == "q":
            self.quit = True
        self._changed.set()

    async def run(self) -> None:
        """Play to the end, or until a key says otherwise."""
        since = self._start
        self.head.jump(since, time.time_ns())
        while not self.quit:
            try:
                await self._through(since)
            except _Jump:
                since = self.head.position(time.time_ns())
                continue
            if self.quit or not self._loop:
                return
            since = self._start
            self.head.jump(since, time.time_ns())

    async def _through(self, since: int) -> None:
        for state in self._recording.states_before(since, self._wants):
            self._publish(state)
        for sample in self._recording.samples(self._wants, since):
            await self._until_due(sample)
            if self.quit:
                return
            self._publish(sample)

    async def _until_due(self, sample: Sample) -> None:
        await asyncio.sleep(0)  # keys are heard also when all is late
        while not self.quit:
            if self._jumped:
                self._jumped = False
                raise _Jump
            now = time.time_ns()
            wait = None if self.head.paused else (self.head.due(sample.log_time) - now) * 1e-9
            if wait is not None and wait <= 0:
                return
            if self.head.paused and self._steps:
                if not self._to_picture or sample.message == PICTURE:
                    self._steps = 0
                self.head.jump(sample.log_time, now)
                return
            self._changed.clear()
            try:
                async with asyncio.timeout(wait):
                    await self._changed.wait()
            except TimeoutError:
                pass

    def _publish(self, sample: Sample) -> None:
        payload = restamp(sample.payload, self._present) if self._stamp_now else sample.payload
        if writer := self._writers.get(sample.topic):  # the index of a file may leave one out
            writer.put(payload, sample.trace)
            self.published += 1

    def _present(self, stamp: int) -> int:
        """The stamp [ns] that belongs to a recorded one: from cell time to wall time, and from then to now."""
        then = self._epoch + round((stamp - self._epoch) / self._speed) if self._epoch else stamp
        return self.head.due(then)
