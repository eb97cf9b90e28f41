"""The network as the bus needs it, given by Zenoh and in process; keys of liveliness tokens; ways between threads.

Callbacks may come on any thread and must return at once. This module imports little: health checks start often.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    import asyncio

log = logging.getLogger(__name__)

ROUTER = "router"  # the only process without a token: a connection proves that it is up
SEND_QUEUE_SIZE = 10_000


def alive_key(cell: str, service: str = "*") -> str:
    """Key of the token that a service holds while it is ready."""
    return f"{cell}/alive/{service}"


def owns_key(cell: str, key: str = "*", own: str = "*", service: str = "*", process: str = "*") -> str:
    """Key of the token that a process holds for a key that it writes or serves; `own` is that key before remapping."""
    return f"{cell}/owns/{key.replace('/', '|')}/{own.replace('/', '|')}/{service}/{process}"


def serves_key(cell: str, key: str, service: str = "*") -> str:
    """Key of the token that a service holds for a request key that it serves."""
    return f"{cell}/serves/{key}/{service}"


class RawSample(NamedTuple):
    """A received value or reply with its full key."""

    key: str
    payload: bytes
    encoding: str = ""
    attachment: bytes | None = None


class RawReply(NamedTuple):
    """A reply to a `get`: a sample, or the payload of an error."""

    sample: RawSample | None
    error: bytes = b""


class Query(Protocol):
    """A `get` that reached a queryable. `finish` must be called exactly once.

    Its parameters (after `?`) are not read: no limit of a router counts them, and a copy of 30 MB takes 0.1 s and more.
    """

    key: str
    payload: bytes | None
    attachment: bytes | None

    def reply(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        """Send one reply under a key that the query covers."""

    def refuse(self, payload: bytes) -> None:
        """Send an error reply."""

    def finish(self) -> None:
        """End the replies of this queryable."""


class Declaration(Protocol):
    """A declared subscriber, queryable, publisher or token."""

    def undeclare(self) -> None:
        """Undeclare it; a second call has no effect."""


class Publisher(Declaration, Protocol):
    """Publishes values under one key."""

    @property
    def matched(self) -> bool:
        """Whether there is a subscriber."""

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Publish one value; never blocks."""


OnSample = Callable[[RawSample], None]
OnQuery = Callable[[Query], None]
OnReply = Callable[[RawReply], None]
OnToken = Callable[[str, bool], None]  # full key of the token, whether it exists


class Session(Protocol):
    """A connection to the network of a cell."""

    @property
    def connected(self) -> bool:
        """Whether there is a link to the router (always, in process)."""

    def publisher(self, key: str, encoding: str, *, reliable: bool) -> Publisher:
        """Declare a publisher; an unreliable one drops values while the network is congested."""

    def subscriber(self, key: str, on_sample: OnSample) -> Declaration:
        """Call back for each value published under a matching key."""

    def queryable(self, key: str, on_query: OnQuery, *, complete: bool) -> Declaration:
        """Call back for each `get` that covers the key; with `complete`, an exact `get` reaches only one of them."""

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
        """Query all matching queryables; `on_done` is called once, after the last reply. Returns a cancel function."""

    def token(self, key: str) -> Declaration:
        """Declare a liveliness token, which vanishes with this session."""

    def watch_tokens(
        self, key: str, on_token: OnToken, on_first: Callable[[str], None], on_known: Callable[[], None]
    ) -> Declaration:
        """Call back for each matching token that exists, appears or vanishes.

        A watch does not say when it has reported all existing tokens. So a query comes first: `on_first` for each
        token that it finds, then once `on_known`.
        """

    def get_tokens(
        self, key: str, on_token: Callable[[str], None], on_done: Callable[[], None], *, timeout: float
    ) -> None:
        """Call back for each existing matching token, then once `on_done`; call it before any watch that covers it."""

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Call back when the router may have been lost or reached; `connected` is right a moment later."""

    def close(self) -> None:
        """Undeclare all in reverse order and close; may block, so call it in a thread with a timeout."""


class LoopNotifier:
    """Calls back on the event loop once for any number of notifications from any thread since the last call."""

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> None:
        self._loop = loop
        self._callback = callback
        self._lock = threading.Lock()
        self._pending = False

    def notify(self) -> None:
        """Schedule the callback; from any thread."""
        with self._lock:
            if self._pending:
                return
            self._pending = True
        call_on_loop(self._loop, self._run)

    def _run(self) -> None:
        with self._lock:
            self._pending = False
        self._callback()


def call_on_loop(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    """Schedule a call on the loop, from any thread; does nothing once the loop is closed."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(call)


class SendQueue:
    """A thread for reliable sends: a put blocks while the network is congested, and must not block the loop."""

    def __init__(self, lost: type[Exception]) -> None:
        """Start the thread; `lost` is raised by a send whose session or peer is gone, as if lost on the way."""
        self.dropped = 0
        self._lost = lost
        self._calls: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._busy = False
        self._closed = False
        threading.Thread(target=self._work, name="send queue", daemon=True).start()

    def post(self, call: Callable[[], None]) -> None:
        """Make the call in order; a full queue drops it, counts it and logs the first."""
        with self._changed:
            if self._closed:
                return
            if len(self._calls) < SEND_QUEUE_SIZE:
                self._calls.append(call)
                self._changed.notify_all()
                return
            self.dropped += 1
            first = self.dropped == 1
        if first:
            log.error("send queue full (%d messages); dropping new ones", SEND_QUEUE_SIZE)

    def close(self, timeout: float) -> None:
        """Wait until the queue is empty, at most `timeout` seconds, and stop the thread."""
        with self._changed:
            self._changed.wait_for(lambda: not self._calls and not self._busy, timeout)
            self._closed = True
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._calls or self._closed)
                if self._closed:
                    return
                call = self._calls.popleft()
                self._busy = True
            try:
                call()
            except self._lost as error:
                log.debug("not sent: %s", error)
            except Exception:  # a bug; if this thread ended, the service could send nothing
                log.exception("sending failed")
