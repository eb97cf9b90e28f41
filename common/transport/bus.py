"""The bus of a service: its operations on the network, the same over Zenoh and in process; one run of its coroutine."""

from __future__ import annotations

import asyncio
import copy
import logging
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import replace
from typing import Any, Self, TypeVar

from common import topics
from common.arms import arm_table
from common.clock import Clock
from common.errors import ConfigError
from common.messages import Header, Message, ServiceCounters
from common.remapping import Remapping
from common.topics import Request, Topic, of_service
from common.transport.codec import DEFAULT_LIMIT
from common.transport.ownership import SHARED, Owner, Ownership
from common.transport.reader import Reader
from common.transport.requests import Client, Server
from common.transport.session import Declaration, RawReply, Session, alive_key, call_on_loop, serves_key
from common.transport.tokens import Alive, TokenWatch
from common.transport.writer import RawAccess, Writer

_END_SECONDS = 1.0  # for a cancelled service to end


class ServiceRun:
    """Runs the coroutine of a bus and ends it after a failure elsewhere."""

    def __init__(self, service: str, log: logging.Logger, withdraw: Callable[[], Awaitable[None]]) -> None:
        """Prepare a run on the running loop.

        Args:
            service: name of the task.
            log: of the service.
            withdraw: awaited when another process has one of the service's keys, before the service is cancelled.
        """
        self._service, self._log, self._withdraw = service, log, withdraw
        self._failure: asyncio.Future[BaseException] = asyncio.get_running_loop().create_future()
        self._running = False
        self._keys_lost = False

    def fail(self, error: BaseException) -> None:
        """End the service because a request handler crashed."""
        if not self._running:  # a tool's bus has no service to end
            self._log.error("the handler of a request crashed", exc_info=error)
        elif not self._failure.done():
            self._failure.set_result(error)

    def lose_keys(self, error: ConfigError) -> None:
        """End the service because another process has one of its keys."""
        self._keys_lost = True
        self.fail(error)

    async def run(self, service: Coroutine[Any, Any, None]) -> None:
        """Run the coroutine to its end or to the first failure, which is raised."""
        self._running = True
        task = asyncio.create_task(service, name=self._service)
        both: set[asyncio.Future[Any]] = {task, self._failure}
        try:
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            if self._keys_lost:
                await self._withdraw()
        finally:
            await self._end(task)
        if self._failure.done():
            raise self._failure.result()
        await task

    async def _end(self, task: asyncio.Task[None]) -> None:
        if task.done():
            return
        task.cancel()
        await asyncio.wait({task}, timeout=_END_SECONDS)
        if not task.done():
            self._log.error("the service ignores its cancellation")
        elif not task.cancelled() and task.exception() is not None:
            self._log.error("crashed while it ended", exc_info=task.exception())


__all__ = ["Bus", "Client", "Reader", "Writer"]  # for type hints of services

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
T = TypeVar("T", bound=Topic[Any] | Request[Any, Any])

REPEAT_SECONDS = 1.0  # wall time between repetitions of a state, and between counters
_SETTLE_SECONDS = 0.05  # after which a session knows the state that it has just reported


async def _save_nothing() -> None:
    """Return at once."""


