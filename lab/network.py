"""A network in process whose links take time, and lose, double and cut what travels, as the seed decides.

Within what Zenoh may do: what one session puts under one key reaches another in its order, whatever comes from others
or under other keys may come before or after it; only streams are lost while a link stands; what a cut link held is
lost; who asked over it, or asked somebody behind it, hears that nothing comes any more.
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
from common.transport.session import Declared, OnSample, RawSample
from lab.loop import VirtualTimeLoop

Link = tuple["SimulatedSession", "SimulatedSession", Lane, str]

SOON = 1e-9  # [s] between two messages that may not change places


@dataclass(frozen=True)
class LinkQuality:
    """What links do to what travels on them; delays in [s], the rest shares of the messages.

    Attributes:
        delay: mean of an exponential distribution.
        hiccup, hiccup_delay: a message that is held up, and for how long at most; what follows it under its key too.
        loss: of streams.
        doubled: of what is put.
        late, late_delay: a request or an answer that is held up, and for how long at most.
    """

    delay: float = 0.0003
    hiccup: float = 0.0
    hiccup_delay: float = 0.3
    loss: float = 0.0
    doubled: float = 0.0
    late: float = 0.0
    late_delay: float = 1.8


GOOD_LINKS = LinkQuality()
POOR_LINKS = LinkQuality(delay=0.001, hiccup=0.001, loss=0.01, doubled=0.005)


class SimulatedSession(LocalSession):
    """A session whose link to the router may be cut, and whose process may end without a word."""

    def __init__(self, network: SimulatedNetwork, context: Context, name: str, number: int) -> None:
        """Be connected; callbacks run in the context of the process, which has a name and a number of its own."""
        super().__init__(network)
        self.name, self.life = name, f"{name} {number}"
        self.context = context
        self.cut = False
        self.detached = False
        self.links = 0  # that were cut so far: what travelled on them is lost
        self.latest_due = 0.0  # [s] when the last of what is on its way to it arrives
        self.slow = 0.0  # [s] that all which comes or goes takes longer on average
        self.stalled_until = 0.0  # [s] before which nothing comes through its link
        self._on_change: list[Callable[[], None]] = []

    @property
    def connected(self) -> bool:
        """Whether the link stands."""
        return not self.cut and not self.detached

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Call back when the link was cut or stands again."""
        self._on_change.append(on_change)

    def subscriber(self, key: str, on_sample: OnSample) -> Declared:
        """Call back for each value put under a matching key."""
        _of(self.network).on_listen(self, key)
        return super().subscriber(key, on_sample)

    def tell_connection(self) -> None:
        """Have the process look at its link."""
        for on_change in self._on_change:
            self.context.run(on_change)


