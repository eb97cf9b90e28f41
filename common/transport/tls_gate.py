"""The gate of a secured router: only clients that start a TLS handshake at once get as far as Zenoh.

Zenoh sleeps for 100 ms whenever a TLS handshake fails, and accepts no client meanwhile. So the gate holds silent
connections, for a second and a few of each address, and delays addresses whose handshakes failed. It forwards admitted
connections byte for byte in both directions, and decrypts nothing.
"""

from __future__ import annotations

import contextlib
import logging
import select
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from common.transport.endpoint import address_of

log = logging.getLogger("router")

HELLO_SECONDS = 1.0  # in which a client must start its handshake: in TLS it speaks first
HANDSHAKE_SECONDS = 3.0  # in which it must be authenticated; a loaded machine takes 1 s
FAILURES = 10  # failed handshakes of an address before it is delayed: services start together
FORGIVEN_RATE = 4.0  # [1/s] of these that are forgiven; Zenoh endures ten
MAX_PER_ADDRESS = 32  # held connections; a new one replaces the oldest
MAX_HELD = 512  # held connections of all addresses
ROUNDS = 4  # of client and router, after which a client was admitted: TLS, the opening of Zenoh, and what follows
LOG_SECONDS = 60.0  # between two log lines about refused connections
CHUNK = 256 * 1024  # [bytes] that are forwarded at once
_HELLO = b"\x16\x03"  # of a TLS record that is part of a handshake
_BACKLOG = 1024
_CHECK_SECONDS = 0.05


@dataclass(eq=False)
class _End:
    """One end of a forwarded connection, and the data to be written to it."""

    socket: socket.socket
    other: _End | None = None
    unsent: memoryview = field(default_factory=lambda: memoryview(b""))
    ended: bool = False  # whether the other end has closed its side
    # Of a client:
    address: str = ""
    since: float = 0.0
    partial: bool = False  # whether only a part of the first bytes has arrived
    hello: bool = False  # whether it has started a handshake
    spoke: bool = False  # whether the client spoke last, not the router
    rounds: int = 0


