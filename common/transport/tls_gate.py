"""The gate of a secured router: only clients with a valid certificate get as far as Zenoh.

Zenoh accepts no client for 100 ms after each TLS handshake that fails. So the gate does the handshake itself, and
connects to the router with a certificate of the same name (`InnerAuthority`). A connection passes two stages until it
is admitted: the handshake, and the opening of Zenoh. Each has a time limit and room for some connections; beyond it the
oldest one of the address, or then of the certificate, with the most is ended. So those that stay in a stage keep no
client out.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from common.errors import ConfigError
from common.transport.endpoint import address_of, peer_group
from common.transport.inner_certificates import InnerAuthority, name_of

log = logging.getLogger("router")

STAGE_SECONDS = 3.0  # a loaded machine takes 1 s for each stage
MAX_HANDSHAKES = 512  # clients whose handshake is not complete
MAX_OPENING = 16  # that have not opened Zenoh, which has room for 32, those of the local listener included
ROUNDS = 2  # of client and router, which open Zenoh
LOG_SECONDS = 60.0  # between two log lines about refused connections
CHUNK = 256 * 1024  # [bytes] that are forwarded at once
_CONNECT_SECONDS = 0.5  # to the router, which is in this process
_BACKLOG = 1024
_CHECK_SECONDS = 0.05


@dataclass(eq=False)
class _End:
    """One end of a forwarded connection, and the data to be written to it."""

    socket: ssl.SSLSocket
    other: _End | None = None
    unsent: memoryview = field(default_factory=lambda: memoryview(b""))
    ended: bool = False  # whether the other end has closed its side
    handshaking: bool = True
    # Of a client:
    group: str = ""  # its address, then the name in its certificate
    since: float = 0.0
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
        self._handshaking: dict[_End, None] = {}  # oldest first
        self._opening: dict[_End, None] = {}
        self._router: tuple[tuple[str, int], InnerAuthority] | None = None
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

    def open(self, host: str, port: int, authority: InnerAuthority) -> None:
        """Forward new connections to a router that trusts the authority; existing ones stay where they are.

        Raises:
            OSError: another process listens at an endpoint by now; its `filename` is the endpoint.
        """
        self._router = (host, port), authority
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
            for key, events in self._selector.select(_CHECK_SECONDS if self._handshaking or self._opening else 0.5):
                end = key.data
                try:
                    if end is None:
                        self._accept(key.fileobj)  # type: ignore[arg-type]
                    elif end.handshaking:
                        self._shake_hands(end)
                    else:
                        self._forward(end, events)
                except (OSError, ConfigError):
                    if end is not None:
                        self._end(end)
            self._check(time.monotonic())

    # --- until a connection is admitted ---------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        assert self._router is not None
        try:
            accepted, address = listener.accept()
        except OSError as error:  # gone again, or out of file descriptors: drop the oldest one
            if not isinstance(error, BlockingIOError) and self._handshaking:
                self._end(next(iter(self._handshaking)))
            return
        end = _End(self._wrap(accepted, self._router[1].server, server=True), group=peer_group(address[0]))
        self._selector.register(end.socket, selectors.EVENT_READ, end)
        self._enter(end, self._handshaking, MAX_HANDSHAKES)

    def _wrap(self, plain: socket.socket, context: ssl.SSLContext, *, server: bool) -> ssl.SSLSocket:
        plain.setblocking(False)
        try:
            plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            wrapped = context.wrap_socket(plain, server_side=server, do_handshake_on_connect=False)
        except OSError:
            plain.close()
            raise
        self._sockets.add(wrapped)
        return wrapped

    def _enter(self, end: _End, stage: dict[_End, None], most: int) -> None:
        """Add a connection to a stage; make room by ending the oldest one of the group with the most."""
        end.since = time.monotonic()
        stage[end] = None
        if len(stage) > most:
            # Zenoh's side completes its handshake, in some milliseconds: it would sleep after a failure.
            settled = [each for each in stage if each.other is None or not each.other.handshaking]
            sizes = Counter(each.group for each in settled)
            largest = max(sizes.values(), default=0)
            for each in [each for each in settled if sizes[each.group] == largest][: len(stage) - most]:
                self._end(each)

    def _shake_hands(self, end: _End) -> None:
        try:
            end.socket.do_handshake()
        except ssl.SSLWantReadError:
            self._selector.modify(end.socket, selectors.EVENT_READ, end)
            return
        except ssl.SSLWantWriteError:
            self._selector.modify(end.socket, selectors.EVENT_WRITE, end)
            return
        end.handshaking = False
        if end.other is None:
            self._connect(end)
        else:  # the router's side, which is the last
            self._selector.modify(end.socket, selectors.EVENT_READ, end)
            self._selector.register(end.other.socket, selectors.EVENT_READ, end.other)

    def _connect(self, end: _End) -> None:
        """Connect an authenticated client with the router."""
        assert self._router is not None
        address, authority = self._router
        self._selector.unregister(end.socket)
        del self._handshaking[end]
        end.group = name_of(end.socket)
        inner = socket.create_connection(address, timeout=_CONNECT_SECONDS)
        end.other = _End(self._wrap(inner, authority.client(end.group), server=False), end)
        self._selector.register(end.other.socket, selectors.EVENT_WRITE, end.other)
        self._enter(end, self._opening, MAX_OPENING)

    def _check(self, now: float) -> None:
        """End connections that took too long."""
        if now - self._checked < _CHECK_SECONDS:
            return
        self._checked = now
        if self.refused and now - self._logged > LOG_SECONDS:
            log.warning("ended %d connections that did not authenticate themselves", self.refused)
            self._logged, self.refused = now, 0
        for stage in (self._handshaking, self._opening):
            while stage and now - (oldest := next(iter(stage))).since > STAGE_SECONDS:
                self._end(oldest)

    # --- admitted connections -------------------------------------------------------------------------------------

    def _forward(self, end: _End, events: int) -> None:
        other = end.other
        assert other is not None
        if events & selectors.EVENT_WRITE:
            self._write(end, end.unsent)
        if events & selectors.EVENT_READ and not other.unsent:
            data = _read(end.socket)
            if data is None:
                return
            if end.group:
                end.spoke = True
            elif other.spoke:
                other.spoke, other.rounds = False, other.rounds + 1
                if other.rounds == ROUNDS:
                    self._opening.pop(other, None)
            other.ended = not data
            self._write(other, memoryview(data))

    def _write(self, end: _End, data: memoryview) -> None:
        """Write as much as the socket takes; while a rest waits, nothing is read for this end."""
        if not data and not end.ended and not end.unsent:
            return
        had = bool(end.unsent)
        with contextlib.suppress(ssl.SSLWantWriteError, ssl.SSLWantReadError):
            while data:
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
        for each in (end, end.other):
            if each is None:
                continue
            if each.group and each.rounds < ROUNDS:
                self.refused += 1
                each.rounds = ROUNDS  # counted once
            self._handshaking.pop(each, None)
            self._opening.pop(each, None)
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(each.socket)
            each.socket.close()
            self._sockets.discard(each.socket)


def _read(source: ssl.SSLSocket) -> bytes | None:
    """Return what has arrived, empty at the end of the stream; None if that is nothing yet."""
    parts: list[bytes] = []
    with contextlib.suppress(ssl.SSLWantReadError, ssl.SSLWantWriteError):
        while sum(map(len, parts)) < CHUNK:  # TLS gives a record of 16 kB at a time
            parts.append(source.recv(CHUNK))
            if not parts[-1]:
                return b"".join(parts)
    return b"".join(parts) or None


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
