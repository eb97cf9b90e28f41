"""How often messages come and how large they are, over a sliding window."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncIterator
from itertools import pairwise
from typing import TYPE_CHECKING

import msgpack

if TYPE_CHECKING:
    from common.clock import Clock
    from common.transport.bus import Bus
    from common.transport.session import RawSample

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


HEAD = 256  # [bytes] in which the header of our messages lies; what follows may be a picture

DelayFigures = dict[str, float | int | None]


def stamp_of(payload: bytes) -> int | None:
    """The cell time [ns] in a message's header, or in that of its first transform; None where there is none."""
    for part in (payload[:HEAD], payload):
        unpacker = msgpack.Unpacker(raw=False, strict_map_key=False, max_buffer_size=len(payload) + 1)
        unpacker.feed(part)
        try:
            return _stamp_in(unpacker)
        except msgpack.OutOfData:
            continue
        except (ValueError, TypeError, msgpack.UnpackException):  # not a message
            return None
    return None


def _stamp_in(unpacker: msgpack.Unpacker) -> int | None:
    for _ in range(unpacker.read_map_header()):
        match unpacker.unpack():
            case "header":
                header = unpacker.unpack()
                stamp = header.get("stamp") if isinstance(header, dict) else None
                return stamp if isinstance(stamp, int) and stamp > 0 else None
            case "transforms":  # TFMessage has one header for each transform
                return _stamp_in(unpacker) if unpacker.read_array_header() else None
            case _:
                unpacker.skip()
    return None


class Delays:
    """How old messages were when they came."""

    def __init__(self) -> None:
        """Nothing came yet."""
        self.total = 0
        self._recent: deque[tuple[float, float]] = deque()  # when it came [s], how old it was [ms]

    def add(self, now: float, delay: float) -> None:
        """Take note of a message that came at a time [s] with an age [ms]."""
        self.total += 1
        self._recent.append((now, delay))

    def figures(self, now: float) -> DelayFigures:
        """Mean, least, most, median and 99th percentile of what came lately [ms]; None where nothing did."""
        while self._recent and self._recent[0][0] < now - COVERED:
            self._recent.popleft()
        delays = sorted(delay for _, delay in self._recent)
        if not delays:
            return {"messages": self.total, "mean": None, "min": None, "max": None, "p50": None, "p99": None}
        return {
            "messages": self.total,
            "mean": round(sum(delays) / len(delays), 3),
            "min": round(delays[0], 3),
            "max": round(delays[-1], 3),
            "p50": round(_quantile(delays, 0.5), 3),
            "p99": round(_quantile(delays, 0.99), 3),
        }


def _quantile(ordered: list[float], fraction: float) -> float:
    """The value below which a fraction of the values lies, interpolated between neighbours."""
    place = fraction * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)


class TopicStatistics:
    """Takes the messages of one key as the network hands them over, on any thread."""

    def __init__(self, clock: Clock) -> None:
        """Begin with nothing.

        Args:
            clock: the cell's: stamps are its times.
        """
        self.unstamped = 0
        self._clock = clock
        self._arrivals = Arrivals()
        self._delays = Delays()
        from common.transport.reader import SequenceFilter

        self._newness = SequenceFilter()
        self._lock = threading.Lock()

    def know(self, sample: RawSample) -> None:
        """Take note of the value of a state that was said before: its repetitions are no news."""
        with self._lock:
            self._newness.is_new_payload(sample.attachment)

    def arrive(self, sample: RawSample) -> None:
        """Take a message."""
        now, stamp = time.monotonic(), stamp_of(sample.payload)
        with self._lock:
            self._arrivals.add(now, len(sample.payload))
            if stamp is None:
                self.unstamped += 1
            elif self._newness.is_new_payload(sample.attachment):  # a state that is put again was made long ago
                self._delays.add(now, self._clock.age_ms(stamp))

    def arrivals(self) -> Figures:
        """Rate and size of what came lately."""
        with self._lock:
            return self._arrivals.figures(time.monotonic())

    def delays(self) -> DelayFigures:
        """Wall time [ms] from stamp to arrival of what came lately."""
        with self._lock:
            return self._delays.figures(time.monotonic())
