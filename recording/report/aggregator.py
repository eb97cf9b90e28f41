"""Aggregates the messages of a run: progress line, summary, report and verification all come from here.

The aggregator is fed from a running cell (by `Collector`) and from a recording alike. It reads no clock itself.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from common import topics as t
from common.application import Application, applications
from common.arms import arms_topic
from common.client.statistics import Rates
from common.config import RobotConfig
from common.messages import Message, TaskStatus
from common.time_source import monotonic
from common.topics import Topic
from recording.report.application import Figures, Listener, figures_of
from recording.report.summary import Summary

if TYPE_CHECKING:
    from common.transport.bus import Bus, Reader
    from recording.report.history import RunHistory

SETTLE_TIMEOUT = 2.0  # [s] for objects that still fall after the task has ended
TRUTH_DELAY = 0.2  # [s] by which the ground truth may be later than the task's DONE
ENDED = ("DONE", "ERROR")


class RunAggregator:
    """Aggregates every message of its `topics` into the figures of a run."""

    def __init__(
        self, cell: str, application: Application | None, *, robot: RobotConfig | None = None, seed: int = 0,
        speed: float = 1.0, containers: Sequence[str] = (), history: RunHistory | None = None,
        listeners: Mapping[Topic[Any], Listener] | None = None, arms: Iterable[str] = (),
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        """Start without messages.

        Args:
            cell: its name.
            application: of the cell; None if unknown.
            robot: of the cell; None if unknown.
            seed: of the run.
            speed: cell seconds per wall second.
            containers: ids of those that objects are put into; empty: unknown, all.
            history: to be filled as well, for a report.
            listeners: further listeners by topic, as for a verification.
            arms: names of the arms in a cell of several.
            parameters: of the task in the cell file.
        """
        self.figures: Figures = figures_of(application)(robot, for_report=history is not None)
        self.figures.parameters = parameters or {}
        self.summary = Summary(cell, seed, speed, self.figures, containers,
                               fills=application is not None and application.fills_containers)
        self.history = history
        self.status: TaskStatus | None = None
        self._topics: dict[str, Topic[Any]] = {}
        self._listeners: dict[str, list[Listener]] = {}
        summary = self.summary
        if application is not None and application.topics is not None:
            self._add(application.status, self._on_status)
            decided_by, rejected = application.topics.decided_by, application.topics.rejected
            if decided_by is not None:
                self._add(decided_by, self._on_decided)
            if rejected is not None:
                self._add(rejected, summary.on_rejections)
                if history is not None:
                    self._add(rejected, history.on_rejections)
        for topic in [arms_topic(t.MOTION_STATUS, arm) for arm in arms] or [t.MOTION_STATUS]:
            self._add(topic, summary.on_motion)
        self._add(t.SCENE_OBJECTS, lambda _, message: summary.truth.on_objects(message))
        if self.figures.TRUTH is not None:
            self._add(self.figures.TRUTH, lambda _, message: summary.truth.on_labels(message))
        for topic, listener in (*self.figures.listeners().items(), *(listeners or {}).items()):
            self._add(topic, listener)
        if history is not None:
            history.truth = summary.truth
            for topic, listener in history.listeners().items():
                self._add(topic, listener)

    def _add(self, topic: Topic[Any], listener: Listener) -> None:
        self._topics[topic.key] = topic
        self._listeners.setdefault(topic.key, []).append(listener)

    @property
    def topics(self) -> list[Topic[Any]]:
        """Topics to feed."""
        return list(self._topics.values())

    @property
    def truth_topics(self) -> list[Topic[Any]]:
        """Those of the ground truth."""
        return [topic for topic in self.topics if topic in (t.SCENE_OBJECTS, self.figures.TRUTH)]

    def on(self, key: str, message: Message, time: float, now_ns: int) -> None:
        """Aggregate a message.

        Args:
            key: of its topic, without the cell.
            message: of that topic.
            time: wall time of its arrival since the start of the run or recording [s].
            now_ns: cell time of its arrival [ns].
        """
        self._now_ns = now_ns
        for listener in self._listeners.get(t.general_key(key), ()):
            listener(time, message)

    @property
    def progress(self) -> str:
        """Progress of the task, as "3 of 7 placed - GRASPING object_4"."""
        if self.status is None:
            return "no task status received yet"
        line = self.figures.progress(self.status)
        if self.status.paused:
            line += " (paused)"
        elif not self.status.started and self.status.state == "IDLE":
            line += " (waits for `zencell task start`)"
        return line

    def _on_status(self, time: float, status: TaskStatus) -> None:
        self.status = status
        self.summary.on_status(status)
        if self.history is not None:
            self.history.on_task(time, status)

    def _on_decided(self, _time: float, message: Message) -> None:
        if stamp := self.figures.exposed(message):
            age_ms = (self._now_ns - stamp) / self.summary.speed * 1e-6
            self.summary.on_latency(age_ms)
            if self.history is not None:
                self.history.latencies.append(age_ms)


def recorded_application(keys: Sequence[str]) -> Application | None:
    """Return the project's application whose status is among these keys; None if there is none."""
    return next((found for found in applications() if found.status.key in keys), None)


