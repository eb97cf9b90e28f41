"""The bus: everything that a service may do on the network, the same over Zenoh and in process."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping
from dataclasses import replace
from typing import Any, TypeVar

from common import topics
from common.clock import Clock
from common.errors import ConfigError
from common.messages import Header, Message, ServiceCounters
from common.remapping import Remapping
from common.topics import PublishedKind, Request, Topic, of_service
from common.transport.codec import DEFAULT_LIMIT
from common.transport.copies import without_copies
from common.transport.handoff import Doorbell, call_on_loop
from common.transport.keys import alive_key, serves_key
from common.transport.ownership import SHARED, Owner, Ownership
from common.transport.reader import Reader
from common.transport.requests import Client, Server
from common.transport.session import Declared, Publisher, RawReply, RawSample, Session
from common.transport.tokens import Alive, TokenWatch, tokens_now
from common.transport.writer import RawWriter, Writer

__all__ = ["Bus", "Client", "Reader", "Writer"]  # what the type hints of a service name

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
T = TypeVar("T", bound=Topic[Any] | Request[Any, Any])

REPEAT_SECONDS = 1.0  # wall time between repetitions of a state, and between counters
_MOST_RAW = 1000
_SETTLE_SECONDS = 0.05  # after which a session knows about what it has just reported
_END_SECONDS = 1.0  # for a cancelled service to end


async def _keep_nothing() -> None:
    """Return at once."""


class Bus:
    """A service's place in its cell. Made on a running loop and used on it; writers may put from any thread."""

    make_reader: type[Reader[Any]] = Reader  # a simulation has its own, which look on
    make_client: type[Client[Any, Any]] = Client
    has_threads = True  # in a simulation nothing is done beside the loop
    has_process = True  # in a simulation nobody lets go of the files of who is killed
    declares_only = False  # whether a service is only to say what it reads and writes, and to do nothing

    def __init__(
        self, session: Session, *, service: str, cell: str, clock: Clock, limit: int = DEFAULT_LIMIT,
        topics: Mapping[str, str] | None = None,
    ) -> None:
        """Take a place in a cell.

        Args:
            session: connection to the network.
            service: name of the service.
            cell: name of the cell, first part of every key.
            clock: the cell's clock.
            limit: largest payload that is read [bytes].
            topics: keys of the cell by the service's own words for them, as common/remapping.py has it.
        """
        self.service = service
        self.cell = cell
        self.clock = clock
        self.log = logging.getLogger(service)
        self.ready_event = asyncio.Event()
        self._session = session
        self._limit = limit
        self._remapping = Remapping(topics)
        self._loop = asyncio.get_running_loop()
        self._crash: asyncio.Future[BaseException] = self._loop.create_future()
        self._readers: list[Reader[Any]] = []
        self._writers: list[Writer[Any]] = []
        self._raw_states: list[RawWriter] = []
        self._servers: list[Server[Any, Any]] = []
        self._tokens: list[Declared] = []
        self._ownership = Ownership(
            session, cell, service, loop=self._loop, warn=lambda told: self.log.warning("%s", told), lose=self._lose)
        self._holds = self._owns = False
        self._lost = False  # what is ours to somebody else
        self._watches: dict[str, TokenWatch] = {}
        self._heard: dict[Reader[Any], Declared] = {}  # readers that are subscribed
        self._retuned: list[Callable[[], None]] = []
        self.keep_parameters: Callable[[], Awaitable[None]] = _keep_nothing  # before a change of them is answered
        self._alive: Alive | None = None
        self._counters: Writer[ServiceCounters] | None = None
        self._beat: asyncio.TimerHandle | None = None
        self._closed = False
        self._running = False
        self._was_connected = session.connected
        session.watch_connection(lambda: call_on_loop(self._loop, self._look_at_connection_soon))
        self._tick()

    # --- declarations ---------------------------------------------------------------------------------------------

    def reader(self, topic: Topic[M], *, size: int = 1000, listening: bool = True) -> Reader[M]:
        """A reader of the topic; `size` is the most events that wait in it.

        With `listening=False` nothing comes until `listen` says so.
        """
        reader = self.make_reader(self._in_cell(topic), self._loop, self.log, size=size, limit=self._limit)
        self._readers.append(reader)
        if listening:
            self.listen(reader, True)
        return reader

    def listen(self, reader: Reader[Any], on: bool) -> None:
        """Subscribe a reader to its topic, or end that: some writers only write while somebody listens."""
        topic = reader.topic
        if not on:
            if reader in self._heard:
                self._heard.pop(reader).undeclare()
            return
        if reader in self._heard:
            return
        key = f"{self.cell}/{topic.expression}"
        self._heard[reader] = self.raw_subscriber(key, reader.arrive)
        if topic.kind == "state":  # subscribed first: nothing can fall between the two

            def on_reply(reply: RawReply) -> None:
                if reply.sample is not None:
                    reader.arrive(reply.sample)

            self._session.get(key, on_reply, lambda: None, timeout=2.0)

    def writer(self, topic: Topic[M]) -> Writer[M]:
        """A writer of the topic."""
        topic = of_service(topic, self.service)
        written = self._in_cell(topic)
        writer = Writer(self._session, self.cell, self.service, written, held=self._holds and not self._owns)
        self._ownership.claim(written.key, topic.key)
        self._writers.append(writer)
        return writer

    def serve(
        self, topic: Request[Q, A], handler: Callable[[Q], Awaitable[A]], *, most: int | None = None,
        crowded: Callable[[], str] | None = None,
    ) -> None:
        """Answer requests with `await handler(request)`, concurrently, from `ready` on.

        Of more than `most`, else 1000, that wait the rest is refused, unread, with what `crowded()` did about it.

        The handler raises `Refused` to refuse one; any other exception is told to the requester and ends the service.
        """
        served = self._in_cell(topic)
        self._ownership.claim(served.key, topic.key)
        self._servers.append(
            Server(
                self._session, self.cell, self.service, served, handler, loop=self._loop, log=self.log,
                ready=self.ready_event, crash=self._on_crash, limit=self._limit, most=most, crowded=crowded,
            )
        )
        if self.ready_event.is_set():
            self._servers[-1].open()
            self._declare_token(serves_key(self.cell, served.key, self.service))

    def client(self, topic: Request[Q, A]) -> Client[Q, A]:
        """A client of the request key."""
        asked = self._in_cell(topic)
        servers = self._watch(serves_key(self.cell, asked.key))
        return self.make_client(
            self._session, self.cell, self.service, asked, servers, loop=self._loop, limit=self._limit
        )

    def full_key(self, topic: Topic[Any] | Request[Any, Any]) -> str:
        """The key of a topic or request on the wire."""
        return f"{self.cell}/{self._remapping.key(topic.key)}"

    def _in_cell(self, topic: T) -> T:
        """The topic or request under its key in the cell, with its messages ready to be read."""
        for message in (topic.message, *((topic.answer,) if isinstance(topic, Request) else ())):
            message.model_rebuild()
        key = self._remapping.key(topic.key)
        return topic if key == topic.key else replace(topic, key=key)

    def on_parameters(self, callback: Callable[[], None]) -> None:
        """Have `callback()` called after parameters of this service were changed, for what is not read at each use."""
        self._retuned.append(callback)

    def parameters_changed(self) -> None:
        """Tell the service that its parameters were changed."""
        for callback in self._retuned:
            callback()

    def hold_back(self) -> None:
        """Send nothing that is put by writers declared from now on before what they write is ours: see `owned`."""
        self._holds = True

    async def owned(self) -> None:
        """Return when all that was declared is ours and nobody else's; then what was put is sent.

        `ready` waits for it too. A service that keeps something on disk reads it after this: until then another one
        of its name may change it.

        Raises:
            ConfigError: somebody else writes or serves the same, or a key was to be renamed that the service has not.
        """
        if self._owns:
            return
        self._remapping.require_used(self.service)
        counters = of_service(topics.COUNTERS, self.service)
        self._ownership.claim(counters.key, counters.key)
        await self._ownership.settle()
        self._owns = True
        for writer in self._writers:
            writer.release()

    async def ready(self) -> None:
        """Tell the cell that this service is ready: what it writes and serves first, its own token last.

        Raises:
            ConfigError: somebody else writes or serves the same, or a key was to be renamed that the service has not.
        """
        await self.owned()
        counters = of_service(topics.COUNTERS, self.service)
        self._counters = Writer(self._session, self.cell, self.service, counters)
        for server in self._servers:
            server.open()
            self._declare_token(serves_key(self.cell, server.topic.key, self.service))
        self.ready_event.set()
        self._declare_token(alive_key(self.cell, self.service))

    def _watch(self, key: str) -> TokenWatch:
        # One for each key: a second would be answered from what the first has seen so far, which may be nothing yet.
        if key not in self._watches:
            self._watches[key] = TokenWatch(self._session, key, self._loop)
        return self._watches[key]

    def _declare_token(self, key: str) -> None:
        self._tokens.append(self._session.token(key))

    # --- what is known --------------------------------------------------------------------------------------------

    @property
    def connected(self) -> bool:
        """Whether the router is reached."""
        return self._session.connected

    @property
    def alive(self) -> Alive:
        """The services of the cell that are ready; watched from the first use on."""
        if self._alive is None:
            self._alive = Alive(self._watch(alive_key(self.cell)))
        return self._alive

    async def owners(self) -> list[Owner]:
        """Who writes or serves what in the cell now: services that are ready or just become so."""
        return await self._ownership.owners()

    def header(self, frame_id: str = "") -> Header:
        """A header with the cell time of now."""
        return Header(stamp=self.clock.now_ns(), frame_id=frame_id)

    def counters(self) -> ServiceCounters:
        """What was received, dropped and refused so far, by key."""
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

    # --- anything on the network, for tools -----------------------------------------------------------------------

    async def raw_reader(self, key: str) -> AsyncIterator[RawSample]:
        """Everything that is put under a full key expression, such as `cell/**`, from now on; the oldest give way."""
        waiting: deque[RawSample] = deque(maxlen=_MOST_RAW)
        came = asyncio.Event()
        bell = Doorbell(self._loop, came.set)

        def on_sample(sample: RawSample) -> None:
            waiting.append(sample)
            bell.ring()

        declared = self.raw_subscriber(key, on_sample)
        try:
            while True:
                while waiting:
                    yield waiting.popleft()
                came.clear()
                await came.wait()
        finally:
            declared.undeclare()

    def raw_subscriber(self, key: str, on_sample: Callable[[RawSample], None]) -> Declared:
        """Call back, on a thread of the network's, for everything under a full key expression; it must return at once.

        What is returned takes it back.
        """
        return self._session.subscriber(key, without_copies(on_sample))

    def raw_watch(self, key: str, on_token: Callable[[str], None]) -> Declared:
        """Call back, on any thread, for each liveliness token under a full key expression that is there or appears."""
        return self._session.watch_tokens(
            key, lambda token, there: on_token(token) if there else None, on_token, lambda: None
        )

    def raw_writer(self, key: str, encoding: str, kind: PublishedKind) -> RawWriter:
        """A writer of bytes under a full key, such as what was recorded there."""
        writer = RawWriter(self._session, key, encoding, kind, self.service)
        if kind == "state":
            self._raw_states.append(writer)
        return writer

    def raw_publisher(self, key: str, encoding: str, *, reliable: bool) -> Publisher:
        """Where bytes are put under a full key just as they are, with whatever attachment."""
        return self._session.publisher(key, encoding, reliable=reliable)

    async def raw_get(
        self, key: str, timeout: float = 1.0, *, payload: bytes | None = None, encoding: str = ""
    ) -> list[RawSample]:
        """The values that can be asked for under a full key expression; requests refuse to be asked without payload."""
        samples: list[RawSample] = []
        done = asyncio.Event()

        def on_reply(reply: RawReply) -> None:
            if reply.sample is not None:
                samples.append(reply.sample)

        cancel = self._session.get(
            key, on_reply, lambda: call_on_loop(self._loop, done.set), timeout=timeout, payload=payload,
            encoding=encoding,
        )
        try:
            async with asyncio.timeout(timeout):
                await done.wait()
        except TimeoutError:
            cancel()
        return list(samples)

    async def raw_tokens(self, key: str, timeout: float = 1.0) -> list[str]:
        """The liveliness tokens that match a full key expression, such as `*/alive/*`, now."""
        return await tokens_now(self._session, key, self._loop, timeout)

    # --- life -----------------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        """Repeat states, so that a late plain client and a restarted router have them within a second."""
        self._beat = self._loop.call_later(REPEAT_SECONDS, self._tick)
        for writer in self._writers:
            if writer.topic.kind == "state":
                writer.repeat()
        for raw in self._raw_states:
            raw.repeat()
        if self._counters is not None:
            self._counters.put(self.counters())

    def _look_at_connection_soon(self) -> None:
        self._loop.call_later(_SETTLE_SECONDS, self._look_at_connection)

    def _look_at_connection(self) -> None:
        now = self._session.connected
        if now != self._was_connected and not self._closed:
            (self.log.info if now else self.log.warning)("the router %s", "is back" if now else "is lost")
        self._was_connected = now

    def _on_crash(self, error: BaseException) -> None:
        if not self._running:  # a bus without a service has nothing to end
            self.log.error("the handler of a request crashed", exc_info=error)
        elif not self._crash.done():
            self._crash.set_result(error)

    async def run(self, service: Coroutine[Any, Any, None]) -> None:
        """Run a service's coroutine to its end; it is cancelled when a handler crashes, or a key is another's.

        Whatever ends it, a service that moves something brings it to rest when it is cancelled, and has a second.
        """
        self._running = True
        task = asyncio.create_task(service, name=self.service)
        both: set[asyncio.Future[Any]] = {task, self._crash}
        try:
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            if self._lost:
                await self._withdraw()
        finally:
            await self._end(task)
        if self._crash.done():
            raise self._crash.result()
        await task

    def _lose(self, error: ConfigError) -> None:
        self._lost = True
        self._on_crash(error)

    async def _withdraw(self) -> None:
        """Leave the keys to who else has them: nothing is served any more, and nothing written but the log."""
        await self.close()
        for writer in self._writers:
            if not writer.topic.signed:
                writer.close()

    async def _end(self, task: asyncio.Task[None]) -> None:
        if task.done():
            return
        task.cancel()
        await asyncio.wait({task}, timeout=_END_SECONDS)
        if not task.done():
            self.log.error("does not end when it is cancelled")
        elif not task.cancelled() and task.exception() is not None:
            self.log.error("crashed while it ended", exc_info=task.exception())

    async def close(self) -> None:
        """Say goodbye: no token any more, requests in work are lost. The session is closed by its owner."""
        if self._closed:
            return
        self._closed = True
        if self._beat is not None:
            self._beat.cancel()
        for token in reversed(self._tokens):
            token.undeclare()
        self._ownership.close()
        for server in self._servers:
            await server.close()
