"""Statistics of messages over a sliding window: rate, size and delay of a key, and rates from services' counters."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import msgpack

from common.errors import RequestFailed
from common.messages import ServiceCounters

if TYPE_CHECKING:
    from common.clock import Clock
    from common.transport.bus import Bus
    from common.transport.session import RawSample

PERIOD = 1.0  # [s] between two lines
WINDOW = 5.0  # [s] that the statistics cover, at most
QUERY_TIMEOUT = 1.0  # [s]
HEADER_BYTES = 256  # that contain the header of our messages; the rest may be an image
MOST_SERVICES = 100  # counters that are stored, newest first: any client of the network can invent names

Figures = dict[str, float | int | None]


class Window:
    """Values with their times of arrival, within the last `WINDOW` seconds."""

    def __init__(self) -> None:
        """Start empty."""
        self.total = 0
        self._recent: deque[tuple[float, float]] = deque()  # time of arrival [s], value

    def add(self, now: float, value: float) -> None:
        """Add a value that arrived at a time [s]."""
        self.total += 1
        self._recent.append((now, value))

    def recent(self, now: float) -> list[tuple[float, float]]:
        """Return time of arrival [s] and value of each arrival in the window before `now` [s]."""
        while self._recent and self._recent[0][0] < now - WINDOW:
            self._recent.popleft()
        return list(self._recent)


class Arrivals(Window):
    """Times of arrival and sizes [B] of messages."""

    def figures(self, now: float) -> Figures:
        """Return rate [Hz], shortest and longest interval [s], bytes per message and per second."""
        recent = self.recent(now)
        times = [when for when, _ in recent]
        gaps = [later - earlier for earlier, later in pairwise(times)]
        span = times[-1] - times[0] if gaps else 0.0
        rate = len(gaps) / span if span > 0 else 0.0
        size = sum(size for _, size in recent) / len(recent) if recent else 0.0
        return {
            "messages": self.total,
            "hz": round(rate, 3),
            "min": round(min(gaps), 6) if gaps else None,
            "max": round(max(gaps), 6) if gaps else None,
            "bytes": round(size, 1),
            "bytes_per_second": round(rate * size, 1),
        }


class Delays(Window):
    """Ages [ms] of messages when they arrived."""

    def figures(self, now: float) -> Figures:
        """Return mean, extremes, median and 99th percentile [ms]; None if nothing arrived in the window."""
        delays = sorted(delay for _, delay in self.recent(now))
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
    """Return the quantile of sorted values, interpolated linearly between neighbours."""
    position = fraction * (len(ordered) - 1)
    low = int(position)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (position - low)


def stamp_of(payload: bytes) -> int | None:
    """Return the cell time [ns] in the header of a message, or of its first transform; None without one."""
    for part in (payload[:HEADER_BYTES], payload):
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
            case "transforms":  # a TFMessage has one header for each transform
                return _stamp_in(unpacker) if unpacker.read_array_header() else None
            case _:
                unpacker.skip()
    return None


class TopicStatistics:
    """Statistics of one key, fed by the network on any thread."""

    def __init__(self, clock: Clock) -> None:
        """Start empty, with the clock of the cell, to which stamps refer."""
        from common.transport.reader import SequenceFilter

        self.unstamped = 0
        self._clock = clock
        self._arrivals, self._delays = Arrivals(), Delays()
        self._newness = SequenceFilter()
        self._lock = threading.Lock()

    def mark_known(self, sample: RawSample) -> None:
        """Record the current value of a state, whose repetitions do not count as delays."""
        with self._lock:
            self._newness.is_new_payload(sample.attachment)

    def add(self, sample: RawSample) -> None:
        """Add a message."""
        now, stamp = time.monotonic(), stamp_of(sample.payload)
        with self._lock:
            self._arrivals.add(now, len(sample.payload))
            if stamp is None:
                self.unstamped += 1
            elif self._newness.is_new_payload(sample.attachment):  # a repeated state has an old stamp
                self._delays.add(now, self._clock.age_ms(stamp))

    def arrivals(self) -> Figures:
        """Return rate and size."""
        with self._lock:
            return self._arrivals.figures(time.monotonic())

    def delays(self) -> Figures:
        """Return wall time [ms] from stamp to arrival."""
        with self._lock:
            return self._delays.figures(time.monotonic())


class NoStamp(RequestFailed):
    """The messages of a key have no stamp."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key}: its messages have no header with a stamp, so their delay is unknown")


