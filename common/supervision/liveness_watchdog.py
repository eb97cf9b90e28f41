"""Who is heard of: processes that fell silent, and what other hosts' supervisors say of their part of the cell."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from common.config import Watchdogs
from common.messages import Notice, ServiceStatus, SupervisorStatus
from common.messages.basics import clean
from common.time_source import WatchdogClock
from common.transport.session import ROUTER

PERIOD = 0.25  # [s] between two looks
LEASE = 2.0  # [s] after which a connection counts as lost on which nothing comes
# Of what other hosts say, that of last: whoever is on the network can make any number up, and all of it has to find
# room in a status of ours.
MOST_ELSEWHERE = 80  # services
MOST_HOSTS, MOST_NOTICES = 10, 20  # with notices
LONGEST = 150  # characters of a line


@dataclass(frozen=True)
class Verdict:
    """A process that is to be killed, and why."""

    name: str
    reason: str


@dataclass
class _Heard:
    pid: int | None
    state: str
    since: float  # waking time [s] of the newest sign of life
    waited: float  # for a processor until then [s]


class LivenessWatchdog:
    """Counts for how long each process has been silent, in time in which we ourselves were awake and connected.

    Time in which it waited for a processor does not count: on a machine that has too much to do nobody is frozen.
    A service that is ready says each second what it has counted. While the router is not reached nobody can be heard,
    so nobody is blamed but the router; nor is a single service when all of them fall silent at once.
    """

    def __init__(self, watchdogs: Watchdogs) -> None:
        """Blame nobody yet."""
        self._limits = watchdogs
        self._awake = WatchdogClock(2 * PERIOD)
        self._heard: dict[str, _Heard] = {}
        self._waited: Mapping[str, float] = {}
        self._router_blamed = False

    def heard(self, name: str) -> None:
        """Take note of a sign of life of a service."""
        self._router_blamed = False
        if name in self._heard:
            self._note(self._heard[name], name)

    def look(
        self, now: float, connected: bool, processes: Sequence[ServiceStatus], stopped: Collection[str] = (),
        waited: Mapping[str, float] = MappingProxyType({}),
    ) -> list[Verdict]:
        """Which processes are to be killed now.

        Args:
            now: what the clock says [s, monotonic].
            connected: whether the router is reached.
            processes: those that are started again when they end.
            stopped: names of those that the system does not run (SIGSTOP).
            waited: for how long each was kept waiting for a processor since it was started [s]; 0 where it is not told.
        """
        awake, self._waited = self._awake.advance(now), waited
        if not self._limits.silence:
            return []
        verdicts = []
        for process in processes:
            silent = self._silent(process, connected, awake)
            limit = self._limits.silence
            if process.name == ROUTER:  # when it is found to be lost, it has already been silent for a lease
                limit = max(limit - LEASE, limit / 2)
            start_limit = self._limits.silence if process.name in stopped else self._limits.start
            if process.state == "starting" and silent > start_limit:
                verdicts.append(Verdict(process.name, f"was started again {silent:.0f} s ago and is not ready"))
            elif process.state == "ready" and silent > limit:
                what = "does not answer" if process.name == ROUTER else "has not been heard"
                verdicts.append(Verdict(process.name, f"{what} for {silent:.1f} s"))
        return self._without_scapegoats(verdicts, processes, awake)

    def _silent(self, process: ServiceStatus, connected: bool, awake: float) -> float:
        known = self._heard.get(process.name)
        router = process.name == ROUTER
        # The router is there while we are connected; the others can be heard only then.
        blameless = connected if router and process.state == "ready" else not connected and not router
        if known is None or blameless or (known.pid, known.state) != (process.pid, process.state):
            known = self._heard[process.name] = _Heard(process.pid, process.state, awake, 0.0)
            self._note(known, process.name)
        waited = max(self._waited.get(process.name, 0.0) - known.waited, 0.0)  # nothing is told of one that just ended
        return awake - known.since - waited

    def _note(self, known: _Heard, name: str) -> None:
        known.since, known.waited = self._awake.now, self._waited.get(name, 0.0)

    def _without_scapegoats(
        self, verdicts: list[Verdict], processes: Sequence[ServiceStatus], awake: float
    ) -> list[Verdict]:
        ready = [process.name for process in processes if process.state == "ready" and process.name != ROUTER]
        silent = {verdict.name for verdict in verdicts}
        nobody = [name for name in ready if awake - self._heard[name].since < self._limits.silence / 2]
        if not silent & set(ready) or nobody or len(ready) < 2 or self._router_blamed:
            return verdicts
        self._router_blamed = True
        for name in ready:
            self._note(self._heard[name], name)
        if any(process.name == ROUTER and process.state == "ready" for process in processes):
            return [Verdict(ROUTER, "lets none of the services be heard")]
        return []


class Elsewhere:
    """The services of a cell that other supervisors keep."""

    def __init__(self, host: str, own: Collection[str]) -> None:
        """Know of none yet.

        Args:
            host: name of this host.
            own: names of the services that run here.
        """
        self.host, self._own = host, frozenset(own)
        self._heard: dict[str, ServiceStatus] = {}
        self._lately: dict[str, None] = {}  # names of these, that which was heard of last at the end
        self._notices: dict[str, list[Notice]] = {}  # by host
        self._first = host  # of the hosts that were heard of

    def hear(self, status: SupervisorStatus) -> None:
        """Take note of what a supervisor says of its own part; what it passes on is not news."""
        self._first = min(self._first, status.host)
        if status.host != self.host:
            self._notices.pop(status.host, None)
            self._notices[status.host] = [
                each.model_copy(update={"message": clean(each.message, LONGEST)})
                for each in status.notices if each.host == status.host
            ][:MOST_NOTICES]
        for service in status.services:
            if service.name not in self._own and service.host == status.host:
                self._heard[service.name] = service.model_copy(update={"message": clean(service.message, LONGEST)})
                self._lately.pop(service.name, None)
                self._lately[service.name] = None
        for name in [*self._lately][: max(0, len(self._lately) - MOST_ELSEWHERE)]:
            del self._lately[name], self._heard[name]
        for host in [*self._notices][: max(0, len(self._notices) - MOST_HOSTS)]:
            del self._notices[host]

    def statuses(self, alive: Collection[str]) -> list[ServiceStatus]:
        """All of them as they are now: a host that cannot be reached does not tell any more.

        Args:
            alive: names of the services whose readiness tokens are there.
        """
        return [
            service if service.name in alive or service.state != "ready" else service.model_copy(update={
                "state": "waiting", "message": f"on {service.host}, which is not reached",
            })
            for service in self._heard.values()
        ]

    @property
    def notices(self) -> list[Notice]:
        """What there is to know of other hosts."""
        return [each for host in sorted(self._notices) for each in self._notices[host]][:MOST_NOTICES]

    def is_told_here(self, service: str) -> bool:
        """Whether it is for this host, and for one only, to repeat what a service says: what nobody keeps is shared."""
        return service in self._own or (service not in self._heard and self._first == self.host)

    def ours(self, services: Collection[ServiceStatus]) -> list[ServiceStatus]:
        """Those of this host, with its name."""
        return [service.model_copy(update={"host": self.host}) for service in services]
