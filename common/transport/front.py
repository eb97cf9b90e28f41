"""What stands before a secured router: only who begins to prove himself at once gets as far as Zenoh.

Zenoh sleeps 100 ms whenever a TLS handshake fails, and accepts nobody meanwhile. So connections that say nothing are
held here, a second long and a few of each address, and those that failed make others of their address wait. What is
let through is passed on byte for byte, both ways; nothing is decrypted here.
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

HELLO_SECONDS = 1.0  # in which a client has begun its handshake: it speaks first
YOUNG_SECONDS = 3.0  # in which it is proven; a loaded machine takes 1 s
FAILURES = 10  # handshakes of an address that may fail before others of it wait: services start together
FORGIVEN = 4.0  # of these in a second; Zenoh bears ten
MOST_OF_ADDRESS = 32  # connections that have not begun, or wait: the oldest goes for a new one
MOST_WAITING = 512  # of all addresses
ROUNDS = 4  # of client and router, after which a client was let in: TLS, what Zenoh opens with, and what follows
TELL_SECONDS = 60.0  # between two lines of the log about who was refused
CHUNK = 256 * 1024  # [bytes] that are passed on at once
_HELLO = b"\x16\x03"  # of a TLS record that is part of a handshake
_BACKLOG = 1024
_LOOK_SECONDS = 0.05


@dataclass(eq=False)
class _End:
    """One end of a connection, and what waits to be written to it."""

    socket: socket.socket
    other: _End | None = None
    waiting: memoryview = field(default_factory=lambda: memoryview(b""))
    ended: bool = False  # the other end has said all
    # Of a client, that is of who came to us:
    address: str = ""
    since: float = 0.0
    part: bool = False  # of the first bytes came
    begun: bool = False  # with a handshake
    spoke: bool = False  # last, not the router
    rounds: int = 0


class Front:
    """Listens at endpoints and passes connections on to a router; one thread of its own. A `with` block."""

    def __init__(self, endpoints: Iterable[str]) -> None:
        """Take the endpoints; nobody is heard before `open`, by when the router listens where services come in near it.

        Raises:
            OSError: it cannot listen there; its `filename` is the endpoint.
        """
        self._selector = selectors.DefaultSelector()
        self._listeners: dict[str, socket.socket] = {}  # by endpoint
        self._waiting: dict[str, deque[_End]] = {}  # by address, oldest first
        self._young: deque[_End] = deque()
        self._failed: dict[str, tuple[float, float]] = {}  # how many of an address, and when that was so
        self._behind: tuple[str, int] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="front", daemon=True)
        self._sockets: set[socket.socket] = set()
        self._looked = 0.0
        self._told = -TELL_SECONDS
        self.refused = 0
        for endpoint in endpoints:
            try:
                self._listeners[endpoint] = _bound(*address_of(endpoint))
            except OSError as error:
                self.close()
                error.filename = endpoint
                raise

    def __enter__(self) -> Front:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self, host: str, port: int) -> None:
        """Pass connections on to a router that listens there; those that are passed on already stay where they are.

        Raises:
            OSError: somebody else listens at an endpoint by now; its `filename` is that.
        """
        self._behind = host, port
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
        """End every connection, and listen no more."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        for each in (*self._listeners.values(), *self._sockets):
            each.close()
        self._selector.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for key, events in self._selector.select(_LOOK_SECONDS if self._waiting or self._young else 0.5):
                end = key.data
                try:
                    if end is None:
                        self._accept(key.fileobj)  # type: ignore[arg-type]
                    elif end.other is None:
                        self._hear(end)
                    else:
                        self._pass_on(end, events)
                except OSError:
                    if end is not None:
                        self._end(end)
            self._look(time.monotonic())

    # --- before it is let through ---------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        try:
            made, address = listener.accept()
        except OSError as error:  # gone again, or no more files can be opened: the oldest that waits is given up
            if not isinstance(error, BlockingIOError) and self._waiting:
                self._give_up_oldest()
            return
        made.setblocking(False)
        end = _End(made, since=time.monotonic(), address=address[0])
        queue = self._waiting.setdefault(end.address, deque())
        queue.append(end)
        self._sockets.add(made)
        self._selector.register(made, selectors.EVENT_READ, end)
        if len(queue) > MOST_OF_ADDRESS:
            self._end(queue[0])
        elif sum(map(len, self._waiting.values())) > MOST_WAITING:
            self._give_up_oldest()

    def _give_up_oldest(self) -> None:
        self._end(min((queue[0] for queue in self._waiting.values()), key=lambda end: end.since))

    def _hear(self, end: _End) -> None:
        """Let a connection through that begins a handshake, end one that begins something else."""
        begun = end.socket.recv(6, socket.MSG_PEEK)
        if not begun or begun[:2] != _HELLO[: len(begun)] or (len(begun) == 6 and begun[5] != 1):
            self._end(end)
            return
        end.part = len(begun) < 6
        with contextlib.suppress(KeyError):
            self._selector.unregister(end.socket)  # what it says next is read when it is its turn
        if not end.part:
            end.begun = True
            self._let_through(end, time.monotonic())

    def _let_through(self, end: _End, now: float) -> None:
        if self._failures(end.address, now) > FAILURES - 1:
            return
        if _is_gone(end.socket):
            self._end(end)
            return
        assert self._behind is not None
        inner = socket.create_connection(self._behind, timeout=HELLO_SECONDS)
        inner.setblocking(False)
        self._sockets.add(inner)
        for made in (end.socket, inner):
            made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        other = _End(inner, end)
        self._leave(end)
        end.other, end.since = other, now
        self._young.append(end)
        for each in (end, other):
            self._selector.register(each.socket, selectors.EVENT_READ, each)

    def _leave(self, end: _End) -> None:
        queue = self._waiting.get(end.address)
        if queue and end in queue:
            queue.remove(end)
            if not queue:
                del self._waiting[end.address]

    def _look(self, now: float) -> None:
        """End what has said nothing for too long, and let through whose turn it is."""
        if now - self._looked < _LOOK_SECONDS:
            return
        self._looked = now
        if self.refused and now - self._told > TELL_SECONDS:
            log.warning("ended %d connections that did not prove themselves", self.refused)
            self._told, self.refused = now, 0
        while self._young and now - self._young[0].since > YOUNG_SECONDS:
            if (young := self._young.popleft()).rounds < ROUNDS:
                self._end(young)
        for queue in [*self._waiting.values()]:
            for end in [*reversed(queue)]:  # who came last is most likely to be there still
                try:
                    if end.part:
                        self._hear(end)
                    elif end.begun:
                        self._let_through(end, now)
                except OSError:
                    self._end(end)
                if end.other is None and now - end.since > (YOUNG_SECONDS if end.begun else HELLO_SECONDS):
                    self._end(end)
        if len(self._failed) > MOST_WAITING:
            self._failed = {address: known for address, known in self._failed.items() if self._failures(address, now)}

    def _failures(self, address: str, now: float) -> float:
        """How many handshakes of an address failed and are not forgiven."""
        count, then = self._failed.get(address, (0.0, now))
        return max(0.0, count - FORGIVEN * (now - then))

    # --- after ----------------------------------------------------------------------------------------------------

    def _pass_on(self, end: _End, events: int) -> None:
        other = end.other
        assert other is not None
        if events & selectors.EVENT_WRITE:
            self._write(end, end.waiting)
        if events & selectors.EVENT_READ and not other.waiting:
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
        """Write what can be; the rest waits, and nothing is read for it meanwhile."""
        if not data and not end.ended and not end.waiting:
            return
        had = bool(end.waiting)
        if data:
            with contextlib.suppress(BlockingIOError):
                data = data[end.socket.send(data):]
        end.waiting = data
        if end.ended and not data:
            self._end(end)
            return
        if had or data or end.ended:
            assert end.other is not None
            self._want(end)
            self._want(end.other)

    def _want(self, end: _End) -> None:
        assert end.other is not None
        read = not end.other.waiting and not end.other.ended
        wanted = (selectors.EVENT_READ if read else 0) | (selectors.EVENT_WRITE if end.waiting else 0)
        known = self._selector.get_map().get(end.socket)
        if known is None and wanted:
            self._selector.register(end.socket, wanted, end)
        elif known is not None and not wanted:
            self._selector.unregister(end.socket)
        elif known is not None and known.events != wanted:
            self._selector.modify(end.socket, wanted, end)

    def _end(self, end: _End) -> None:
        self._leave(end)
        for each in (end, end.other):
            if each is None:
                continue
            if each.address and each.rounds < ROUNDS:
                self.refused += 1
                if each.other is not None:  # Zenoh sleeps now
                    now = time.monotonic()
                    self._failed[each.address] = min(1 + self._failures(each.address, now), 1.5 * FAILURES), now
                each.rounds = ROUNDS  # ended once
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(each.socket)
            each.socket.close()
            self._sockets.discard(each.socket)


def _is_gone(client: socket.socket) -> bool:
    """Whether a client has ended, which is not seen behind what it has sent."""
    poll = select.poll()
    poll.register(client, select.POLLRDHUP)
    return bool(poll.poll(0))


def _bound(host: str, port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if made.family == socket.AF_INET6:
            made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, host != "::")
        made.bind((host, port))
    except OSError:
        made.close()
        raise
    made.setblocking(False)
    return made
