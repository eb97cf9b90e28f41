"""A network inside the process: the same codec and checks as over Zenoh, no ports; for simulation and tests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any, Literal

import zenoh

from common.clock import Clock
from common.transport.bus import Bus
from common.transport.codec import DEFAULT_LIMIT
from common.transport.session import Declaration, OnQuery, OnReply, OnSample, OnToken, RawReply, RawSample

Lane = Literal["stream", "reliable", "query", "token"]  # kinds of traffic, which a simulated link may treat differently


@lru_cache(maxsize=4096)
def intersects(first: str, second: str) -> bool:
    """Return whether two key expressions have a key in common."""
    return zenoh.KeyExpr(first).intersects(second)


class _Entry:
    """A declaration: an entry in a table of the network until it is undeclared."""

    def __init__(self, session: LocalSession, table: list[Any], key: str, callback: Any = None) -> None:
        zenoh.KeyExpr(key)  # refuses the keys that Zenoh refuses
        self.key = key
        self.callback = callback
        self.complete = False
        self.session = session
        self._network = session.network
        self._table = table
        self.declared = True
        with self._network.lock:
            table.append(self)
            self._network.clear_matches()

    def undeclare(self) -> None:
        with self._network.lock:
            if self.declared:
                self.declared = False
                self._table.remove(self)
                self._network.clear_matches()


class _Token(_Entry):
    def undeclare(self) -> None:
        was = self.declared
        super().undeclare()
        if was:
            self._network.announce(self.session, self.key, there=False)


class _Publisher(_Entry):
    def __init__(self, session: LocalSession, key: str, encoding: str, reliable: bool) -> None:
        super().__init__(session, session.network.publishers, key)
        self._encoding = encoding
        self._lane: Lane = "reliable" if reliable else "stream"

    @property
    def matched(self) -> bool:
        return self.session.connected and bool(self._network.matching(self._network.subscribers, self.key))

    def put(self, payload: bytes, attachment: bytes) -> None:
        if not self.declared:
            return
        sample = RawSample(self.key, payload, self._encoding, attachment)
        self._network.observe_put(self.session, sample)
        for entry in self._network.matching(self._network.subscribers, self.key):
            self._network.send(self.session, entry.session, self._lane, self.key, partial(entry.callback, sample))


class PendingGet:
    """A `get` in progress: done when every queryable that it reached has finished, or was lost."""

    def __init__(self, session: LocalSession, on_reply: OnReply, on_done: Callable[[], None]) -> None:
        self.session = session
        self.open: dict[LocalQuery, None] = {}
        self._on_reply = on_reply
        self._on_done: Callable[[], None] | None = on_done
        self._lock = threading.Lock()

    def reply(self, reply: RawReply) -> None:
        """Deliver a reply."""
        if self._on_done is not None:
            self._on_reply(reply)

    def finish(self, query: LocalQuery | None = None) -> None:
        """Finish one query, or all of them."""
        with self._lock:
            if query is None:
                self.open.clear()
            else:
                self.open.pop(query, None)
            if self.open or self._on_done is None:
                return
            on_done, self._on_done = self._on_done, None
            self.session.pending.pop(self, None)
        on_done()


class LocalQuery:
    """A `get` that reached a queryable."""

    def __init__(
        self, pending: PendingGet, responder: LocalSession, key: str, payload: bytes | None, attachment: bytes | None
    ) -> None:
        self.key = key
        self.payload = payload
        self.attachment = attachment
        self.pending = pending
        self.responder = responder
        self._finished = False

    def reply(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        """Send one reply."""
        self._send(partial(self.pending.reply, RawReply(RawSample(key, payload, encoding, attachment))))

    def refuse(self, payload: bytes) -> None:
        """Send an error reply."""
        self._send(partial(self.pending.reply, RawReply(None, payload)))

    def finish(self) -> None:
        """End the replies of this queryable."""
        self._send(partial(self.pending.finish, self))
        self._finished = True

    def _send(self, call: Callable[[], None]) -> None:
        if not self._finished:
            self.responder.network.send(self.responder, self.pending.session, "query", self.key, call)


class LocalSession:
    """A `Session` in a `LocalNetwork`."""

    def __init__(self, network: LocalNetwork) -> None:
        self.network = network
        self.pending: dict[PendingGet, None] = {}
        self._declared: list[_Entry] = []

    @property
    def connected(self) -> bool:
        """Always true: there is no router."""
        return True

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Never call back: the connection does not change."""

    def _keep(self, entry: _Entry) -> _Entry:
        self._declared.append(entry)
        return entry

    def publisher(self, key: str, encoding: str, *, reliable: bool) -> _Publisher:
        """Declare a publisher, which drops nothing."""
        publisher = _Publisher(self, key, encoding, reliable)
        self._keep(publisher)
        return publisher

    def subscriber(self, key: str, on_sample: OnSample) -> Declaration:
        """Call back for each value published under a matching key."""
        return self._keep(_Entry(self, self.network.subscribers, key, on_sample))

    def queryable(self, key: str, on_query: OnQuery, *, complete: bool) -> Declaration:
        """Call back for each `get` that covers the key."""
        entry = _Entry(self, self.network.queryables, key, on_query)
        entry.complete = complete
        return self._keep(entry)

    def get(
        self,
        key: str,
        on_reply: OnReply,
        on_done: Callable[[], None],
        *,
        payload: bytes | None = None,
        encoding: str = "",
        attachment: bytes | None = None,
        timeout: float = 10.0,
    ) -> Callable[[], None]:
        """Query all matching queryables; the caller enforces the time-out. Returns a cancel function."""
        key = key.partition("?")[0]
        reached = self.network.matching(self.network.queryables, key)
        one = next((entry for entry in reached if entry.complete and entry.key == key), None)
        if one is not None:
            reached = [one]
        pending = PendingGet(self, on_reply, on_done)
        queries = [LocalQuery(pending, entry.session, key, payload, attachment) for entry in reached]
        pending.open.update(dict.fromkeys(queries))
        self.pending[pending] = None
        if not queries:
            self.network.send(self, self, "query", key, pending.finish)
        for entry, query in zip(reached, queries, strict=True):
            self.network.send(self, entry.session, "query", key, partial(entry.callback, query))
        return pending.finish

    def token(self, key: str) -> Declaration:
        """Declare a liveliness token."""
        token = self._keep(_Token(self, self.network.tokens, key))
        self.network.announce(self, key, there=True)
        return token

    def watch_tokens(
        self, key: str, on_token: OnToken, on_first: Callable[[str], None], on_known: Callable[[], None]
    ) -> Declaration:
        """Call back for each matching token that exists, appears or vanishes; existing ones are reported at once."""
        watcher = self._keep(_Entry(self, self.network.watchers, key, on_token))
        for entry in self.network.matching(self.network.tokens, key):
            self.network.send(entry.session, self, "token", entry.key, partial(on_token, entry.key, True))
        self.network.send(self, self, "token", key, on_known)
        return watcher

    def get_tokens(
        self, key: str, on_token: Callable[[str], None], on_done: Callable[[], None], *, timeout: float
    ) -> None:
        """Call back for each existing matching token, then once `on_done`."""
        for entry in self.network.matching(self.network.tokens, key):
            self.network.send(entry.session, self, "token", entry.key, partial(on_token, entry.key))
        self.network.send(self, self, "token", key, on_done)

    def close(self) -> None:
        """Undeclare all in reverse order."""
        while self._declared:
            self._declared.pop().undeclare()


