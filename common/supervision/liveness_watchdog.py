"""Liveness of processes: which of them are silent too long, and the services that other hosts' supervisors report."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from common.config import Watchdogs
from common.messages import Notice, ServiceStatus, SupervisorStatus
from common.messages.basics import clean
from common.time_source import WatchdogClock
from common.transport.session import ROUTER

PERIOD = 0.25  # [s] between two checks
LEASE = 2.0  # [s] after which a connection without traffic counts as lost
# Limits of what is stored from other hosts, newest first: any client of the network can invent names, and all of them
# have to fit in our status message.
MOST_ELSEWHERE = 80  # services
MOST_HOSTS, MOST_NOTICES = 10, 20  # with notices
LONGEST = 150  # characters of a line


@dataclass(frozen=True)
class Verdict:
    """A process to kill, and the reason."""

    name: str
    reason: str


@dataclass
class _LastSign:
    pid: int | None
    state: str
    since: float  # process uptime [s] of the newest sign of life
    waited: float  # for a processor until then [s]


class LivenessWatchdog:
    """Measures the silence of each process, in time in which this process was awake and connected.

    Each ready service publishes its counters every second. Time in which a process waited for a processor does not
    count: on an overloaded machine no process is frozen. Without the router no service can be received, so then only
    the router is blamed; nor is a single service blamed when all of them are silent.
    """

    def __init__(self, watchdogs: Watchdogs) -> None:
        """Start without any process."""
        self._limits = watchdogs
        self._awake = WatchdogClock(2 * PERIOD)
        self._signs: dict[str, _LastSign] = {}
        self._waited: Mapping[str, float] = {}
        self._router_blamed = False

    def seen(self, name: str) -> None:
        """Record a sign of life of a service."""
        self._router_blamed = False
        if name in self._signs:
            self._restart(self._signs[name], name)

    def check(
        self, now: float, connected: bool, processes: Sequence[ServiceStatus], stopped: Collection[str] = (),
        waited: Mapping[str, float] = MappingProxyType({}),
    ) -> list[Verdict]:
        """Return the processes to kill now.

        Args:
            now: monotonic time [s].
            connected: whether the router is reached.
            processes: those that are restarted when they end.
            stopped: names of stopped processes (SIGSTOP).
            waited: total time that each process has waited for a processor [s]; 0 if unknown.
        """
        awake, self._waited = self._awake.advance(now), waited
        if not self._limits.silence:
            return []
        verdicts = []
        for process in processes:
            silent = self._silence(process, connected, awake)
            limit = self._limits.silence
            if process.name == ROUTER:  # its loss is noticed only after it has been silent for a lease
                limit = max(limit - LEASE, limit / 2)
            start_limit = self._limits.silence if process.name in stopped else self._limits.start
            if process.state == "starting" and silent > start_limit:
                verdicts.append(Verdict(process.name, f"was restarted {silent:.0f} s ago and is not ready"))
            elif process.state == "ready" and silent > limit:
                what = "does not answer" if process.name == ROUTER else "has sent nothing"
                verdicts.append(Verdict(process.name, f"{what} for {silent:.1f} s"))
        return self._blame_router(verdicts, processes, awake)

    def _silence(self, process: ServiceStatus, connected: bool, awake: float) -> float:
        known = self._signs.get(process.name)
        router = process.name == ROUTER
        # A connection proves that the router lives; without one no service can be received.
        blameless = connected if router and process.state == "ready" else not connected and not router
        if known is None or blameless or (known.pid, known.state) != (process.pid, process.state):
            known = self._signs[process.name] = _LastSign(process.pid, process.state, awake, 0.0)
            self._restart(known, process.name)
        waited = max(self._waited.get(process.name, 0.0) - known.waited, 0.0)  # 0 for a process that just ended
        return awake - known.since - waited

    def _restart(self, known: _LastSign, name: str) -> None:
        known.since, known.waited = self._awake.now, self._waited.get(name, 0.0)

    def _blame_router(
        self, verdicts: list[Verdict], processes: Sequence[ServiceStatus], awake: float
    ) -> list[Verdict]:
        """Replace the verdicts on services by one on the router if all services are silent."""
        ready = [process.name for process in processes if process.state == "ready" and process.name != ROUTER]
        silent = {verdict.name for verdict in verdicts}
        recent = [name for name in ready if awake - self._signs[name].since < self._limits.silence / 2]
        if not silent & set(ready) or recent or len(ready) < 2 or self._router_blamed:
            return verdicts
        self._router_blamed = True
        for name in ready:
            self._restart(self._signs[name], name)
        if any(process.name == ROUTER and process.state == "ready" for process in processes):
            return [Verdict(ROUTER, "passes on nothing from any service")]
        return []


class RemoteServices:
    """The services of a cell that supervisors on other hosts run."""

    def __init__(self, host: str, own: Collection[str]) -> None:
        """Start without any.

        Args:
            host: name of this host.
            own: names of the services that run here.
        """
        self.host, self._own = host, frozenset(own)
        self._services: dict[str, ServiceStatus] = {}  # by name, the newest at the end
        self._notices: dict[str, list[Notice]] = {}  # by host, the newest at the end
        self._first_host = host  # in alphabetical order

    def update(self, status: SupervisorStatus) -> None:
        """Store what a supervisor reports of its own host; what it passes on from other hosts is ignored."""
        self._first_host = min(self._first_host, status.host)
        if status.host != self.host:
            self._notices.pop(status.host, None)
            self._notices[status.host] = [
                each.model_copy(update={"message": clean(each.message, LONGEST)})
                for each in status.notices if each.host == status.host
            ][:MOST_NOTICES]
        for service in status.services:
            if service.name not in self._own and service.host == status.host:
                self._services.pop(service.name, None)
                self._services[service.name] = service.model_copy(update={"message": clean(service.message, LONGEST)})
        for name in [*self._services][: max(0, len(self._services) - MOST_ELSEWHERE)]:
            del self._services[name]
        for host in [*self._notices][: max(0, len(self._notices) - MOST_HOSTS)]:
            del self._notices[host]

    def statuses(self, alive: Collection[str]) -> list[ServiceStatus]:
        """Return the status of each; those of an unreachable host are `waiting`.

        Args:
            alive: names of the services whose readiness tokens exist.
        """
        return [
            service if service.name in alive or service.state != "ready" else service.model_copy(update={
                "state": "waiting", "message": f"host {service.host} is not reached",
            })
            for service in self._services.values()
        ]

    @property
    def notices(self) -> list[Notice]:
        """Changes that other hosts announced."""
        return [each for host in sorted(self._notices) for each in self._notices[host]][:MOST_NOTICES]

    def is_copied_here(self, service: str) -> bool:
        """Return whether this host copies messages of a service; unsupervised services belong to the first host."""
        return service in self._own or (service not in self._services and self._first_host == self.host)

    def ours(self, services: Collection[ServiceStatus]) -> list[ServiceStatus]:
        """Return statuses of this host with its name."""
        return [service.model_copy(update={"host": self.host}) for service in services]
