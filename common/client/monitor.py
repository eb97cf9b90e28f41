"""Figures of a cell that is up, by service and by topic, gathered without asking more of the cell than it sends."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from common.application import all_topics, applications
from common.client.statistics import TopicStatistics
from common.remapping import is_key

if TYPE_CHECKING:
    import psutil

    from common.clock import Clock
    from common.messages import ServiceCounters, ServiceStatus, SupervisorStatus
    from common.transport.bus import Bus

SUPERVISOR, ROUTER = "supervisor", "router"
ASK_TIMEOUT = 1.0  # [s]
MAX_KEYS = 300  # that are listened to


@dataclass
class ServiceRow:
    """One process. What is not known, as of a service on another host, is None."""

    service: str
    state: str
    pid: int | None = None
    cpu: float | None = None  # [%] of one core
    memory: float | None = None  # resident [MB]
    restarts: int = 0
    received: float | None = None  # [1/s]
    dropped: int | None = None  # since it was started
    invalid: int | None = None
    overflow: int | None = None


@dataclass
class TopicRow:
    """One key. Ages are wall time from the stamp to the arrival here."""

    topic: str
    hz: float
    bytes_per_second: float | None
    messages: int | None  # that came since we listen
    p50: float | None  # [ms]
    p99: float | None  # [ms]


@dataclass
class View:
    """What is shown at one moment."""

    cell: str
    speed: float
    connected: bool
    own_cpu: float  # [%] of one core, of this tool
    services: list[ServiceRow] = field(default_factory=list)
    topics: list[TopicRow] = field(default_factory=list)
    notices: list[tuple[bool, str]] = field(default_factory=list)  # whether urgent, and a line

    def as_dict(self) -> dict[str, Any]:
        """The view as JSON can hold it."""
        return asdict(self)


class CellMonitor:
    """Listens to a cell inside an `async with`; `view` says what was heard."""

    def __init__(self, bus: Bus, clock: Clock) -> None:
        """Subscribe to what the cell sends anyway.

        Args:
            bus: in the cell.
            clock: the cell's.
        """
        from common import topics
        from common.client.rates import Rates

        self._bus = bus
        self._clock = clock
        self._known = all_topics()
        self._on_demand = on_demand()
        self._hearing: dict[str, TopicStatistics] = {}
        self._rates = Rates()
        self._processes = Processes()
        self._alive = bus.alive
        self._status = bus.reader(topics.SUPERVISOR_STATUS)
        self._counters = bus.reader(topics.COUNTERS)
        self._following: asyncio.Task[None] | None = None

    async def __aenter__(self) -> CellMonitor:
        states = {key: topic.expression for key, topic in self._known.items() if topic.kind == "state"}
        latched = await asyncio.gather(
            *(self._bus.raw_get(f"{self._bus.cell}/{expression}", ASK_TIMEOUT) for expression in states.values()))
        said = dict(zip(states, latched, strict=True))
        for key, topic in self._known.items():
            if topic.kind != "request" and key not in self._on_demand:
                self._listen(key, topic.expression)
                for sample in said.get(key, ()):
                    self._hearing[key].know(sample)
        self._following = asyncio.create_task(self._follow_counters())
        self.view()  # from here on CPU is measured
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._following is not None:
            self._following.cancel()
            await asyncio.wait({self._following})

    def _listen(self, key: str, expression: str = "") -> None:
        hearing = self._hearing[key] = TopicStatistics(self._clock)
        self._bus.raw_subscriber(f"{self._bus.cell}/{expression or key}", hearing.arrive)

    async def _follow_counters(self) -> None:
        async for counters in self._counters:
            self.count(counters, time.monotonic())

    def count(self, counters: ServiceCounters, now: float) -> None:
        """Take note of what a service has counted until a time [s]; keys of a person's own are listened to from now."""
        self._rates.update(counters, now)
        for key in counters.received:
            known = key in self._hearing or key in self._known or key.startswith("param/")
            if not known and is_key(key) and len(self._hearing) < MAX_KEYS:  # whoever counts may say anything
                self._listen(key)

    def view(self) -> View:
        """What is known now."""
        status = self._status.latest
        alive = self._alive.names
        found = View(self._bus.cell, self._clock.speed, self._bus.connected, self._processes.own_cpu())
        found.services = [self._service_row(each) for each in statuses(status, alive, self._bus.connected)]
        found.topics = list(self._topic_rows())
        found.notices = [(each.urgent, each.message) for each in (status.notices if status else ())]
        return found

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
        for key, hearing in self._hearing.items():
            arrived, aged = hearing.arrivals(), hearing.delays()
            if arrived["messages"]:
                yield TopicRow(
                    key, float(arrived["hz"] or 0), float(arrived["bytes_per_second"] or 0), int(arrived["messages"]),
                    aged["p50"], aged["p99"],
                )
        for key in self._on_demand:
            if rate := self._rates.of_topic(key):
                yield TopicRow(key, round(rate, 3), None, None, None, None)


def on_demand() -> list[str]:
    """Keys of what is made only while somebody listens: if we did, the cell would work more.

    Those are clouds of points, and pictures into which what was found is drawn. Their rates are those of their readers.
    """
    from common.topics import DEPTH_CAMERA_POINTS

    drawn = [found.topics.annotated for found in applications() if found.topics is not None]
    return [topic.key for topic in (*drawn, DEPTH_CAMERA_POINTS) if topic is not None and topic.kind == "stream"]


def statuses(status: SupervisorStatus | None, alive: frozenset[str], connected: bool) -> list[ServiceStatus]:
    """The processes of a cell: those that the supervisor has, and those that are ready without it.

    Args:
        status: what the supervisor said last; None where there is none.
        alive: services that hold a readiness token.
        connected: whether the router is reached.
    """
    from common.messages import ServiceStatus

    found: list[ServiceStatus] = []
    for each in status.services if status else []:
        there = connected if each.name == ROUTER else each.name in alive or SUPERVISOR in alive
        found.append(each if there else each.model_copy(update={"state": "stopped", "pid": None}))
    known = {each.name for each in found}
    return found + [ServiceStatus(name=name, state="ready") for name in sorted(alive - known)]


class Processes:
    """Load of the processes of this host."""

    def __init__(self) -> None:
        """Measure from the first question on."""
        import psutil

        self._psutil = psutil
        self._known: dict[int, psutil.Process] = {}
        self._own = psutil.Process(os.getpid())

    def own_cpu(self) -> float:
        """CPU [% of one core] of this process since the last question."""
        return self._own.cpu_percent()

    def load_of(self, pid: int, service: str) -> tuple[float | None, float | None]:
        """CPU [% of one core] since the last question, and memory [MB], of a service; None when it is not here."""
        try:
            process = self._known.get(pid)
            if process is None or not process.is_running():
                process = self._psutil.Process(pid)
                # The same number may be another process here when the service is on another host.
                if service != SUPERVISOR and not any(part.rpartition(".")[2] == service for part in process.cmdline()):
                    return None, None
                self._known[pid] = process
            with process.oneshot():
                return process.cpu_percent(), process.memory_info().rss / 1e6
        except self._psutil.Error:
            self._known.pop(pid, None)
            return None, None

    def parent_of(self, services: list[ServiceStatus]) -> int | None:
        """The process that started the services, when it is on this host."""
        for each in services:
            if each.pid is not None and each.pid in self._known:
                try:
                    return self._known[each.pid].ppid()
                except self._psutil.Error:
                    continue
        return None
