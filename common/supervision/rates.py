"""How often each topic comes, from what its readers count: costs no subscription to the topic itself."""

from __future__ import annotations

from common.messages import ServiceCounters


class Rates:
    """Messages per second of each topic and of the service that writes it."""

    def __init__(self) -> None:
        """Start with nothing counted."""
        self._written: dict[str, list[str]] = {}  # keys by service
        self._last: dict[tuple[str, str], tuple[float, int]] = {}  # by reader and key: wall time [s] and count
        self._rates: dict[tuple[str, str], float] = {}

    def update(self, counters: ServiceCounters, now: float) -> None:
        """Take note of what a service has received until a wall time [s]."""
        self._written[counters.service] = counters.writes
        for key, count in counters.received.items():
            pair = (counters.service, key)
            then, before = self._last.get(pair, (now, count))
            self._last[pair] = (now, count)
            if now > then:
                # A reader that was started again counts from zero.
                self._rates[pair] = max(0, count - before) / (now - then)

    def of_topic(self, key: str) -> float:
        """Messages per second that the best served reader of a topic gets [Hz]."""
        return max((rate for (_, k), rate in self._rates.items() if k == key), default=0.0)

    def busiest_of(self, service: str) -> tuple[str, float] | None:
        """The topic that a service writes most often, and its rate [Hz]; None when nobody reads from it."""
        rates = [(self.of_topic(key), key) for key in self._written.get(service, ())]
        rate, key = max(rates, default=(0.0, ""))
        return (key, rate) if rate > 0 else None