class LocalNetwork:
    """A network without ports for any number of buses."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.publishers: list[_Entry] = []
        self.subscribers: list[_Entry] = []
        self.queryables: list[_Entry] = []
        self.tokens: list[_Entry] = []
        self.watchers: list[_Entry] = []
        self._matches: dict[tuple[int, str], list[_Entry]] = {}

    def matching(self, table: list[_Entry], key: str) -> list[_Entry]:
        """Return the entries of a table whose key expression intersects the key."""
        with self.lock:
            found = self._matches.get((id(table), key))
            if found is None:
                found = [entry for entry in table if intersects(entry.key, key)]
                self._matches[id(table), key] = found
            return found

    def clear_matches(self) -> None:
        """Clear the cache of `matching`: the tables changed."""
        self._matches = {}

    def send(self, source: LocalSession, target: LocalSession, lane: Lane, key: str, call: Callable[[], None]) -> None:
        """Deliver traffic from one session to another by `call()`: at once; a simulated network delays or drops it."""
        call()

    def observe_put(self, session: LocalSession, sample: RawSample) -> None:
        """Do nothing; a simulated network observes here what is published, before it travels."""

    def announce(self, session: LocalSession, token: str, *, there: bool) -> None:
        """Report to the watchers that a token appeared or, if no other session holds it, vanished."""
        if not there and any(entry.key == token for entry in self.tokens):
            return
        for entry in self.matching(self.watchers, token):
            self.send(session, entry.session, "token", token, partial(entry.callback, token, there))

    def session(self) -> LocalSession:
        """Return a new session on this network."""
        return LocalSession(self)

    def bus(self, service: str = "tester", *, cell: str = "test", clock: Clock | None = None,
            limit: int = DEFAULT_LIMIT, topics: Mapping[str, str] | None = None) -> Bus:
        """Return a new bus on this network; call it on a running loop."""
        return Bus(self.session(), service=service, cell=cell, clock=clock or Clock(), limit=limit, topics=topics)
