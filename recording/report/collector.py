"""Listens to a cell that is up, for the figures of a run and for the table that a person watches."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from common import topics
from common.client.rates import Rates
from common.sources import monotonic
from recording.report.fold import Fold

if TYPE_CHECKING:
    from common.transport.bus import Bus, Reader

SETTLE_TIMEOUT = 2.0  # [s] for what still falls after the task ended
ENDED = ("DONE", "ERROR")


class Collector:
    """Feeds a `Fold` and `Rates` from a cell's topics."""

    def __init__(self, bus: Bus, fold: Fold, started_at: float, on_progress: Callable[[str], None]) -> None:
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