class Bus(RawAccess):
    """Connection of a service to its cell. Created and used on a running loop; writers may put from any thread."""

    reader_class: type[Reader[Any]] = Reader
    client_class: type[Client[Any, Any]] = Client

    def __init__(
        self, session: Session, *, service: str, cell: str, clock: Clock, limit: int = DEFAULT_LIMIT,
        topics: Mapping[str, str] | None = None,
    ) -> None:
        """Connect a service to its cell.

        Args:
            session: connection to the network.
            service: name of the service.
            cell: name of the cell, first part of every key.
            clock: the cell's clock.
            limit: largest payload that is decoded [bytes].
            topics: keys of the cell by the keys in the service's code, as in common/remapping.py.
        """
        super().__init__(session, service)
        self.cell = cell
        self.clock = clock
        self.endpoint = ""  # of the router, in a process of its own; for a further session
        self.log = logging.getLogger(service)
        self.ready_event = asyncio.Event()
        self._limit = limit
        self._remapping = Remapping(topics)
        self._service_run = ServiceRun(service, self.log, self._withdraw)
        self._readers: list[Reader[Any]] = []
        self._writers: list[Writer[Any]] = []
        self._servers: list[Server[Any, Any]] = []
        self._tokens: list[Declaration] = []
        self._ownership = Ownership(
            session, cell, service, loop=self._loop, warn=lambda line: self.log.warning("%s", line),
            lose=self._service_run.lose_keys)
        self._deferring = self._has_keys = False
        self._watches: dict[str, TokenWatch] = {}
        self._subscriptions: dict[Reader[Any], Declaration] = {}
        self._on_parameters: list[Callable[[], None]] = []
        self.save_parameters: Callable[[], Awaitable[None]] = _save_nothing  # awaited before a change is answered
        self._alive: Alive | None = None
        self._counters: Writer[ServiceCounters] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._closed = False
        self._was_connected = session.connected
        session.watch_connection(lambda: call_on_loop(self._loop, self._check_connection_soon))
        self._tick()

    # --- declarations ---------------------------------------------------------------------------------------------

    def reader(self, topic: Topic[M], *, size: int = 1000, listening: bool = True) -> Reader[M]:
        """Return a reader of the topic; it queues at most `size` events.

        With `listening=False` it receives nothing until `listen`.
        """
        reader = self.reader_class(self._in_cell(topic), self._loop, self.log, size=size, limit=self._limit)
        self._readers.append(reader)
        if listening:
            self.listen(reader, True)
        return reader

    def listen(self, reader: Reader[Any], on: bool) -> None:
        """Subscribe a reader to its topic, or unsubscribe it: some writers only write while there is a subscriber."""
        topic = reader.topic
        if not on:
            if reader in self._subscriptions:
                self._subscriptions.pop(reader).undeclare()
            return
        if reader in self._subscriptions:
            return
        key = f"{self.cell}/{topic.expression}"
        self._subscriptions[reader] = self.raw_subscriber(key, reader.arrive)
        if topic.kind == "state":  # subscribed first, so that no value is missed in between

            def on_reply(reply: RawReply) -> None:
                if reply.sample is not None:
                    reader.arrive(reply.sample)

            self._session.get(key, on_reply, lambda: None, timeout=2.0)

    def writer(self, topic: Topic[M]) -> Writer[M]:
        """Return a writer of the topic."""
        topic = of_service(topic, self.service)
        written = self._in_cell(topic)
        deferred = self._deferring and not self._has_keys
        writer = Writer(self._session, self.cell, self.service, written, deferred=deferred)
        self._ownership.claim(written.key, topic.key)
        self._writers.append(writer)
        return writer

    def serve(
        self, topic: Request[Q, A], handler: Callable[[Q], Awaitable[A]], *, max_pending: int | None = None,
        on_overload: Callable[[], str] | None = None,
    ) -> None:
        """Answer requests with `await handler(request)`, concurrently, from `ready` on.

        The handler raises `Refused` to refuse one; any other exception goes to the client and ends the service.

        Args:
            topic: the request key.
            handler: returns the answer.
            max_pending: requests that wait, else 1000; further ones are refused unread.
            on_overload: called for each of these; returns what it did, for the error reply.
        """
        served = self._in_cell(topic)
        self._ownership.claim(served.key, topic.key)
        self._servers.append(
            Server(
                self._session, self.cell, self.service, served, handler, loop=self._loop, log=self.log,
                ready=self.ready_event, crash=self._service_run.fail, limit=self._limit, max_pending=max_pending,
                on_overload=on_overload,
            )
        )
        if self.ready_event.is_set():
            self._open(self._servers[-1])

    def client(self, topic: Request[Q, A]) -> Client[Q, A]:
        """Return a client of the request key."""
        called = self._in_cell(topic)
        servers = self._watch(serves_key(self.cell, called.key))
        return self.client_class(
            self._session, self.cell, self.service, called, servers, loop=self._loop, limit=self._limit
        )

    def of_arm(self, arm: str) -> Self:
        """Return this bus for declarations with the keys of an arm, which are below its name; itself for no name."""
        if not arm:
            return self
        view = copy.copy(self)  # shares what is declared, so that its own bus counts, repeats and closes it
        view._remapping = Remapping(self._remapping.table | arm_table(arm))
        return view

    def full_key(self, topic: Topic[Any] | Request[Any, Any]) -> str:
        """Return the key of a topic or request on the wire."""
        return f"{self.cell}/{self._remapping.key(topic.key)}"

    def _in_cell(self, topic: T) -> T:
        """Return the topic or request under its remapped key, with the validators of its messages built."""
        for message in (topic.message, *((topic.answer,) if isinstance(topic, Request) else ())):
            message.model_rebuild()
        key = self._remapping.key(topic.key)
        return topic if key == topic.key else replace(topic, key=key)

    def on_parameters(self, callback: Callable[[], None]) -> None:
        """Call `callback()` after changes of this service's parameters, for values that are not read at each use."""
        self._on_parameters.append(callback)

    def parameters_changed(self) -> None:
        """Call the callbacks of `on_parameters`."""
        for callback in self._on_parameters:
            callback()

    # --- ownership and readiness ----------------------------------------------------------------------------------

    def defer_writes(self) -> None:
        """Let writers declared from now on publish nothing before `acquire_keys` succeeds."""
        self._deferring = True

    async def acquire_keys(self) -> None:
        """Return when no other process writes or serves a key declared so far; then publish what was deferred.

        `ready` calls it too. Load persistent state after it: before, another process of the same name may change it.

        Raises:
            ConfigError: another service has one of the keys, or a remapped key is none of this service.
        """
        if self._has_keys:
            return
        self._remapping.require_used(self.service)
        counters = of_service(topics.COUNTERS, self.service)
        self._ownership.claim(counters.key, counters.key)
        await self._ownership.settle()
        self._has_keys = True
        for writer in self._writers:
            writer.raw.release()

    async def ready(self) -> None:
        """Announce that this service is ready: the tokens of its keys first, its own token last.

        Raises:
            ConfigError: as `acquire_keys`.
        """
        await self.acquire_keys()
        counters = of_service(topics.COUNTERS, self.service)
        self._counters = Writer(self._session, self.cell, self.service, counters)
        for server in self._servers:
            self._open(server)
        self.ready_event.set()
        self._declare_token(alive_key(self.cell, self.service))

    def announce(self) -> None:
        """Let tools find this process in the cell, although it is no service."""
        self._declare_token(alive_key(self.cell, self.service))

    def _open(self, server: Server[Any, Any]) -> None:
        server.open()
        self._declare_token(serves_key(self.cell, server.topic.key, self.service))

    def _watch(self, key: str) -> TokenWatch:
        # One per key: Zenoh would answer a second one from what the first has seen so far, which may be nothing yet.
        if key not in self._watches:
            self._watches[key] = TokenWatch(self._session, key, self._loop)
        return self._watches[key]

    def _declare_token(self, key: str) -> None:
        self._tokens.append(self._session.token(key))

    # --- state ----------------------------------------------------------------------------------------------------

    @property
    def connected(self) -> bool:
        """Whether there is a link to the router."""
        return self._session.connected

    @property
    def alive(self) -> Alive:
        """The ready services of the cell; watched from the first use on."""
        if self._alive is None:
            self._alive = Alive(self._watch(alive_key(self.cell)))
        return self._alive

    async def owners(self) -> list[Owner]:
        """Return which service writes or serves which key: services that are ready or just becoming so."""
        return await self._ownership.owners()

    def header(self, frame_id: str = "") -> Header:
        """Return a header stamped with the current cell time."""
        return Header(stamp=self.clock.now_ns(), frame_id=frame_id)

    def counters(self) -> ServiceCounters:
        """Return the numbers of received, dropped and refused messages so far, by key."""
        writes = [w.topic.key for w in self._writers if not w.topic.signed and w.topic.key not in SHARED]
        counted = ServiceCounters(header=self.header(), service=self.service, writes=writes)
        sources: list[Reader[Any] | Server[Any, Any]] = [*self._readers, *self._servers]
        for source in sources:
            key = source.topic.key
            counted.received[key] = counted.received.get(key, 0) + source.received
            if source.invalid:
                counted.invalid[key] = counted.invalid.get(key, 0) + source.invalid
        for reader in self._readers:
            key = reader.topic.key
            if reader.dropped:
                counted.dropped[key] = counted.dropped.get(key, 0) + reader.dropped
            if reader.overflow:
                counted.overflow[key] = counted.overflow.get(key, 0) + reader.overflow
        return counted

    # --- life cycle -----------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        """Repeat states: a late plain client and a restarted router have them within a second."""
        self._timer = self._loop.call_later(REPEAT_SECONDS, self._tick)
        for raw in (*(writer.raw for writer in self._writers if writer.topic.kind == "state"), *self._raw_states):
            raw.repeat()
        if self._counters is not None:
            self._counters.put(self.counters())

    def _check_connection_soon(self) -> None:
        self._loop.call_later(_SETTLE_SECONDS, self._check_connection)

    def _check_connection(self) -> None:
        now = self._session.connected
        if now != self._was_connected and not self._closed:
            (self.log.info if now else self.log.warning)("the router %s", "is back" if now else "is lost")
        self._was_connected = now

    async def run(self, service: Coroutine[Any, Any, None]) -> None:
        """Run a service's coroutine to its end; cancel it if a handler crashes or another process has one of its keys.

        A service that moves hardware brings it to rest when it is cancelled; it has a second for that.
        """
        await self._service_run.run(service)

    async def _withdraw(self) -> None:
        """Serve and write nothing but the log: another process has the keys."""
        await self.close()
        for writer in self._writers:
            if not writer.topic.signed:
                writer.raw.close()

    async def close(self) -> None:
        """Undeclare all tokens and cancel running requests. The owner of the session closes the session."""
        if self._closed:
            return
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        for token in reversed(self._tokens):
            token.undeclare()
        self._ownership.close()
        for server in self._servers:
            await server.close()
