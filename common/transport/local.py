"""A network inside the process: the same codec and checks as over Zenoh, no ports; for tests and recordings."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any, Literal

import zenoh

from common.clock import Clock
from common.transport.bus import Bus
from common.transport.codec import DEFAULT_LIMIT
from common.transport.session import Declared, OnQuery, OnReply, OnSample, OnToken, RawReply, RawSample

Lane = Literal["stream", "reliable", "query", "token"]  # what travels: a link may treat each of them in its own way


@lru_cache(maxsize=4096)
def intersects(first: str, second: str) -> bool:
    """Whether two key expressions have a key in common."""
    return zenoh.KeyExpr(first).intersects(second)


class _Entry:
    """Something declared: stands in a table of the network until it is taken back."""

    def __init__(self, session: LocalSession, table: list[Any], key: str, callback: Any = None) -> None:
        zenoh.KeyExpr(key)  # a bad key is refused here as it would be by Zenoh
        self.key = key
        self.callback = callback
        self.complete = False
        self.session = session
        self._network = session.network
        self._table = table
        self.declared = True  # as long as it stands in the table
        with self._network.lock:
            table.append(self)
            self._network.forget_matches()

    def undeclare(self) -> None:
        with self._network.lock:
            if self.declared:
                self.declared = False
                self._table.remove(self)
                self._network.forget_matches()


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
        self._network.notice(self.session, sample)
        for entry in self._network.matching(self._network.subscribers, self.key):
            self._network.send(self.session, entry.session, self._lane, self.key, partial(entry.callback, sample))


class Asked:
    """A `get` on its way: done when every queryable that it reached has finished, or was lost."""

    def __init__(self, session: LocalSession, on_reply: OnReply, on_done: Callable[[], None]) -> None:
        self.session = session
        self.open: dict[LocalQuery, None] = {}
        self._on_reply = on_reply
        self._on_done: Callable[[], None] | None = on_done
        self._lock = threading.Lock()

    def reply(self, reply: RawReply) -> None:
        """Take in a reply."""
        if self._on_done is not None:
            self._on_reply(reply)

    def finish(self, query: LocalQuery | None = None) -> None:
        """Take note that no more comes from one who was asked, or from nobody any more."""
        with self._lock:
            if query is None:
                self.open.clear()
            else:
                self.open.pop(query, None)
            if self.open or self._on_done is None:
                return
            on_done, self._on_done = self._on_done, None
            self.session.asking.pop(self, None)
        on_done()


class LocalQuery:
    """A `get` that reached a queryable."""

    def __init__(self, asked: Asked, responder: LocalSession, key: str, parameters: str, payload: bytes | None,
                 attachment: bytes | None) -> None:
        self.key = key
        self.parameters = parameters
        self.payload = payload
        self.attachment = attachment
        self.asked = asked
        self.responder = responder
        self._finished = False

    def reply(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        """Send one answer."""
        self._send(partial(self.asked.reply, RawReply(RawSample(key, payload, encoding, attachment))))

    def refuse(self, payload: bytes) -> None:
        """Send an error reply."""
        self._send(partial(self.asked.reply, RawReply(None, payload)))

    def finish(self) -> None:
        """No more replies come from here."""
        self._send(partial(self.asked.finish, self))
        self._finished = True

    def _send(self, call: Callable[[], None]) -> None:
        if not self._finished:
            self.responder.network.send(self.responder, self.asked.session, "query", self.key, call)


class LocalSession:
    """A `Session` in a `LocalNetwork`."""

    def __init__(self, network: LocalNetwork) -> None:
        self.network = network
        self.asking: dict[Asked, None] = {}  # what it has asked and still waits for
        self._declared: list[_Entry] = []

    @property
    def connected(self) -> bool:
        """Always: there is no router to lose."""
        return True

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Never calls back: the connection does not change."""

    def _keep(self, entry: _Entry) -> _Entry:
        self._declared.append(entry)
        return entry

    def publisher(self, key: str, encoding: str, *, reliable: bool) -> _Publisher:
        """Declare a publisher; nothing is ever dropped on the way."""
        made = _Publisher(self, key, encoding, reliable)
        self._keep(made)
        return made

    def subscriber(self, key: str, on_sample: OnSample) -> Declared:
        """Call back for each value put under a matching key."""
        return self._keep(_Entry(self, self.network.subscribers, key, on_sample))

    def queryable(self, key: str, on_query: OnQuery, *, complete: bool) -> Declared:
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
        """Ask everybody who serves the key; the time-out is the caller's."""
        key, _, parameters = key.partition("?")
        reached = self.network.matching(self.network.queryables, key)
        one = next((entry for entry in reached if entry.complete and entry.key == key), None)
        if one is not None:
            reached = [one]
        asked = Asked(self, on_reply, on_done)
        queries = [LocalQuery(asked, entry.session, key, parameters, payload, attachment) for entry in reached]
        asked.open.update(dict.fromkeys(queries))
        self.asking[asked] = None
        if not queries:
            self.network.send(self, self, "query", key, asked.finish)
        for entry, query in zip(reached, queries, strict=True):
            self.network.send(self, entry.session, "query", key, partial(entry.callback, query))
        return asked.finish

    def token(self, key: str) -> Declared:
        """Declare a liveliness token."""
        made = self._keep(_Token(self, self.network.tokens, key))
        self.network.announce(self, key, there=True)
        return made

    def watch_tokens(
        self, key: str, on_token: OnToken, on_first: Callable[[str], None], on_known: Callable[[], None]
    ) -> Declared:
        """Call back for each matching token that is there, appears or vanishes; all are known at once."""
        watcher = self._keep(_Entry(self, self.network.watchers, key, on_token))
        for entry in self.network.matching(self.network.tokens, key):
            self.network.send(entry.session, self, "token", entry.key, partial(on_token, entry.key, True))
        self.network.send(self, self, "token", key, on_known)
        return watcher

    def get_tokens(
        self, key: str, on_token: Callable[[str], None], on_done: Callable[[], None], *, timeout: float
    ) -> None:
        """Call back for each matching token that is there now, then once `on_done`."""
        for entry in self.network.matching(self.network.tokens, key):
            self.network.send(entry.session, self, "token", entry.key, partial(on_token, entry.key))
        self.network.send(self, self, "token", key, on_done)

    def close(self) -> None:
        """Take back everything in reverse order."""
        while self._declared:
            self._declared.pop().undeclare()


