"""A `Session` over Zenoh, client of one router, and buses for tools."""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import zenoh

from common.clock import Clock
from common.errors import NoRouter, ZencellError
from common.transport.bus import Bus
from common.transport.credentials import OPERATOR, Credentials, common_name, credentials_of, secure_folder
from common.transport.endpoint import client_config, nearby_endpoints
from common.transport.session import (
    Declaration,
    OnQuery,
    OnReply,
    OnSample,
    OnToken,
    RawReply,
    SendQueue,
)
from common.transport.tokens import MAX_NAMES
from common.transport.zenoh_declarations import (
    TokenWatcher,
    Undeclare,
    ZenohPublisher,
    ZenohQuery,
    direct,
    raw_sample,
)

log = logging.getLogger(__name__)

_CONNECT_MS = 1000  # one attempt, where there is one endpoint
_MAX_PAUSE_SECONDS = 0.2  # between two attempts: each takes 7 ms of a processor
_FLUSH_SECONDS = 0.2
_LIVELINESS_SECONDS = 2.0
_CLOSE_SECONDS = 0.5


class ZenohSession:
    """A `Session` on an open Zenoh client."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._closed = False
        self._queue = SendQueue(zenoh.ZError)
        self._declared: list[Declaration] = []
        self._lock = threading.Lock()
        self._own_tokens: set[str] = set()
        self._token_watchers: list[TokenWatcher] = []

    @property
    def connected(self) -> bool:
        """Whether there is a link to the router."""
        # Not session.is_closed(): it holds the GIL while it waits for a lock that a callback may hold.
        return not self._closed and bool(self._session.info.routers_zid())

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Call back when the router may have been lost or reached."""
        # The events are not a reliable count: after a frozen router some come twice and some out of order.
        listener = self._session.info.declare_transport_events_listener(direct(lambda _event: on_change()))
        self._keep(Undeclare(listener.undeclare))  # else it calls into an interpreter that is exiting

    def _keep(self, declared: Declaration) -> Declaration:
        self._declared.append(declared)
        return declared

    def publisher(self, key: str, encoding: str, *, reliable: bool) -> ZenohPublisher:
        """Declare a publisher; a congested network drops a stream's values, reliable ones wait in the send queue."""
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP

        def declare(priority: zenoh.Priority) -> zenoh.Publisher:
            return self._session.declare_publisher(
                key, encoding=encoding, express=reliable, congestion_control=control, priority=priority,
                reliability=zenoh.Reliability.RELIABLE,
            )

        publisher = ZenohPublisher(declare, self._queue if reliable else None)
        self._keep(publisher)
        return publisher

    def subscriber(self, key: str, on_sample: OnSample) -> Declaration:
        """Call back for each value published under a matching key."""

        def on_zenoh(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                on_sample(raw_sample(sample))

        return self._keep(Undeclare(self._session.declare_subscriber(key, direct(on_zenoh)).undeclare))

    def queryable(self, key: str, on_query: OnQuery, *, complete: bool) -> Declaration:
        """Call back for each `get` that covers the key."""
        declared = self._session.declare_queryable(
            key, direct(lambda query: on_query(ZenohQuery(query, self._queue))), complete=complete
        )
        return self._keep(Undeclare(declared.undeclare))

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
        """Query all matching queryables; return a cancel function."""
        token = zenoh.CancellationToken()

        def on_zenoh(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                on_reply(RawReply(raw_sample(reply.ok)))
            elif reply.err is not None:
                on_reply(RawReply(None, reply.err.payload.to_bytes()))

        def send() -> None:
            try:
                self._session.get(
                    key, direct(on_zenoh, on_done), payload=payload, encoding=encoding or None,
                    attachment=attachment, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE,
                    priority=zenoh.Priority.DATA_HIGH, express=True, cancellation_token=token,
                )
            except zenoh.ZError:
                on_done()
                raise

        self._queue.post(send)
        return lambda: self._queue.post(token.cancel)

    def token(self, key: str) -> Declaration:
        """Declare a liveliness token."""
        declared = self._session.liveliness().declare_token(key)
        self._report_own_token(key, there=True)

        def undeclare() -> None:
            declared.undeclare()  # type: ignore[no-untyped-call]
            self._report_own_token(key, there=False)

        return self._keep(Undeclare(undeclare))

    def _report_own_token(self, key: str, *, there: bool) -> None:
        # Zenoh does not report a session's own tokens to it.
        with self._lock:
            (self._own_tokens.add if there else self._own_tokens.discard)(key)
            watchers = [watcher for watcher in self._token_watchers if watcher.pattern.intersects(key)]
        for watcher in watchers:
            watcher.on_token(key, there)

    def watch_tokens(
        self, key: str, on_token: OnToken, on_first: Callable[[str], None], on_known: Callable[[], None]
    ) -> Declaration:
        """Call back for each matching token that exists, appears or vanishes, after a first query for them."""
        watcher = TokenWatcher(zenoh.KeyExpr(key), on_token)

        def report(sample: zenoh.Sample) -> None:
            token, there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            with self._lock:
                if not there:
                    watcher.reported.discard(token)
                elif len(watcher.reported) < MAX_NAMES:  # bounds the cost of `get_tokens` in a flood
                    watcher.reported.add(token)
            on_token(token, there)

        with self._lock:
            self._token_watchers.append(watcher)
            own = [token for token in self._own_tokens if watcher.pattern.intersects(token)]
        for token in own:
            on_token(token, True)
        # Before the watch: afterwards Zenoh would answer from what the watch has seen so far, which may be nothing.
        self.get_tokens(key, on_first, on_known, timeout=_LIVELINESS_SECONDS)
        declared = self._session.liveliness().declare_subscriber(key, direct(report), history=True)

        def undeclare() -> None:
            with self._lock:
                self._token_watchers.remove(watcher)
            declared.undeclare()  # type: ignore[no-untyped-call]

        return self._keep(Undeclare(undeclare))

    def get_tokens(
        self, key: str, on_token: Callable[[str], None], on_done: Callable[[], None], *, timeout: float
    ) -> None:
        """Call back for each existing matching token, then once `on_done`."""
        pattern = zenoh.KeyExpr(key)
        found: set[str] = set()

        def on_found(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found.add(token := str(reply.ok.key_expr))
                on_token(token)

        def done() -> None:
            # Zenoh 1.10 omits, from one reply in ten, tokens that it has reported to a watch of this session.
            with self._lock:
                reported = set[str]().union(*(watcher.reported for watcher in self._token_watchers))
            for token in reported - found:
                if pattern.intersects(token):
                    on_token(token)
            on_done()

        self._session.liveliness().get(key, direct(on_found, done), timeout=timeout)

    def close(self) -> None:
        """Undeclare all in reverse order and close; may block."""
        self._closed = True
        self._queue.close(_FLUSH_SECONDS)
        while self._declared:
            try:
                self._declared.pop().undeclare()
            except zenoh.ZError as error:
                log.debug("not undeclared: %s", error)
        self._session.close()  # type: ignore[no-untyped-call]


def _open(endpoint: str, credentials: Credentials | None, near: Sequence[str] = ()) -> zenoh.Session:
    """Open a session with a second link for large messages, if the router admits one.

    Raises:
        zenoh.ZError: there is no router yet.
    """

    def attempt(*, two_links: bool, connect_ms: int = _CONNECT_MS) -> zenoh.Session:
        return zenoh.open(
            client_config(endpoint, connect_ms=connect_ms, credentials=credentials, two_links=two_links, near=near))

    if near:  # endpoints of our own router, which admits two links
        return attempt(two_links=True)
    try:
        return attempt(two_links=True)
    except zenoh.ZError:
        attempt(two_links=False, connect_ms=0).close()  # type: ignore[no-untyped-call]
    try:
        return attempt(two_links=True)  # the router started meanwhile
    except zenoh.ZError:
        log.info("%s admits one link per client: small messages share it with images", endpoint)
        return attempt(two_links=False)


class Forked(ZencellError):
    """This process was forked from one with a connection, whose threads and locks do not work here."""

    def __init__(self) -> None:
        super().__init__("this process was forked from one that has a cell open, which cannot work: start it with "
                         'multiprocessing.get_context("spawn")')


class _Opened:
    """Whether this process has opened a connection, and whether it was forked from one that had."""

    any = forked = False

    @classmethod
    def note_fork(cls) -> None:
        cls.forked = cls.forked or cls.any


os.register_at_fork(after_in_child=_Opened.note_fork)


async def open_zenoh(
    endpoint: str, credentials: Credentials | None = None, near: Sequence[str] | None = None
) -> ZenohSession:
    """Return a session with the router at the endpoint; waits for the router without limit, may be cancelled at once.

    The `near` endpoints of the same router are tried first; by default those that a supervisor handed down.
    """
    if _Opened.forked:
        raise Forked
    _Opened.any = True
    near = nearby_endpoints(endpoint) if near is None else near
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
                session = ZenohSession(_open(endpoint, credentials, near))
            except zenoh.ZError as error:
                log.debug("no router yet: %s", error)
                stop.wait(pause)
                pause = min(1.5 * pause, _MAX_PAUSE_SECONDS)
                continue
            try:
                loop.call_soon_threadsafe(deliver, session)
            except RuntimeError:  # the loop was closed meanwhile
                session.close()
            return

    # Not in asyncio's executor: the loop would wait for it when it ends.
    # Not a daemon thread: killed inside Zenoh at exit it would crash the program.
    threading.Thread(target=work, name="connect", daemon=False).start()
    try:
        return await opened
    finally:
        stop.set()


async def close_within(session: Any, seconds: float) -> bool:
    """Close in a thread and return whether that ended in time: a dead network can block it for many seconds."""
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


@asynccontextmanager
async def connect(
    *, cell: str, service: str, endpoint: str, clock: Clock | None = None, timeout: float | None = 3.0,
    identity: str = OPERATOR, near: Sequence[str] | None = None, remapped: Mapping[str, str] | None = None,
    secure: str | None = None,
) -> AsyncIterator[Bus]:
    """Yield a bus for a tool: without a readiness token, closed at the end of the block.

    Args:
        cell: name of the cell.
        service: name of the tool, for its log lines.
        endpoint: of the router, from `endpoint_of`.
        clock: the cell's clock; one at speed 1 by default.
        timeout: for the connection [s]; None waits without limit.
        identity: common name of the certificate to show in a secured cell.
        near: endpoints of the same router to try first; by default those that a supervisor handed down.
        remapped: keys of the cell by the keys in the tool's code, as in common/remapping.py.
        secure: folder of certificates; that of the environment by default.

    Raises:
        NoRouter: no router was reached in time.
    """
    folder = Path(secure) if secure else secure_folder()
    credentials = credentials_of(common_name(cell, identity), folder) if folder else None
    try:
        async with asyncio.timeout(timeout):
            session = await open_zenoh(endpoint, credentials, near)
    except TimeoutError:
        raise NoRouter(endpoint) from None
    bus = Bus(session, service=service, cell=cell, clock=clock or Clock(), topics=remapped)
    try:
        yield bus
    finally:
        await bus.close()
        await close_within(session, _CLOSE_SECONDS)