class TlsGate:
    """Listens at endpoints and forwards connections to a router, in a thread of its own. A `with` block."""

    def __init__(self, endpoints: Iterable[str]) -> None:
        """Bind the endpoints; accept connections from `open` on, when the router also listens at its near endpoints.

        Raises:
            OSError: an endpoint cannot be bound; its `filename` is the endpoint.
        """
        self._selector = selectors.DefaultSelector()
        self._listeners: dict[str, socket.socket] = {}  # by endpoint
        self._held: dict[str, deque[_End]] = {}  # by address, oldest first
        self._unproven: deque[_End] = deque()  # admitted, and not authenticated for sure
        self._failed: dict[str, tuple[float, float]] = {}  # by address: unforgiven failures at a time
        self._router: tuple[str, int] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tls gate", daemon=True)
        self._sockets: set[socket.socket] = set()
        self._checked = 0.0
        self._logged = -LOG_SECONDS
        self.refused = 0
        for endpoint in endpoints:
            try:
                self._listeners[endpoint] = _bound_listener(*address_of(endpoint))
            except OSError as error:
                self.close()
                error.filename = endpoint
                raise

    def __enter__(self) -> TlsGate:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self, host: str, port: int) -> None:
        """Forward new connections to a router at this address; existing ones stay where they are.

        Raises:
            OSError: another process listens at an endpoint by now; its `filename` is the endpoint.
        """
        self._router = host, port
        if self._thread.is_alive():
            return
        for endpoint, listener in self._listeners.items():
            try:
                listener.listen(_BACKLOG)
            except OSError as error:
                error.filename = endpoint
                raise
            self._selector.register(listener, selectors.EVENT_READ)
        self._thread.start()

    def close(self) -> None:
        """Close all connections and listeners."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        for each in (*self._listeners.values(), *self._sockets):
            each.close()
        self._selector.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for key, events in self._selector.select(_CHECK_SECONDS if self._held or self._unproven else 0.5):
                end = key.data
                try:
                    if end is None:
                        self._accept(key.fileobj)  # type: ignore[arg-type]
                    elif end.other is None:
                        self._read_hello(end)
                    else:
                        self._forward(end, events)
                except OSError:
                    if end is not None:
                        self._end(end)
            self._check(time.monotonic())

    # --- held connections -----------------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        try:
            accepted, address = listener.accept()
        except OSError as error:  # gone again, or out of file descriptors: drop the oldest held one
            if not isinstance(error, BlockingIOError) and self._held:
                self._end_oldest()
            return
        accepted.setblocking(False)
        end = _End(accepted, since=time.monotonic(), address=address[0])
        queue = self._held.setdefault(end.address, deque())
        queue.append(end)
        self._sockets.add(accepted)
        self._selector.register(accepted, selectors.EVENT_READ, end)
        if len(queue) > MAX_PER_ADDRESS:
            self._end(queue[0])
        elif sum(map(len, self._held.values())) > MAX_HELD:
            self._end_oldest()

    def _end_oldest(self) -> None:
        self._end(min((queue[0] for queue in self._held.values()), key=lambda end: end.since))

    def _read_hello(self, end: _End) -> None:
        """Admit a connection that starts a handshake, end any other."""
        first = end.socket.recv(6, socket.MSG_PEEK)
        if not first or first[:2] != _HELLO[: len(first)] or (len(first) == 6 and first[5] != 1):
            self._end(end)
            return
        end.partial = len(first) < 6
        with contextlib.suppress(KeyError):
            self._selector.unregister(end.socket)  # further data is read when it is admitted
        if not end.partial:
            end.hello = True
            self._admit(end, time.monotonic())

    def _admit(self, end: _End, now: float) -> None:
        if self._failures(end.address, now) > FAILURES - 1:
            return
        if _is_gone(end.socket):
            self._end(end)
            return
        assert self._router is not None
        inner = socket.create_connection(self._router, timeout=HELLO_SECONDS)
        inner.setblocking(False)
        self._sockets.add(inner)
        for forwarded in (end.socket, inner):
            forwarded.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        other = _End(inner, end)
        self._remove_held(end)
        end.other, end.since = other, now
        self._unproven.append(end)
        for each in (end, other):
            self._selector.register(each.socket, selectors.EVENT_READ, each)

    def _remove_held(self, end: _End) -> None:
        queue = self._held.get(end.address)
        if queue and end in queue:
            queue.remove(end)
            if not queue:
                del self._held[end.address]

    def _check(self, now: float) -> None:
        """End connections that took too long, and admit delayed ones."""
        if now - self._checked < _CHECK_SECONDS:
            return
        self._checked = now
        if self.refused and now - self._logged > LOG_SECONDS:
            log.warning("ended %d connections that did not authenticate themselves", self.refused)
            self._logged, self.refused = now, 0
        while self._unproven and now - self._unproven[0].since > HANDSHAKE_SECONDS:
            if (unproven := self._unproven.popleft()).rounds < ROUNDS:
                self._end(unproven)
        for queue in [*self._held.values()]:
            for end in [*reversed(queue)]:  # the newest client most likely still waits
                try:
                    if end.partial:
                        self._read_hello(end)
                    elif end.hello:
                        self._admit(end, now)
                except OSError:
                    self._end(end)
                if end.other is None and now - end.since > (HANDSHAKE_SECONDS if end.hello else HELLO_SECONDS):
                    self._end(end)
        if len(self._failed) > MAX_HELD:
            self._failed = {address: known for address, known in self._failed.items() if self._failures(address, now)}

    def _failures(self, address: str, now: float) -> float:
        """Return the failed handshakes of an address that are not forgiven yet."""
        count, then = self._failed.get(address, (0.0, now))
        return max(0.0, count - FORGIVEN_RATE * (now - then))

    # --- admitted connections -------------------------------------------------------------------------------------

    def _forward(self, end: _End, events: int) -> None:
        other = end.other
        assert other is not None
        if events & selectors.EVENT_WRITE:
            self._write(end, end.unsent)
        if events & selectors.EVENT_READ and not other.unsent:
            try:
                data = end.socket.recv(CHUNK)
            except BlockingIOError:
                return
            if end.address:
                end.spoke = True
            elif other.spoke:
                other.spoke, other.rounds = False, other.rounds + 1
            other.ended = not data
            self._write(other, memoryview(data))

    def _write(self, end: _End, data: memoryview) -> None:
        """Write as much as the socket takes; while a rest waits, nothing is read for this end."""
        if not data and not end.ended and not end.unsent:
            return
        had = bool(end.unsent)
        if data:
            with contextlib.suppress(BlockingIOError):
                data = data[end.socket.send(data):]
        end.unsent = data
        if end.ended and not data:
            self._end(end)
            return
        if had or data or end.ended:
            assert end.other is not None
            self._select(end)
            self._select(end.other)

    def _select(self, end: _End) -> None:
        """Register the events that an end waits for."""
        assert end.other is not None
        read = not end.other.unsent and not end.other.ended
        events = (selectors.EVENT_READ if read else 0) | (selectors.EVENT_WRITE if end.unsent else 0)
        known = self._selector.get_map().get(end.socket)
        if known is None and events:
            self._selector.register(end.socket, events, end)
        elif known is not None and not events:
            self._selector.unregister(end.socket)
        elif known is not None and known.events != events:
            self._selector.modify(end.socket, events, end)

    def _end(self, end: _End) -> None:
        self._remove_held(end)
        for each in (end, end.other):
            if each is None:
                continue
            if each.address and each.rounds < ROUNDS:
                self.refused += 1
                if each.other is not None:  # Zenoh sleeps now
                    now = time.monotonic()
                    self._failed[each.address] = min(1 + self._failures(each.address, now), 1.5 * FAILURES), now
                each.rounds = ROUNDS  # counted once
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(each.socket)
            each.socket.close()
            self._sockets.discard(each.socket)


def _is_gone(client: socket.socket) -> bool:
    """Return whether a client has closed its side, which a read does not show while data is left."""
    poll = select.poll()
    poll.register(client, select.POLLRDHUP)
    return bool(poll.poll(0))


def _bound_listener(host: str, port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if listener.family == socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, host != "::")
        listener.bind((host, port))
    except OSError:
        listener.close()
        raise
    listener.setblocking(False)
    return listener
