"""How often messages come and how large they are, over a sliding window."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from common.transport.bus import Bus

PERIOD = 1.0  # [s] between figures
COVERED = 5.0  # [s] before now that the figures cover, at most

Figures = dict[str, float | int | None]


class Arrivals:
    """When messages came and how large they were."""

    def __init__(self) -> None:
        """Nothing came yet."""
        self.total = 0
        self._recent: deque[tuple[float, int]] = deque()  # when [s], how large [B]

    def add(self, now: float, size: int) -> None:
        """Take note of a message at a time [s] with a size [B]."""
        self.total += 1
        self._recent.append((now, size))

    def figures(self, now: float) -> Figures:
        """Rate [Hz], least and most time between two messages [s], bytes per second and per message."""
        while self._recent and self._recent[0][0] < now - COVERED:
            self._recent.popleft()
        times = [when for when, _ in self._recent]
        gaps = [later - earlier for earlier, later in pairwise(times)]
        span = times[-1] - times[0] if gaps else 0.0
        rate = len(gaps) / span if span > 0 else 0.0
        size = sum(size for _, size in self._recent) / len(self._recent) if self._recent else 0.0
        return {
            "messages": self.total,
            "hz": round(rate, 3),
            "min": round(min(gaps), 6) if gaps else None,
            "max": round(max(gaps), 6) if gaps else None,
            "bytes": round(size, 1),
            "bytes_per_second": round(rate * size, 1),
        }


async def windows(bus: Bus, key: str) -> AsyncIterator[Figures]:
    """The figures of a full key, each second."""
    arrivals = Arrivals()

    async def listen() -> None:
        async for sample in bus.raw_reader(key):
            arrivals.add(time.monotonic(), len(sample.payload))

    listening = asyncio.create_task(listen())
    try:
        while True:
            await asyncio.sleep(PERIOD)
            if listening.done():
                listening.result()
            yield arrivals.figures(time.monotonic())
    finally:
        listening.cancel()


def describe(figures: Figures, *, in_bytes: bool) -> str:
    """The figures in one line for people."""
    if not figures["messages"]:
        return "nothing came yet"
    if figures["min"] is None or figures["max"] is None:
        return f"{figures['messages']} messages, too few for a rate"
    if in_bytes:
        megabytes = (figures["bytes_per_second"] or 0) / 1e6
        return f"{megabytes:.3f} MB/s, {figures['bytes']:.0f} B each, {figures['hz']:.2f} Hz"
    apart = f"{figures['min'] * 1e3:.1f} to {figures['max'] * 1e3:.1f} ms apart"
    return f"{figures['hz']:.2f} Hz, {apart}, {figures['messages']} messages"