class LocalNetwork:
    """A network without ports on which any number of buses meet."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.publishers: list[_Entry] = []
        self.subscribers: list[_Entry] = []
        self.queryables: list[_Entry] = []
        self.tokens: list[_Entry] = []
        self.watchers: list[_Entry] = []
        self._matches: dict[tuple[int, str], list[_Entry]] = {}

    def matching(self, table: list[_Entry], key: str) -> list[_Entry]:
        """The entries of a table whose key expression meets the key."""
        with self.lock:
            found = self._matches.get((id(table), key))
            if found is None:
                found = [entry for entry in table if intersects(entry.key, key)]
                self._matches[id(table), key] = found
            return found

    def forget_matches(self) -> None:
        """Take note that something was declared, or taken back."""
        self._matches = {}

    def send(self, source: LocalSession, target: LocalSession, lane: Lane, key: str, call: Callable[[], None]) -> None:
        """Bring something from one session to another: here at once; what comes is told by `call()`."""
        call()

    def notice(self, session: LocalSession, sample: RawSample) -> None:
        """See what is put, before it travels: here nobody looks."""

    def announce(self, session: LocalSession, token: str, *, there: bool) -> None:
        """Tell the watchers that a token of a session has come or, if no other session holds it, gone."""
        if not there and any(entry.key == token for entry in self.tokens):
            return
        for entry in self.matching(self.watchers, token):
            self.send(session, entry.session, "token", token, partial(entry.callback, token, there))

    def session(self) -> LocalSession:
        """A session on this network."""
        return LocalSession(self)

    def bus(self, service: str = "tester", *, cell: str = "test", clock: Clock | None = None,
            limit: int = DEFAULT_LIMIT, topics: Mapping[str, str] | None = None) -> Bus:
        """A bus on this network; made on a running loop."""
        return Bus(self.session(), service=service, cell=cell, clock=clock or Clock(), limit=limit, topics=topics)
