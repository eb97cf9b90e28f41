"""One fold over what a cell says: the live line, the summary, the report and the recheck of a run come from here.

It is fed by whoever listens to a cell that is up, and from a recording alike; it asks nobody and reads no clock.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from common import topics
from common import topics as t
from common.application import Application, applications
from common.client.statistics import Rates
from common.config import RobotConfig
from common.messages import Message, TaskStatus
from common.sources import monotonic
from common.topics import Topic
from recording.report.application import Figures, Listener, figures_of
from recording.report.summary import Summary

if TYPE_CHECKING:
    from common.transport.bus import Bus, Reader
    from recording.report.history import RunHistory


class RunAggregator:
    """What a cell said, folded into the figures of its run. Feed it every message of its `topics`."""

    def __init__(
        self, cell: str, application: Application | None, *, robot: RobotConfig | None = None, seed: int = 0,
        speed: float = 1.0, containers: Sequence[str] = (), gathering: RunHistory | None = None,
        listeners: Mapping[Topic[Any], Listener] | None = None,
    ) -> None:
        """Start with nothing heard.

        Args:
            cell: its name.
            application: what the cell is for; None when that is not known.
            robot: of the cell; None when it is not known.
            seed: of the run.
            speed: seconds of cell time per second of wall time.
            containers: ids of those that the cell has.
            gathering: is fed as well, for a report.
            listeners: who else is fed, as a recheck, and with what.
        """
        self.figures: Figures = figures_of(application)(robot, pictured=gathering is not None)
        self.summary = Summary(cell, seed, speed, self.figures, containers,
                               fills=application is not None and application.fills_containers)
        self.gathering = gathering
        self.status: TaskStatus | None = None
        self._topics: dict[str, Topic[Any]] = {}
        self._listeners: dict[str, list[Listener]] = {}
        summary = self.summary
        if application is not None:
            self._hear(application.status, self._on_status)
            assert application.topics is not None
            decided_by, rejected = application.topics.decided_by, application.topics.rejected
            if decided_by is not None:
                self._hear(decided_by, self._on_decided)
            if rejected is not None:
                self._hear(rejected, summary.on_rejections)
                if gathering is not None:
                    self._hear(rejected, gathering.on_rejections)
        self._hear(t.MOTION_STATUS, summary.on_motion)
        self._hear(t.SCENE_OBJECTS, lambda _, message: summary.truth.on_objects(message))
        if self.figures.TRUTH is not None:
            self._hear(self.figures.TRUTH, lambda _, message: summary.truth.on_labels(message))
        for topic, listener in (*self.figures.listeners().items(), *(listeners or {}).items()):
            self._hear(topic, listener)
        if gathering is not None:
            gathering.truth = summary.truth
            for topic, listener in gathering.listeners().items():
                self._hear(topic, listener)

    def _hear(self, topic: Topic[Any], listener: Listener) -> None:
        self._topics[topic.key] = topic
        self._listeners.setdefault(topic.key, []).append(listener)

    @property
    def topics(self) -> list[Topic[Any]]:
        """What is listened to."""
        return list(self._topics.values())

    @property
    def truths(self) -> list[Topic[Any]]:
        """Those of them that tell where everything really is."""
        return [topic for topic in self.topics if topic in (t.SCENE_OBJECTS, self.figures.TRUTH)]

    def on(self, key: str, message: Message, time: float, now_ns: int) -> None:
        """Take a message in.

        Args:
            key: of its topic, without the cell.
            message: what was said.
            time: wall time [s] at which it came, since the run or its recording began.
            now_ns: cell time at which it came [ns].
        """
        self._now_ns = now_ns
        for listener in self._listeners.get(t.general_key(key), ()):
            listener(time, message)

    @property
    def progress(self) -> str:
        """How far the task is, as "3 of 7 placed - GRASPING object_4"."""
        if self.status is None:
            return "the task has not spoken yet"
        line = self.figures.progress(self.status)
        if self.status.paused:
            line += " (paused)"
        elif not self.status.started and self.status.state == "IDLE":
            line += " (waits for `zencell task start`)"
        return line

    def _on_status(self, time: float, status: TaskStatus) -> None:
        self.status = status
        self.summary.on_status(status)
        if self.gathering is not None:
            self.gathering.on_task(time, status)

    def _on_decided(self, _time: float, message: Message) -> None:
        if stamp := self.figures.exposed(message):
            age_ms = (self._now_ns - stamp) / self.summary.speed * 1e-6
            self.summary.on_latency(age_ms)
            if self.gathering is not None:
                self.gathering.latencies.append(age_ms)


def recorded_application(keys: Sequence[str]) -> Application | None:
    """The application that comes with the project and whose status is among these keys; None when there is none."""
    return next((found for found in applications() if found.status.key in keys), None)


SETTLE_TIMEOUT = 2.0  # [s] for what still falls after the task ended
ENDED = ("DONE", "ERROR")


class Collector:
    """Feeds a `RunAggregator` and `Rates` from a cell's topics."""

    def __init__(self, bus: Bus, fold: RunAggregator, started_at: float, on_progress: Callable[[str], None]) -> None:
        """Declare what is listened to.

        Args:
            bus: of the cell.
            fold: is fed.
            started_at: when this process began [s, monotonic].
            on_progress: called with a line whenever the task got further.
        """
        self.rates = Rates()
        self.ended = asyncio.Event()
        self._fold = fold
        self._clock = bus.clock
        self._started_at = started_at
        self._on_progress = on_progress
        self._progress = fold.progress
        self._readers: list[Reader[Any]] = [bus.reader(topic) for topic in fold.topics]
        self._counters = bus.reader(replace(topics.COUNTERS, plain=False))
        self._heard = asyncio.Event()

    async def run(self) -> None:
        """Listen until cancelled."""
        following = [asyncio.create_task(self._follow(reader)) for reader in self._readers]
        following.append(asyncio.create_task(self._follow_counters()))
        try:
            await asyncio.gather(*following)
        finally:
            for task in following:
                task.cancel()

    async def settle(self) -> None:
        """Wait until nothing is on its way any more, for a short time at most, and read the truth."""
        deadline = monotonic() + SETTLE_TIMEOUT
        try:
            async with asyncio.timeout(SETTLE_TIMEOUT):
                while not self._fold.summary.truth.settled:
                    self._heard.clear()
                    await self._heard.wait()
        except TimeoutError:
            pass
        # The task may say DONE a moment before the world says that the last object has come to rest.
        await asyncio.sleep(min(0.2, max(0.0, deadline - monotonic())))
        self.read_truth()

    def read_truth(self) -> None:
        """Take note of where everything really lies now."""
        for reader in self._readers:
            if reader.topic in self._fold.truths and (latest := reader.latest) is not None:
                self._take(reader.topic.key, latest)

    def _take(self, key: str, message: Any) -> None:
        self._fold.on(key, message, monotonic() - self._started_at, self._clock.now_ns())

    async def _follow(self, reader: Reader[Any]) -> None:
        async for message in reader:
            before = self._fold.status
            self._take(reader.topic.key, message)
            self._heard.set()
            status = self._fold.status
            if status is None or status is before:
                continue
            if (line := self._fold.progress) != self._progress:
                self._progress = line
                self._on_progress(line)
            if status.state in ENDED:
                self.ended.set()

    async def _follow_counters(self) -> None:
        async for counters in self._counters:
            self.rates.update(counters, monotonic())