class SimulatedNetwork(LocalNetwork):
    """Where the sessions of one simulated cell meet."""

    def __init__(self, loop: VirtualTimeLoop, seed: int, weather: LinkQuality = GOOD_LINKS) -> None:
        """Bring what is sent in this weather."""
        super().__init__()
        self.counted: Counter[str] = Counter()  # what the weather did
        self.weather = weather
        self.router_lost = False
        self.on_put: Callable[[SimulatedSession, RawSample], None] = lambda session, sample: None
        self.on_listen: Callable[[SimulatedSession, str], None] = lambda session, key: None
        self._loop = loop
        self._random = np.random.default_rng([seed, 3])
        self._drawn: list[float] = []
        self._arrival: dict[Link, float] = {}
        self._lateness: dict[tuple[SimulatedSession, SimulatedSession, str], float] = {}  # [s] of the next that is sent
        self._sessions: list[SimulatedSession] = []

    def attach(self, context: Context, name: str, number: int = 0) -> SimulatedSession:
        """A session of a process."""
        session = SimulatedSession(self, context, name, number)
        session.cut = self.router_lost
        self._sessions.append(session)
        return session

    def notice(self, session: LocalSession, sample: RawSample) -> None:
        """Show what is put to who looks on."""
        self.on_put(_ours(session), sample)

    # --- on the way ---------------------------------------------------------------------------------------------------

    def send(self, source: LocalSession, target: LocalSession, lane: Lane, key: str, call: Callable[[], None]) -> None:
        """Bring something over later, or not at all."""
        source, target = _ours(source), _ours(target)
        if source is target:  # what a session tells itself: that nobody was asked, or that all tokens are told
            told = [due for (_, to, on, _), due in self._arrival.items() if to is target and on == lane == "token"]
            self._arrive_at(max([self._loop.time(), *told]), source, target, call)
            return
        if not source.connected or not target.connected:
            return
        weather = self.weather
        if lane == "stream" and weather.loss and self._chance() < weather.loss:
            self.counted["lost"] += 1
            return
        delay = self._delay()
        if slow := source.slow + target.slow:
            delay -= slow * math.log1p(-self._chance())
        if weather.hiccup and self._chance() < weather.hiccup:
            self.counted["held up"] += 1
            delay += weather.hiccup_delay * self._chance()
        if lane == "query":
            delay += self._lateness.pop((source, target, key), 0.0)
            if weather.late and self._chance() < weather.late:
                self.counted["late"] += 1
                delay += weather.late_delay * self._chance()
        # What the router says of tokens comes in its order, whoever they belong to.
        link = target if lane == "token" else source, target, lane, key
        self._bring(link, source, delay, call)
        if weather.doubled and lane in ("stream", "reliable") and self._chance() < weather.doubled:
            self.counted["doubled"] += 1
            self._bring(link, source, 0.0, call)

    def _chance(self) -> float:
        if not self._drawn:
            self._drawn = self._random.random(1024).tolist()
        return self._drawn.pop()

    def _delay(self) -> float:
        return -self.weather.delay * math.log1p(-self._chance())

    def _bring(self, link: Link, source: SimulatedSession, delay: float, call: Callable[[], None]) -> None:
        sent = max(self._loop.time(), source.stalled_until, link[1].stalled_until)
        due = max(sent + delay, self._arrival.get(link, 0.0) + SOON)
        self._arrival[link] = due
        if due < link[1].latest_due:
            self.counted["changed places"] += 1
        else:
            link[1].latest_due = due
        self._arrive_at(due, source, link[1], call)

    def _arrive_at(
        self, due: float, source: SimulatedSession, target: SimulatedSession, call: Callable[[], None]
    ) -> None:
        links = source.links, target.links

        def arrive() -> None:
            if not target.detached and (source is target or (source.links, target.links) == links):
                call()

        self._loop.call_at(due, arrive, context=target.context)

    # --- links that are cut, processes that end -----------------------------------------------------------------------

    def cut(self, sessions: Iterable[SimulatedSession]) -> None:
        """Cut the links of sessions; all links stand for a router that is lost."""
        for session in sessions:
            if session.connected:
                session.cut = True
                session.links += 1
                for asked in list(session.asking):
                    self._arrive_at(self._loop.time(), session, session, asked.finish)
                self._lose(session)
                for watcher, token in self._seen_by(session):
                    self._arrive_at(self._loop.time(), session, session, partial(watcher, token, False))
                session.tell_connection()

    def stall(self, session: SimulatedSession, seconds: float) -> None:
        """Have everything that is sent from or to a session from now on come later, but come."""
        session.stalled_until = max(session.stalled_until, self._loop.time() + seconds)

    def hold_up(self, source: SimulatedSession, target: SimulatedSession, key: str, seconds: float) -> None:
        """Have the next request or answer under a key from one session to another come later by that."""
        self._lateness[source, target, key] = seconds

    def lose_router(self) -> None:
        """Cut all links, also of processes that start meanwhile, until it is back."""
        self.router_lost = True
        self.cut(list(self._sessions))

    def find_router(self) -> None:
        """Let all links stand again."""
        self.router_lost = False
        self.mend(list(self._sessions))

    def mend(self, sessions: Iterable[SimulatedSession]) -> None:
        """Let the links stand again."""
        for session in sessions:
            if session.cut:
                session.cut = False
                session.tell_connection()
                for entry in self.tokens:
                    if entry.session is session:
                        self.announce(session, entry.key, there=True)
                for watcher, token in self._seen_by(session):
                    self._arrive_at(self._loop.time(), session, session, partial(watcher, token, True))

    def detach(self, session: SimulatedSession) -> None:
        """Take a session out of the network whose process has ended without taking anything back."""
        if session.detached:
            return
        session.detached = True
        self._lose(session)
        for table in (self.publishers, self.subscribers, self.queryables, self.tokens, self.watchers):
            for entry in table:
                entry.declared = entry.session is not session
            table[:] = [entry for entry in table if entry.declared]
        self.forget_matches()
        self._sessions.remove(session)
        self._arrival = {link: due for link, due in self._arrival.items() if session not in link[:2]}
        self._lateness = {link: late for link, late in self._lateness.items() if session not in link[:2]}

    def _lose(self, session: SimulatedSession) -> None:
        """Have everybody else hear that a session is gone: its tokens, and what it was asked."""
        for other in [other for other in self._sessions if other is not session and other.connected]:
            for asked in list(other.asking):
                for query in [query for query in asked.open if query.responder is session]:
                    self._tell_late((session, other, "query", query.key), partial(asked.finish, query))
        for entry in self.tokens:
            if entry.session is not session or any(e.key == entry.key and e.session.connected for e in self.tokens):
                continue
            for watcher in self.matching(self.watchers, entry.key):
                other = _ours(watcher.session)
                if other.connected and other is not session:
                    self._tell_late((other, other, "token", entry.key), partial(watcher.callback, entry.key, False))

    def _tell_late(self, link: Link, call: Callable[[], None]) -> None:
        """Bring what the router says of a session that is gone, after what came from it before."""
        sent = max(self._loop.time(), link[1].stalled_until)
        due = max(sent + self._delay(), self._arrival.get(link, 0.0) + SOON)
        self._arrival[link] = due
        self._arrive_at(due, link[1], link[1], call)

    def _seen_by(self, session: SimulatedSession) -> list[tuple[Callable[[str, bool], None], str]]:
        """The tokens of others that the watchers of a session see while its link stands."""
        return [
            (watcher.callback, token)
            for watcher in self.watchers if watcher.session is session
            for token in dict.fromkeys(
                entry.key for entry in self.tokens
                if entry.session is not session and entry.session.connected and intersects(watcher.key, entry.key)
            )
        ]


def _of(network: LocalNetwork) -> SimulatedNetwork:
    assert isinstance(network, SimulatedNetwork)
    return network


def _ours(session: LocalSession) -> SimulatedSession:
    assert isinstance(session, SimulatedSession)
    return session
