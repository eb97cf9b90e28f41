"""In-process network whose links delay, lose, duplicate and cut messages as the seed decides.

It keeps to what Zenoh may do: messages of one session under one key arrive at another session in order; messages of
other sessions or keys may arrive before or after. Only streams are lost while a link is up. What a cut link carried is
lost. A session with an open request over a cut link, or to a session behind one, is notified that no reply comes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from contextvars import Context
from dataclasses import dataclass
from functools import partial

import numpy as np

from common.transport.local import Lane, LocalNetwork, LocalSession, intersects
from common.transport.session import Declaration, OnSample, RawSample
from lab.loop import VirtualTimeLoop

Link = tuple["SimulatedSession", "SimulatedSession", Lane, str]

SOON = 1e-9  # [s] between two messages whose order must not change


@dataclass(frozen=True)
class LinkQuality:
    """Behaviour of links; delays in [s], the rest shares of the messages.

    Attributes:
        delay: mean of an exponential distribution.
        hiccup, hiccup_delay: share of delayed messages and largest delay; messages that follow under the key wait too.
        loss: lost messages of streams.
        duplicated: put messages that arrive twice.
        late, late_delay: share of delayed requests and replies, and largest delay.
    """

    delay: float = 0.0003
    hiccup: float = 0.0
    hiccup_delay: float = 0.3
    loss: float = 0.0
    duplicated: float = 0.0
    late: float = 0.0
    late_delay: float = 1.8


GOOD_LINKS = LinkQuality()
POOR_LINKS = LinkQuality(delay=0.001, hiccup=0.001, loss=0.01, duplicated=0.005)


class SimulatedSession(LocalSession):
    """Session whose link to the router may be cut, and whose process may crash."""

    def __init__(self, network: SimulatedNetwork, context: Context, name: str, number: int) -> None:
        """Connect to the network; callbacks run in the context of the process with this name and number."""
        super().__init__(network)
        self.name, self.instance = name, f"{name} {number}"
        self.context = context
        self.cut = False
        self.detached = False
        self.cuts = 0  # of its link so far; messages sent before a cut are lost
        self.latest_due = 0.0  # [s] arrival time of the last message on its way here
        self.slow = 0.0  # [s] additional mean delay of all its messages
        self.stalled_until = 0.0  # [s] before which nothing passes its link
        self._on_change: list[Callable[[], None]] = []

    @property
    def connected(self) -> bool:
        """Whether the link is up."""
        return not self.cut and not self.detached

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Call back whenever the link is cut or restored."""
        self._on_change.append(on_change)

    def subscriber(self, key: str, on_sample: OnSample) -> Declaration:
        """Call back for each value put under a matching key."""
        _simulated_network(self.network).on_subscribe(self, key)
        return super().subscriber(key, on_sample)

    def report_connection(self) -> None:
        """Let the process check its link."""
        for on_change in self._on_change:
            self.context.run(on_change)


