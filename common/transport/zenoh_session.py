"""A `Session` over Zenoh: a client of one router."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import zenoh

from common.transport.credentials import Credentials
from common.transport.endpoint import LARGE_BYTES, client_config, near_of
from common.transport.outbox import Outbox
from common.transport.session import Declared, OnQuery, OnReply, OnSample, OnToken, RawReply, RawSample
from common.transport.tokens import MOST_NAMES

log = logging.getLogger(__name__)

_CONNECT_MS = 1000  # one try, where there is one way
_MOST_PAUSE_SECONDS = 0.2  # between two tries: each takes 7 ms of a processor
_FLUSH_SECONDS = 0.2
_LIVELINESS_SECONDS = 2.0


def _direct(on_item: Callable[[Any], None], on_drop: Callable[[], None] | None = None) -> Any:
    # The default, an indirect callback, makes a thread that keeps the interpreter from ending.
    return zenoh.handlers.Callback(on_item, on_drop, indirect=False)


def _sample(sample: zenoh.Sample) -> RawSample:
    attachment = sample.attachment
    return RawSample(
        str(sample.key_expr),
        sample.payload.to_bytes(),
        str(sample.encoding),
        attachment.to_bytes() if attachment is not None else None,
    )


class _Publisher:
    def __init__(self, declare: Callable[[zenoh.Priority], zenoh.Publisher], outbox: Outbox | None) -> None:
        """Declare it, with an outbox for what must arrive, without one for a stream."""
        # Apart from each other, so that nothing small queues behind a picture, nor what must arrive behind a stream.
        self._publisher = declare(zenoh.Priority.DATA if outbox is None else zenoh.Priority.DATA_HIGH)
        self._declare = declare
        self._large: zenoh.Publisher | None = None  # of a stream, from its first large message on
        self._outbox = outbox
        self._undeclared = False

    @property
    def matched(self) -> bool:
        return not self._undeclared and self._publisher.matching_status.matching  # type: ignore[attr-defined]

    def put(self, payload: bytes, attachment: bytes) -> None:
        if self._undeclared:
            return
        if self._outbox is None:
            if self._large is None and len(payload) > LARGE_BYTES:
                self._large = self._declare(zenoh.Priority.DATA_LOW)
            (self._large or self._publisher).put(payload, attachment=attachment or None)
        else:
            self._outbox.post(lambda: self._publisher.put(payload, attachment=attachment or None))

    def undeclare(self) -> None:
        if self._undeclared:
            return
        self._undeclared = True
        if self._outbox is None:
            for publisher in filter(None, (self._large, self._publisher)):
                publisher.undeclare()  # type: ignore[no-untyped-call]
        else:  # which may be in the middle of a put; Zenoh refuses both at once
            self._outbox.post(self._publisher.undeclare)


class _Query:
    def __init__(self, query: zenoh.Query, outbox: Outbox) -> None:
        self._query = query
        self._outbox = outbox
        self.key = str(query.key_expr)
        self.parameters = str(query.parameters)
        self.payload = query.payload.to_bytes() if query.payload is not None else None
        self.attachment = query.attachment.to_bytes() if query.attachment is not None else None

    def reply(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        self._outbox.post(lambda: self._query.reply(key, payload, encoding=encoding, attachment=attachment))

    def refuse(self, payload: bytes) -> None:
        self._outbox.post(lambda: self._query.reply_err(payload, encoding="application/msgpack"))

    def finish(self) -> None:
        self._outbox.post(self._query.drop)


class _Undeclare:
    """Runs a zenoh undeclaration once."""

    def __init__(self, undeclare: Callable[[], Any]) -> None:
        self._undeclare: Callable[[], Any] | None = undeclare

    def undeclare(self) -> None:
        undeclare, self._undeclare = self._undeclare, None
        if undeclare is not None:
            undeclare()


@dataclass(eq=False)
class _TokenWatcher:
    pattern: zenoh.KeyExpr
    on_token: OnToken
    told: set[str] = field(default_factory=set)  # tokens that are there, as Zenoh said


class ZenohSession:
    """A `Session` on an open Zenoh client."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._closed = False
        self._outbox = Outbox()
        self._declared: list[Declared] = []
        self._lock = threading.Lock()
        self._own_tokens: set[str] = set()
        self._token_watchers: list[_TokenWatcher] = []

    @property
    def connected(self) -> bool:
        """Whether the link to the router stands."""
        # Not session.is_closed(): it keeps the interpreter's lock while it waits for one that a callback may hold.
        return not self._closed and bool(self._session.info.routers_zid())

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Call back when the router may have been lost or reached."""
        # The events themselves do not add up: after a frozen router some come twice and some out of order.
        listener = self._session.info.declare_transport_events_listener(_direct(lambda _event: on_change()))
        self._keep(_Undeclare(listener.undeclare))  # else it calls into an interpreter that ends

    def _keep(self, declared: Declared) -> Declared:
        self._declared.append(declared)
        return declared

    def publisher(self, key: str, encoding: str, *, reliable: bool) -> _Publisher:
        """Declare a publisher; a stream is dropped by a network that cannot take it, the rest waits in the outbox."""
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP

        def declare(priority: zenoh.Priority) -> zenoh.Publisher:
            return self._session.declare_publisher(
                key, encoding=encoding, express=reliable, congestion_control=control, priority=priority,
                reliability=zenoh.Reliability.RELIABLE,
            )

        made = _Publisher(declare, self._outbox if reliable else None)
        self._keep(made)
        return made

    def subscriber(self, key: str, on_sample: OnSample) -> Declared:
        """Call back for each value put under a matching key."""

        def on_zenoh(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                on_sample(_sample(sample))

        return self._keep(_Undeclare(self._session.declare_subscriber(key, _direct(on_zenoh)).undeclare))

    def queryable(self, key: str, on_query: OnQuery, *, complete: bool) -> Declared:
        """Call back for each `get` that covers the key."""
        made = self._session.declare_queryable(
            key, _direct(lambda query: on_query(_Query(query, self._outbox))), complete=complete
        )
        return self._keep(_Undeclare(made.undeclare))

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
        """Ask everybody who serves the key; returns what cancels the question."""
        token = zenoh.CancellationToken()

        def on_zenoh(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                on_reply(RawReply(_sample(reply.ok)))
            elif reply.err is not None:
                on_reply(RawReply(None, reply.err.payload.to_bytes()))

        def ask() -> None:
            try:
                self._session.get(
                    key, _direct(on_zenoh, on_done), payload=payload, encoding=encoding or None,
                    attachment=attachment, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE,
                    priority=zenoh.Priority.DATA_HIGH, express=True, cancellation_token=token,
                )
            except zenoh.ZError:
                on_done()
                raise

        self._outbox.post(ask)
        return lambda: self._outbox.post(token.cancel)

    def token(self, key: str) -> Declared:
        """Declare a liveliness token."""
        made = self._session.liveliness().declare_token(key)
        self._own_token(key, there=True)

        def undeclare() -> None:
            made.undeclare()  # type: ignore[no-untyped-call]
            self._own_token(key, there=False)

        return self._keep(_Undeclare(undeclare))

    def _own_token(self, key: str, *, there: bool) -> None:
        # Zenoh does not report a session's own tokens to it.
        with self._lock:
            (self._own_tokens.add if there else self._own_tokens.discard)(key)
            watchers = [watcher for watcher in self._token_watchers if watcher.pattern.intersects(key)]
        for watcher in watchers:
            watcher.on_token(key, there)

    def watch_tokens(
        self, key: str, on_token: OnToken, on_first: Callable[[str], None], on_known: Callable[[], None]
    ) -> Declared:
        """Call back for each matching token that is there, appears or vanishes, after a first question for them."""
        watcher = _TokenWatcher(zenoh.KeyExpr(key), on_token)

        def tell(sample: zenoh.Sample) -> None:
            token, there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            with self._lock:
                if not there:
                    watcher.told.discard(token)
                elif len(watcher.told) < MOST_NAMES:  # however many somebody declares, a question looks at few
                    watcher.told.add(token)
            on_token(token, there)

        with self._lock:
            self._token_watchers.append(watcher)
            own = [token for token in self._own_tokens if watcher.pattern.intersects(token)]
        for token in own:
            on_token(token, True)
        # Before the watch: afterwards Zenoh would answer it from what the watch has seen so far, which may be nothing.
        self.get_tokens(key, on_first, on_known, timeout=_LIVELINESS_SECONDS)
        made = self._session.liveliness().declare_subscriber(key, _direct(tell), history=True)

        def undeclare() -> None:
            with self._lock:
                self._token_watchers.remove(watcher)
            made.undeclare()  # type: ignore[no-untyped-call]

        return self._keep(_Undeclare(undeclare))

    def get_tokens(
        self, key: str, on_token: Callable[[str], None], on_done: Callable[[], None], *, timeout: float
    ) -> None:
        """Call back for each matching token that is there now, then once `on_done`."""
        asked = zenoh.KeyExpr(key)
        found: set[str] = set()

        def on_found(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found.add(token := str(reply.ok.key_expr))
                on_token(token)

        def done() -> None:
            # Of what watches of this session were told, Zenoh 1.10 leaves some out: of one answer in ten.
            with self._lock:
                told = set[str]().union(*(watcher.told for watcher in self._token_watchers))
            for token in told - found:
                if asked.intersects(token):
                    on_token(token)
            on_done()

        self._session.liveliness().get(key, _direct(on_found, done), timeout=timeout)

    def close(self) -> None:
        """Take back everything in reverse order and leave; may block."""
        self._closed = True
        self._outbox.close(_FLUSH_SECONDS)
        while self._declared:
            try:
                self._declared.pop().undeclare()
            except zenoh.ZError as error:
                log.debug("not undeclared: %s", error)
        self._session.close()  # type: ignore[no-untyped-call]


def _open(endpoint: str, credentials: Credentials | None, near: Sequence[str] = ()) -> zenoh.Session:
    """A session with a link of its own for what is large, where the router admits that.

    Raises:
        zenoh.ZError: nobody is there yet.
    """

    def opened(*, apart: bool, connect_ms: int = _CONNECT_MS) -> zenoh.Session:
        return zenoh.open(
            client_config(endpoint, connect_ms=connect_ms, credentials=credentials, apart=apart, near=near))

    if near:  # of our own router, which admits it
        return opened(apart=True)
    try:
        return opened(apart=True)
    except zenoh.ZError:
        opened(apart=False, connect_ms=0).close()  # type: ignore[no-untyped-call]
    try:
        return opened(apart=True)  # the router came meanwhile
    except zenoh.ZError:
        log.info("%s admits one link of each client: what is small shares it with pictures", endpoint)
        return opened(apart=False)


async def open_zenoh(
    endpoint: str, credentials: Credentials | None = None, near: Sequence[str] | None = None
) -> ZenohSession:
    """A session with the router at the endpoint, for which it waits as long as it takes; may be cancelled at once.

    It is reached at its `near` endpoints where that is possible: those that a supervisor has handed down by default.
    """
    near = near_of(endpoint) if near is None else near
    loop = asyncio.get_running_loop()
    opened: asyncio.Future[ZenohSession] = loop.create_future()
    stop = threading.Event()

    def deliver(session: ZenohSession) -> None:
        if opened.cancelled():
            threading.Thread(target=session.close, daemon=True).start()
        else:
            opened.set_result(session)

    def work() -> None:
        pause = 0.02
        while not stop.is_set():
            try:
                session = _open(endpoint, credentials, near)
            except zenoh.ZError as error:
                log.debug("no router yet: %s", error)
                stop.wait(pause)
                pause = min(1.5 * pause, _MOST_PAUSE_SECONDS)
                continue
            made = ZenohSession(session)
            try:
                loop.call_soon_threadsafe(deliver, made)
            except RuntimeError:  # the loop was closed meanwhile
                made.close()
            return

    # A thread of our own: asyncio would wait at its end for one of its executor's.
    # No daemon: cut off inside Zenoh at the end of a program it would bring that down.
    threading.Thread(target=work, name="connect", daemon=False).start()
    try:
        return await opened
    finally:
        stop.set()


async def close_bounded(session: Any, seconds: float) -> bool:
    """Close in a thread, and say whether that ended within the time: a dead network can hold it for many seconds."""
    loop = asyncio.get_running_loop()
    closed = asyncio.Event()

    def work() -> None:
        try:
            session.close()
        finally:
            if not loop.is_closed():
                loop.call_soon_threadsafe(closed.set)

    threading.Thread(target=work, name="close", daemon=True).start()
    try:
        async with asyncio.timeout(seconds):
            await closed.wait()
    except TimeoutError:
        return False
    return True
