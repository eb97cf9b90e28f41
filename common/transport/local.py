"""A network inside the process: the same codec and checks as over Zenoh, no ports; for tests and recordings."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import zenoh

from common.clock import Clock
from common.transport.bus import Bus
from common.transport.codec import DEFAULT_LIMIT
from common.transport.session import Declared, OnQuery, OnReply, OnSample, OnToken, RawReply, RawSample


@lru_cache(maxsize=4096)
def _intersects(first: str, second: str) -> bool:
    return zenoh.KeyExpr(first).intersects(second)


class _Entry:
    """Something declared: stands in a table of the network until it is taken back."""

    def __init__(self, network: LocalNetwork, table: list[Any], key: str, callback: Any = None) -> None:
        zenoh.KeyExpr(key)  # a bad key is refused here as it would be by Zenoh
        self.key = key
        self.callback = callback
        self.complete = False
        self._network = network
        self._table = table
        with network.lock:
            table.append(self)

    def undeclare(self) -> None:
        with self._network.lock:
            if self in self._table:
                self._table.remove(self)

    @property
    def declared(self) -> bool:
        return self in self._table


class _Token(_Entry):
    def undeclare(self) -> None:
        was = self.declared
        super().undeclare()
        if was:
            self._network.announce(self.key, there=False)


class _Publisher(_Entry):
    def __init__(self, network: LocalNetwork, key: str, encoding: str) -> None:
        super().__init__(network, network.publishers, key)
        self._encoding = encoding

    @property
    def matched(self) -> bool:
        return bool(self._network.matching(self._network.subscribers, self.key))

    def put(self, payload: bytes, attachment: bytes) -> None:
        if not self.declared:
            return
        sample = RawSample(self.key, payload, self._encoding, attachment)
        for entry in self._network.matching(self._network.subscribers, self.key):
            entry.callback(sample)


class _Asked:
    """A `get` on its way: done when every queryable that it reached has finished."""

    def __init__(self, on_reply: OnReply, on_done: Callable[[], None], count: int) -> None:
        self._on_reply = on_reply
        self._on_done = on_done
        self._open = count
        self._lock = threading.Lock()

    def reply(self, reply: RawReply) -> None:
        if self._open > 0:
            self._on_reply(reply)

    def finish_one(self) -> None:
        with self._lock:
            self._open -= 1
            done = self._open == 0
        if done:
            self._on_done()

    def cancel(self) -> None:
        with self._lock:
            done = self._open > 0
            self._open = -1
        if done:
            self._on_done()


class _Query:
    def __init__(self, asked: _Asked, key: str, parameters: str, payload: bytes | None, attachment: bytes | None):
        self.key = key
        self.parameters = parameters
        self.payload = payload
        self.attachment = attachment
        self._asked: _Asked | None = asked

    def reply(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        if self._asked is not None:
            self._asked.reply(RawReply(RawSample(key, payload, encoding, attachment)))

    def refuse(self, payload: bytes) -> None:
        if self._asked is not None:
            self._asked.reply(RawReply(None, payload))

    def finish(self) -> None:
        asked, self._asked = self._asked, None
        if asked is not None:
            asked.finish_one()


class LocalSession:
    """A `Session` in a `LocalNetwork`."""

    def __init__(self, network: LocalNetwork) -> None:
        self._network = network
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
        made = _Publisher(self._network, key, encoding)
        self._keep(made)
        return made

    def subscriber(self, key: str, on_sample: OnSample) -> Declared:
        """Call back for each value put under a matching key."""
        return self._keep(_Entry(self._network, self._network.subscribers, key, on_sample))

    def queryable(self, key: str, on_query: OnQuery, *, complete: bool) -> Declared:
        """Call back for each `get` that covers the key."""
        entry = _Entry(self._network, self._network.queryables, key, on_query)
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
        reached = self._network.matching(self._network.queryables, key)
        one = next((entry for entry in reached if entry.complete and entry.key == key), None)
        if one is not None:
            reached = [one]
        asked = _Asked(on_reply, on_done, len(reached))
        if not reached:
            on_done()
        for entry in reached:
            entry.callback(_Query(asked, key, parameters, payload, attachment))
        return asked.cancel

    def token(self, key: str) -> Declared:
        """Declare a liveliness token."""
        made = self._keep(_Token(self._network, self._network.tokens, key))
        self._network.announce(key, there=True)
        return made

    def watch_tokens(
        self, key: str, on_token: OnToken, on_first: Callable[[str], None], on_known: Callable[[], None]
    ) -> Declared:
        """Call back for each matching token that is there, appears or vanishes; all are known at once."""
        watcher = self._keep(_Entry(self._network, self._network.watchers, key, on_token))
        for entry in self._network.matching(self._network.tokens, key):
            on_token(entry.key, True)
        on_known()
        return watcher

    def get_tokens(
        self, key: str, on_token: Callable[[str], None], on_done: Callable[[], None], *, timeout: float
    ) -> None:
        """Call back for each matching token that is there now, then once `on_done`."""
        for entry in self._network.matching(self._network.tokens, key):
            on_token(entry.key)
        on_done()

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

    def matching(self, table: list[_Entry], key: str) -> list[_Entry]:
        """The entries of a table whose key expression meets the key."""
        with self.lock:
            return [entry for entry in table if _intersects(entry.key, key)]

    def announce(self, token: str, *, there: bool) -> None:
        """Tell the watchers that a token has come or, if no other session holds it, gone."""
        if not there and any(entry.key == token for entry in self.tokens):
            return
        for entry in self.matching(self.watchers, token):
            entry.callback(token, there)

    def session(self) -> LocalSession:
        """A session on this network."""
        return LocalSession(self)

    def bus(self, service: str = "tester", *, cell: str = "test", clock: Clock | None = None,
            limit: int = DEFAULT_LIMIT) -> Bus:
        """A bus on this network; made on a running loop."""
        return Bus(self.session(), service=service, cell=cell, clock=clock or Clock(), limit=limit)