async def watch_statistics(bus: Bus, key: str, kind: str, *, known: bool) -> AsyncGenerator[tuple[Figures, str], None]:
    """Yield figures of a key of the cell every second, and a line of text about them.

    Args:
        bus: in the cell.
        key: without the cell.
        kind: a name of `KINDS`: hz, bw or delay.
        known: whether the project describes the key; an unknown one must have messages.

    Raises:
        SilentKey: no message arrives on an unknown key.
        NoStamp: the messages have no stamp, and the delay is requested.
    """
    from common.client.joining import cell_clock
    from common.client.keys import require_messages

    full, delay = f"{bus.cell}/{key}", kind == "delay"
    statistics = TopicStatistics(await cell_clock(bus) if delay else bus.clock)
    if not known:
        await require_messages(bus, key)
    if delay:
        for sample in await bus.raw_get(full, QUERY_TIMEOUT):
            statistics.mark_known(sample)
    subscribed = bus.raw_subscriber(full, statistics.add)
    try:
        while True:
            await asyncio.sleep(PERIOD)
            if delay and statistics.unstamped:
                raise NoStamp(key)
            figures = statistics.delays() if delay else statistics.arrivals()
            yield figures, KINDS[kind](figures)
    finally:
        subscribed.undeclare()


def _describe_arrivals(figures: dict[str, Any], *, in_bytes: bool) -> str:
    if not figures["messages"]:
        return "no message received yet"
    if figures["min"] is None or figures["max"] is None:
        return f"{figures['messages']} messages, too few for a rate"
    if in_bytes:
        megabytes = (figures["bytes_per_second"] or 0) / 1e6
        return f"{megabytes:.3f} MB/s, {figures['bytes']:.0f} B each, {figures['hz']:.2f} Hz"
    apart = f"{figures['min'] * 1e3:.1f} to {figures['max'] * 1e3:.1f} ms apart"
    return f"{figures['hz']:.2f} Hz, {apart}, {figures['messages']} messages"


def _describe_delays(figures: dict[str, Any]) -> str:
    if not figures["messages"]:
        return "no new message received yet"
    if figures["mean"] is None:
        return f"no new message lately, {figures['messages']} messages"
    return (
        f"mean {figures['mean']:.2f} ms, min {figures['min']:.2f}, max {figures['max']:.2f}, "
        f"p99 {figures['p99']:.2f} ms, {figures['messages']} messages"
    )


KINDS: dict[str, Callable[[Figures], str]] = {
    "hz": lambda figures: _describe_arrivals(figures, in_bytes=False),
    "bw": lambda figures: _describe_arrivals(figures, in_bytes=True),
    "delay": _describe_delays,
}


class Rates:
    """Message rates from the counters that services publish, without subscribing to the topics themselves."""

    def __init__(self) -> None:
        """Start without counters."""
        self._counted: dict[str, tuple[float, ServiceCounters]] = {}  # by service: wall time [s] and counters
        self._rates: dict[str, dict[str, float]] = {}  # by reader and key [Hz], from its second counters on

    def update(self, counters: ServiceCounters, now: float) -> None:
        """Add the counters of a service at a wall time [s]."""
        known = self._counted.pop(counters.service, None)
        self._counted[counters.service] = now, counters
        if known is not None and now > known[0]:
            before, seconds = known[1].received, now - known[0]
            self._rates[counters.service] = {  # a restarted reader counts from zero
                key: max(0, count - before.get(key, count)) / seconds for key, count in counters.received.items()}
        for service in [*self._counted][: max(0, len(self._counted) - MOST_SERVICES)]:
            del self._counted[service]
            self._rates.pop(service, None)

    def counted(self, service: str) -> ServiceCounters | None:
        """Return the last counters of a service, or None."""
        return self._counted[service][1] if service in self._counted else None

    def received_by(self, service: str) -> float | None:
        """Return messages per second that a service receives [Hz]; None before its second counters."""
        return sum(self._rates[service].values()) if service in self._rates else None

    def of_topic(self, key: str) -> float:
        """Return the highest rate at which any reader receives a topic [Hz]."""
        return max((rates.get(key, 0.0) for rates in self._rates.values()), default=0.0)

    def busiest_of(self, service: str) -> tuple[str, float] | None:
        """Return the topic that a service writes most often, and its rate [Hz]; None without readers."""
        counted = self.counted(service)
        rates = [(self.of_topic(key), key) for key in (counted.writes if counted is not None else ())]
        rate, key = max(rates, default=(0.0, ""))
        return (key, rate) if rate > 0 else None