class Collector:
    """Feeds an aggregator and `Rates` from the topics of a running cell."""

    def __init__(
        self, bus: Bus, aggregator: RunAggregator, started_at: float, on_progress: Callable[[str], None]
    ) -> None:
        """Declare the readers.

        Args:
            bus: of the cell.
            aggregator: to feed.
            started_at: start of this process [s, monotonic].
            on_progress: called with a line at each progress of the task.
        """
        self.rates = Rates()
        self.ended = asyncio.Event()
        self._aggregator = aggregator
        self._clock = bus.clock
        self._started_at = started_at
        self._on_progress = on_progress
        self._progress = aggregator.progress
        self._readers: list[Reader[Any]] = [bus.reader(topic) for topic in aggregator.topics]
        self._counters = bus.reader(replace(t.COUNTERS, plain=False))
        self._received = asyncio.Event()

    async def run(self) -> None:
        """Read until cancelled."""
        reading = [asyncio.create_task(self._read(reader)) for reader in self._readers]
        reading.append(asyncio.create_task(self._read_counters()))
        try:
            await asyncio.gather(*reading)
        finally:
            for task in reading:
                task.cancel()

    async def settle(self) -> None:
        """Wait up to `SETTLE_TIMEOUT` until no object falls or is held, then read the ground truth."""
        deadline = monotonic() + SETTLE_TIMEOUT
        try:
            async with asyncio.timeout(SETTLE_TIMEOUT):
                while not self._aggregator.summary.truth.settled:
                    self._received.clear()
                    await self._received.wait()
        except TimeoutError:
            pass
        # The task may publish DONE shortly before the world publishes that the last object is at rest.
        await asyncio.sleep(min(TRUTH_DELAY, max(0.0, deadline - monotonic())))
        self.read_truth()

    def read_truth(self) -> None:
        """Feed the newest ground truth."""
        for reader in self._readers:
            if reader.topic in self._aggregator.truth_topics and (latest := reader.latest) is not None:
                self._feed(reader.topic.key, latest)

    def _feed(self, key: str, message: Any) -> None:
        self._aggregator.on(key, message, monotonic() - self._started_at, self._clock.now_ns())

    async def _read(self, reader: Reader[Any]) -> None:
        async for message in reader:
            before = self._aggregator.status
            self._feed(reader.topic.key, message)
            self._received.set()
            status = self._aggregator.status
            if status is None or status is before:
                continue
            if (line := self._aggregator.progress) != self._progress:
                self._progress = line
                self._on_progress(line)
            if status.state in ENDED:
                self.ended.set()

    async def _read_counters(self) -> None:
        async for counters in self._counters:
            self.rates.update(counters, monotonic())
