"""How often each topic comes, from what its readers count: costs no subscription to the topic itself."""

from __future__ import annotations

from common.messages import ServiceCounters

MOST_SERVICES = 100  # that are known, those heard of last: whoever is on the network can make any number up


class Rates:
    """What services counted last, and with it messages per second of each topic and of the service that writes it."""

    def __init__(self) -> None:
        """Start with nothing counted."""
        self._counted: dict[str, tuple[float, ServiceCounters]] = {}  # by service: wall time [s], and what
        self._rates: dict[str, dict[str, float]] = {}  # by reader, once it has counted twice, and key [Hz]

    def update(self, counters: ServiceCounters, now: float) -> None:
        """Take note of what a service has received until a wall time [s]."""
        known = self._counted.pop(counters.service, None)
        self._counted[counters.service] = now, counters
        if known is not None and now > known[0]:
            before, seconds = known[1].received, now - known[0]
            self._rates[counters.service] = {  # a reader that was started again counts from zero
                key: max(0, count - before.get(key, count)) / seconds for key, count in counters.received.items()}
        for service in [*self._counted][: max(0, len(self._counted) - MOST_SERVICES)]:
            del self._counted[service]
            self._rates.pop(service, None)

    def counted(self, service: str) -> ServiceCounters | None:
        """What a service counted last; None when it is not known."""
        return self._counted[service][1] if service in self._counted else None

    def received_by(self, service: str) -> float | None:
        """Messages per second that a service gets [Hz]; None before it has counted twice."""
        return sum(self._rates[service].values()) if service in self._rates else None

    def of_topic(self, key: str) -> float:
        """Messages per second that the best served reader of a topic gets [Hz]."""
        return max((rates.get(key, 0.0) for rates in self._rates.values()), default=0.0)

    def busiest_of(self, service: str) -> tuple[str, float] | None:
        """The topic that a service writes most often, and its rate [Hz]; None when nobody reads from it."""
        counted = self.counted(service)
        rates = [(self.of_topic(key), key) for key in (counted.writes if counted is not None else ())]
        rate, key = max(rates, default=(0.0, ""))
        return (key, rate) if rate > 0 else None
