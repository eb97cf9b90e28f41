"""Load of a running cell's services and rates of its topics, without adding load to the cell."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from common import topics
from common.application import all_topics, applications
from common.client.statistics import Rates, TopicStatistics
from common.messages import ServiceCounters, ServiceStatus, SupervisorStatus
from common.remapping import is_key

if TYPE_CHECKING:
    import psutil

    from common.clock import Clock
    from common.transport.bus import Bus

SUPERVISOR, ROUTER = "supervisor", "router"
QUERY_TIMEOUT = 1.0  # [s]
MAX_KEYS = 300  # subscriptions


@dataclass
class ServiceRow:
    """One process. Unknown values are None, such as those of a service on another host."""

    service: str
    state: str
    pid: int | None = None
    cpu: float | None = None  # [%] of one core
    memory: float | None = None  # resident [MB]
    restarts: int = 0
    received: float | None = None  # [1/s]
    dropped: int | None = None  # since its start
    invalid: int | None = None
    overflow: int | None = None


@dataclass
class TopicRow:
    """One key. Ages are wall time from the stamp to the arrival here."""

    topic: str
    hz: float
    bytes_per_second: float | None
    messages: int | None  # since the monitor was started
    p50: float | None  # [ms]
    p99: float | None  # [ms]


@dataclass
class View:
    """A snapshot of a cell."""

    cell: str
    speed: float
    connected: bool
    own_cpu: float  # [%] of one core, of this process
    services: list[ServiceRow] = field(default_factory=list)
    topics: list[TopicRow] = field(default_factory=list)
    notices: list[tuple[bool, str]] = field(default_factory=list)  # urgent or not, and a line

    def as_dict(self) -> dict[str, Any]:
        """Return the view as JSON."""
        return asdict(self)


class CellMonitor:
    """Subscribes to a cell inside `async with`; `view` returns a snapshot."""

    def __init__(self, bus: Bus, clock: Clock) -> None:
        """Subscribe to topics that the cell publishes in any case.

        Args:
            bus: in the cell.
            clock: of the cell.
        """
        self._bus = bus
        self._clock = clock
        self._known = all_topics()
        self._on_demand = on_demand()
        self._statistics: dict[str, TopicStatistics] = {}
        self._rates = Rates()
        self._processes = Processes()
        self._alive = bus.alive
        self._status = bus.reader(topics.SUPERVISOR_STATUS)
        self._counters = bus.reader(topics.COUNTERS)
        self._following: asyncio.Task[None] | None = None

    async def __aenter__(self) -> CellMonitor:
        states = {key: topic.expression for key, topic in self._known.items() if topic.kind == "state"}
        latched = await asyncio.gather(
            *(self._bus.raw_get(f"{self._bus.cell}/{expression}", QUERY_TIMEOUT) for expression in states.values()))
        values = dict(zip(states, latched, strict=True))
        for key, topic in self._known.items():
            if topic.kind != "request" and key not in self._on_demand:
                self._subscribe(key, topic.expression)
                for sample in values.get(key, ()):
                    self._statistics[key].mark_known(sample)
        self._following = asyncio.create_task(self._follow_counters())
        self.view()  # starts the measurement of CPU
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._following is not None:
            self._following.cancel()
            await asyncio.wait({self._following})

    def _subscribe(self, key: str, expression: str = "") -> None:
        statistics = self._statistics[key] = TopicStatistics(self._clock)
        self._bus.raw_subscriber(f"{self._bus.cell}/{expression or key}", statistics.add)

    async def _follow_counters(self) -> None:
        async for counters in self._counters:
            self.count(counters, time.monotonic())

    def count(self, counters: ServiceCounters, now: float) -> None:
        """Add the counters of a service at a time [s]; subscribe to custom keys that they name."""
        self._rates.update(counters, now)
        for key in counters.received:
            known = key in self._statistics or key in self._known or key.startswith("param/")
            if not known and is_key(key) and len(self._statistics) < MAX_KEYS:  # counters can name invented keys
                self._subscribe(key)

    def view(self) -> View:
        """Return a snapshot."""
        status = self._status.latest
        alive = self._alive.names
        view = View(self._bus.cell, self._clock.speed, self._bus.connected, self._processes.own_cpu())
        view.services = [self._service_row(each) for each in statuses(status, alive, self._bus.connected)]
        view.topics = list(self._topic_rows())
        view.notices = [(each.urgent, each.message) for each in (status.notices if status else ())]
        return view

    def _service_row(self, status: ServiceStatus) -> ServiceRow:
        row = ServiceRow(status.name, status.state, restarts=status.restarts)
        row.pid = status.pid
        if status.name == SUPERVISOR and self._status.latest is not None:
            row.pid = self._processes.parent_of(self._status.latest.services)
        if row.pid is not None:
            row.cpu, row.memory = self._processes.load_of(row.pid, status.name)
        row.received = self._rates.received_by(status.name)
        if (counted := self._rates.counted(status.name)) is not None:
            row.dropped, row.invalid, row.overflow = (
                sum(numbers.values()) for numbers in (counted.dropped, counted.invalid, counted.overflow)
            )
        return row

    def _topic_rows(self) -> Iterable[TopicRow]:
        for key, statistics in self._statistics.items():
            arrived, aged = statistics.arrivals(), statistics.delays()
            if arrived["messages"]:
                yield TopicRow(
                    key, float(arrived["hz"] or 0), float(arrived["bytes_per_second"] or 0), int(arrived["messages"]),
                    aged["p50"], aged["p99"],
                )
        for key in self._on_demand:
            if rate := self._rates.of_topic(key):
                yield TopicRow(key, round(rate, 3), None, None, None, None)


def on_demand() -> list[str]:
    """Return keys that are published only while they have subscribers; a subscription would load the cell.

    These are point clouds and annotated images. Their rates are those of their readers.
    """
    drawn = [found.topics.annotated for found in applications() if found.topics is not None]
    return [topic.key for topic in (*drawn, topics.DEPTH_CAMERA_POINTS) if topic is not None and topic.kind == "stream"]


def statuses(status: SupervisorStatus | None, alive: frozenset[str], connected: bool) -> list[ServiceStatus]:
    """Return the processes of a cell: those of the supervisor, and services that are ready without it.

    Args:
        status: last status of the supervisor; None without one.
        alive: services that hold a readiness token.
        connected: whether the router is reached.
    """
    found: list[ServiceStatus] = []
    for each in status.services if status else []:
        there = connected if each.name == ROUTER else each.name in alive or SUPERVISOR in alive
        found.append(each if there else each.model_copy(update={"state": "stopped", "pid": None}))
    known = {each.name for each in found}
    return found + [ServiceStatus(name=name, state="ready") for name in sorted(alive - known)]


class Processes:
    """Load of the processes of this host."""

    def __init__(self) -> None:
        """Start to measure this process."""
        import psutil

        self._psutil = psutil
        self._known: dict[int, psutil.Process] = {}
        self._own = psutil.Process(os.getpid())

    def own_cpu(self) -> float:
        """Return CPU [% of one core] of this process since the last call."""
        return self._own.cpu_percent()

    def load_of(self, pid: int, service: str) -> tuple[float | None, float | None]:
        """Return CPU [% of one core] since the last call, and memory [MB], of a service; None on another host."""
        try:
            process = self._known.get(pid)
            if process is None or not process.is_running():
                process = self._psutil.Process(pid)
                # If the service runs on another host, this number belongs to another process here.
                if service != SUPERVISOR and not any(part.rpartition(".")[2] == service for part in process.cmdline()):
                    return None, None
                self._known[pid] = process
            with process.oneshot():
                return process.cpu_percent(), process.memory_info().rss / 1e6
        except self._psutil.Error:
            self._known.pop(pid, None)
            return None, None

    def parent_of(self, services: list[ServiceStatus]) -> int | None:
        """Return the process that started the services, if it runs on this host."""
        for each in services:
            if each.pid is not None and each.pid in self._known:
                try:
                    return self._known[each.pid].ppid()
                except self._psutil.Error:
                    continue
        return None
