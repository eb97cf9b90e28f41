"""Messages of which every one counts: events, log lines, counters, rejections, latencies."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import partial
from typing import TYPE_CHECKING, Any

from common import topics
from common.messages import Rejections
from common.messages.camera import INSIDE_CONTAINER
from common.topics import Topic
from page.diagnostics import PlotPanel
from page.feeds import Feeds, Topics
from page.layers import Layers
from page.panels import Panels
from page.recorded_history import HistoryRecorder
from page.status_text import RejectedPositions

if TYPE_CHECKING:
    from page.scene import Scene


class Subscriptions:
    """Handles messages of which every one counts: events, log lines, counters, rejections, latencies.

    Attributes:
        rejected: positions of rejected targets.
    """

    def __init__(
        self, feeds: Feeds, topics_: Topics, layers: Layers, panels: Panels, recorder: HistoryRecorder
    ) -> None:
        """Pass messages to the panels and the recorder."""
        self._feeds, self._topics, self._layers = feeds, topics_, layers
        self._panels, self._recorder = panels, recorder
        self.rejected = RejectedPositions()
        self._scene: Scene | None = None
        self._plots: PlotPanel | None = None
        self._pending_events: list[tuple[Topic[Any], Any]] = []  # until there is a scene

    def connect(self, scene: Scene, plots: PlotPanel) -> None:
        """Pass messages to scene and plots too, and former events to the scene."""
        self._scene, self._plots = scene, plots
        for topic, event in self._pending_events:
            scene.handle_event(topic, event)
        self._pending_events.clear()

    def clear_rejected(self) -> None:
        """Forget rejected positions after a reset of the world, if no detections will clear them."""
        if not self._topics.detected:
            self.rejected.positions.clear()

    def tasks(self, age_ms: Callable[[int], float]) -> list[Coroutine[Any, Any, None]]:
        """Return a coroutine for each topic; `age_ms` returns the wall time [ms] since a stamp."""
        now = asyncio.get_running_loop().time

        def add_latency(message: Any) -> None:
            if self._plots is not None:
                self._plots.add_latency(age_ms(message.header.stamp), now())

        def reject(rejections: Rejections) -> None:
            left = [each for each in rejections.rejected if INSIDE_CONTAINER not in each.reason]
            self.rejected.update(rejections.model_copy(update={"rejected": left}))
            self._recorder.record_events(rejections, now())

        health, log = self._panels.health, self._panels.log
        handlers: dict[Topic[Any], list[Callable[[Any], None]]] = {
            topics.LOG: [log.add, self._panels.alarms.add_line],
            topics.COUNTERS: [lambda counters: health.count(counters, now())],
        }
        for topic in self._topics.decided_by:
            handlers.setdefault(topic, []).extend((add_latency, self.rejected.update))
        for topic in self._topics.rejected:
            handlers.setdefault(topic, []).append(reject)
        for topic in self._topics.detected:
            handlers.setdefault(topic, []).append(self.rejected.update)
        for topic in {topic for kind in self._layers.values() for topic in kind.TOPICS if topic.kind == "event"}:
            handlers.setdefault(topic, []).append(partial(self._handle_event, topic))
        return [self._read(*each) for each in handlers.items()]

    async def _read(self, topic: Topic[Any], handlers: list[Callable[[Any], None]]) -> None:
        if (reader := self._feeds.reader(topic)) is not None:
            async for message in reader:
                for handle in handlers:
                    handle(message)

    def _handle_event(self, topic: Topic[Any], event: Any) -> None:
        if self._scene is not None:
            self._scene.handle_event(topic, event)
        else:
            self._pending_events.append((topic, event))