class SimulatedNetwork(LocalNetwork):
    """Network of one simulated cell."""

    def __init__(self, loop: VirtualTimeLoop, seed: int, links: LinkQuality = GOOD_LINKS) -> None:
        """Create a network with links of this quality."""
        super().__init__()
        self.counted: Counter[str] = Counter()  # what the links did to messages
        self.links = links
        self.router_lost = False
        self.on_put: Callable[[SimulatedSession, RawSample], None] = lambda session, sample: None
        self.on_subscribe: Callable[[SimulatedSession, str], None] = lambda session, key: None
        self._loop = loop
        self._random = np.random.default_rng([seed, 3])
        self._drawn: list[float] = []
        self._arrival: dict[Link, float] = {}
        self._next_delay: dict[tuple[SimulatedSession, SimulatedSession, str], float] = {}  # [s]
        self._sessions: list[SimulatedSession] = []

    def attach(self, context: Context, name: str, number: int = 0) -> SimulatedSession:
        """Return a new session of a process."""
        session = SimulatedSession(self, context, name, number)
        session.cut = self.router_lost
        self._sessions.append(session)
        return session

    def observe_put(self, session: LocalSession, sample: RawSample) -> None:
        """Pass a put message to the observer."""
        self.on_put(_simulated(session), sample)

    # --- messages -----------------------------------------------------------------------------------------------------

    def send(self, source: LocalSession, target: LocalSession, lane: Lane, key: str, call: Callable[[], None]) -> None:
        """Deliver a message later, or lose it."""
        source, target = _simulated(source), _simulated(target)
        if source is target:  # to itself: that there was no responder, or that all tokens were delivered
            tokens = [due for (_, to, on, _), due in self._arrival.items() if to is target and on == lane == "token"]
            self._arrive_at(max([self._loop.time(), *tokens]), source, target, call)
            return
        if not source.connected or not target.connected:
            return
        links = self.links
        if lane == "stream" and links.loss and self._chance() < links.loss:
            self.counted["lost"] += 1
            return
        delay = self._delay()
        if slow := source.slow + target.slow:
            delay -= slow * math.log1p(-self._chance())
        if links.hiccup and self._chance() < links.hiccup:
            self.counted["delayed"] += 1
            delay += links.hiccup_delay * self._chance()
        if lane == "query":
            delay += self._next_delay.pop((source, target, key), 0.0)
            if links.late and self._chance() < links.late:
                self.counted["late"] += 1
                delay += links.late_delay * self._chance()
        # The router sends all tokens in one order, for all sessions.
        link = target if lane == "token" else source, target, lane, key
        self._deliver(link, source, delay, call)
        if links.duplicated and lane in ("stream", "reliable") and self._chance() < links.duplicated:
            self.counted["duplicated"] += 1
            self._deliver(link, source, 0.0, call)

    def _chance(self) -> float:
        if not self._drawn:
            self._drawn = self._random.random(1024).tolist()
        return self._drawn.pop()

    def _delay(self) -> float:
        return -self.links.delay * math.log1p(-self._chance())

    def _deliver(self, link: Link, source: SimulatedSession, delay: float, call: Callable[[], None]) -> None:
        sent = max(self._loop.time(), source.stalled_until, link[1].stalled_until)
        due = max(sent + delay, self._arrival.get(link, 0.0) + SOON)
        self._arrival[link] = due
        if due < link[1].latest_due:
            self.counted["reordered"] += 1
        else:
            link[1].latest_due = due
        self._arrive_at(due, source, link[1], call)

    def _arrive_at(
        self, due: float, source: SimulatedSession, target: SimulatedSession, call: Callable[[], None]
    ) -> None:
        cuts = source.cuts, target.cuts

        def arrive() -> None:
            if not target.detached and (source is target or (source.cuts, target.cuts) == cuts):
                call()

        self._loop.call_at(due, arrive, context=target.context)

    # --- cut links and crashed processes ------------------------------------------------------------------------------

    def cut(self, sessions: Iterable[SimulatedSession]) -> None:
        """Cut the links of sessions."""
        for session in sessions:
            if session.connected:
                session.cut = True
                session.cuts += 1
                for asked in list(session.pending):
                    self._arrive_at(self._loop.time(), session, session, asked.finish)
                self._notify_lost(session)
                for watcher, token in self._tokens_seen_by(session):
                    self._arrive_at(self._loop.time(), session, session, partial(watcher, token, False))
                session.report_connection()

    def stall(self, session: SimulatedSession, seconds: float) -> None:
        """Hold back everything that is sent to or from a session from now on."""
        session.stalled_until = max(session.stalled_until, self._loop.time() + seconds)

    def delay_next_query(self, source: SimulatedSession, target: SimulatedSession, key: str, seconds: float) -> None:
        """Delay the next request or reply under a key from one session to another [s]."""
        self._next_delay[source, target, key] = seconds

    def lose_router(self) -> None:
        """Cut all links, and those of processes that start meanwhile."""
        self.router_lost = True
        self.cut(list(self._sessions))

    def restore_router(self) -> None:
        """Restore all links."""
        self.router_lost = False
        self.mend(list(self._sessions))

    def mend(self, sessions: Iterable[SimulatedSession]) -> None:
        """Restore the links of sessions."""
        for session in sessions:
            if session.cut:
                session.cut = False
                session.report_connection()
                for entry in self.tokens:
                    if entry.session is session:
                        self.announce(session, entry.key, there=True)
                for watcher, token in self._tokens_seen_by(session):
                    self._arrive_at(self._loop.time(), session, session, partial(watcher, token, True))

    def detach(self, session: SimulatedSession) -> None:
        """Remove the session of a process that ended without undeclaring anything."""
        if session.detached:
            return
        session.detached = True
        self._notify_lost(session)
        for table in (self.publishers, self.subscribers, self.queryables, self.tokens, self.watchers):
            for entry in table:
                entry.declared = entry.session is not session
            table[:] = [entry for entry in table if entry.declared]
        self.clear_matches()
        self._sessions.remove(session)
        self._arrival = {link: due for link, due in self._arrival.items() if session not in link[:2]}
        self._next_delay = {link: late for link, late in self._next_delay.items() if session not in link[:2]}

    def _notify_lost(self, session: SimulatedSession) -> None:
        """Notify all other sessions that a session's tokens and the requests open to it are lost."""
        for other in [other for other in self._sessions if other is not session and other.connected]:
            for asked in list(other.pending):
                for query in [query for query in asked.open if query.responder is session]:
                    self._notify((session, other, "query", query.key), partial(asked.finish, query))
        for entry in self.tokens:
            if entry.session is not session or any(e.key == entry.key and e.session.connected for e in self.tokens):
                continue
            for watcher in self.matching(self.watchers, entry.key):
                other = _simulated(watcher.session)
                if other.connected and other is not session:
                    self._notify((other, other, "token", entry.key), partial(watcher.callback, entry.key, False))

    def _notify(self, link: Link, call: Callable[[], None]) -> None:
        """Deliver the router's notice of a lost session, after what that session sent before."""
        sent = max(self._loop.time(), link[1].stalled_until)
        due = max(sent + self._delay(), self._arrival.get(link, 0.0) + SOON)
        self._arrival[link] = due
        self._arrive_at(due, link[1], link[1], call)

    def _tokens_seen_by(self, session: SimulatedSession) -> list[tuple[Callable[[str, bool], None], str]]:
        """Return the tokens of others that the watchers of a session see while its link is up."""
        return [
            (watcher.callback, token)
            for watcher in self.watchers if watcher.session is session
            for token in dict.fromkeys(
                entry.key for entry in self.tokens
                if entry.session is not session and entry.session.connected and intersects(watcher.key, entry.key)
            )
        ]


def _simulated_network(network: LocalNetwork) -> SimulatedNetwork:
    assert isinstance(network, SimulatedNetwork)
    return network


def _simulated(session: LocalSession) -> SimulatedSession:
    assert isinstance(session, SimulatedSession)
    return session
