"""Requests: a server answers one exact key; a client's call ends in exactly one of five ways."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

from common.errors import DecodeError, NoResponder, Refused, RemoteError, RequestFailed, RequestLost, RequestTimeout
from common.messages import Message
from common.topics import Request
from common.transport.codec import (
    Attachment,
    checksum_of,
    current_trace,
    decode_attachment,
    decode_error,
    decode_in_thread,
    encode,
    encode_attachment,
    encode_error,
    encoding_of,
    require_intact,
    set_trace,
)
from common.transport.reader import NO_SENDER, Refusals
from common.transport.session import Declaration, Query, RawReply, Session, call_on_loop
from common.transport.tokens import TokenWatch

Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
T = TypeVar("T")

_MAX_PENDING = 1000  # requests that are not started yet
_DISCOVERY_SECONDS = 1.0  # in which a new client finds servers; then a request fails unsent
_VANISH_SECONDS = 0.25  # the token of a server that has just answered may vanish before its answer arrives


class Server(Generic[Q, A]):
    """Answers requests with a handler, each in a task of its own.

    Of a burst of requests one starts in each turn of the loop, so that other tasks run in between.
    """

    def __init__(
        self, session: Session, cell: str, service: str, topic: Request[Q, A], handler: Callable[[Q], Awaitable[A]],
        *, loop: asyncio.AbstractEventLoop, log: logging.Logger, ready: asyncio.Event,
        crash: Callable[[BaseException], None], limit: int, max_pending: int | None = None,
        on_overload: Callable[[], str] | None = None,
    ) -> None:
        self.topic = topic
        self.received = 0
        self._max_pending, self._on_overload = max_pending or _MAX_PENDING, on_overload
        self._key = f"{cell}/{topic.key}"
        self._service = service
        self._sequence = 0
        self._handler = handler
        self._closed = False
        self._ready = ready
        self._crash = crash
        self._limit = limit
        self._refusals = Refusals(topic.key, loop, log)
        self._tasks: set[asyncio.Task[None]] = set()
        self._pending: deque[Query] = deque()
        self._starting = False  # whether a started request did not run yet
        self._in_order = asyncio.Lock()
        self._session, self._loop = session, loop
        self._queryable: Declaration | None = None

    def open(self) -> None:
        """Accept requests from now on. Call it when no other server has the key, which would miss requests."""
        self._queryable = self._session.queryable(
            self._key, lambda query: call_on_loop(self._loop, lambda: self._accept(query)), complete=True)

    @property
    def invalid(self) -> int:
        """Payloads that are not valid requests."""
        return self._refusals.count

    def _accept(self, query: Query) -> None:
        if self._closed:
            query.finish()
            return
        self.received += 1
        if len(self._pending) >= self._max_pending:
            reason = f"{self._max_pending} requests wait already"
            try:
                reason += f": {self._on_overload()}" if self._on_overload is not None else ""
            finally:
                query.refuse(encode_error("busy", reason))
                query.finish()
            return
        if self._starting:
            self._pending.append(query)
        else:
            self._start(query)

    def _start(self, query: Query) -> None:
        self._starting = True
        task = asyncio.create_task(self._serve(query), name=f"{self.topic.key} request")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, query: Query) -> None:
        self._starting = False
        if self._pending:
            self._start(self._pending.popleft())
        try:
            payload = self._check(query)
            if payload is None:
                return
            await self._ready.wait()
            sender = NO_SENDER
            try:
                attachment = decode_attachment(query.attachment)
                sender = attachment.writer if attachment else NO_SENDER
                require_intact(attachment, self._key, payload)
                async with self._in_order:  # a large request does not let later ones pass
                    request = await decode_in_thread(self.topic.message, payload, self._limit)
            except DecodeError as error:
                self._refuse(query, "invalid", error, sender)
                return
            set_trace(attachment.trace if attachment else "")
            await self._answer(query, request)
        finally:
            query.finish()

    def _check(self, query: Query) -> bytes | None:
        """Return the payload; refuse a query without one or with a wildcard, such as of a tool, and return None."""
        if query.key != self._key:
            reason = f"{self._key} is a request: ask exactly for it, not {query.key}"
            self._refuse(query, "bad_request", ValueError(reason))
            return None
        if not query.payload:
            reason = f"{self._key} is a request: a {self.topic.message.__name__} as payload is needed"
            self._refuse(query, "bad_request", ValueError(reason))
            return None
        return query.payload

    def _refuse(self, query: Query, code: str, error: Exception, sender: str = NO_SENDER) -> None:
        self._refusals.add(sender, error)
        query.refuse(encode_error(code, str(error)))

    async def _answer(self, query: Query, request: Q) -> None:
        try:
            answer = await self._handler(request)
            if not isinstance(answer, self.topic.answer):
                raise TypeError(f"handler of {self.topic.key} gave {answer!r}, not a {self.topic.answer.__name__}")
            payload = encode(answer)
        except Refused as refused:
            query.refuse(encode_error(refused.code, str(refused)))
        except RequestFailed as failed:  # a request of the handler itself
            query.refuse(encode_error("upstream", str(failed)))
        except Exception as error:
            query.refuse(encode_error("internal", f"{type(error).__name__}: {error}"))
            self._crash(error)
        else:
            self._sequence += 1
            attachment = encode_attachment(Attachment(
                self._service, self._sequence, trace=current_trace(), checksum=checksum_of(self._key, payload)))
            query.reply(self._key, payload, encoding_of(self.topic.answer), attachment)

    async def close(self) -> None:
        """Accept no more requests and cancel running ones: their clients get `RequestLost`."""
        self._closed = True
        if self._queryable is not None:
            self._queryable.undeclare()
        while self._pending:
            self._pending.pop().finish()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


class Client(Generic[Q, A]):
    """Calls a request key."""

    def __init__(
        self, session: Session, cell: str, service: str, topic: Request[Q, A], servers: TokenWatch, *,
        loop: asyncio.AbstractEventLoop, limit: int,
    ) -> None:
        self.topic = topic
        self._session = session
        self._service = service
        self._sequence = 0
        self._loop = loop
        self._limit = limit
        self._key = f"{cell}/{topic.key}"
        self._servers = servers
        self._waiting: dict[asyncio.Future[RawReply | None], None] = {}  # in order
        self._server = min(servers.names, default=topic.key)
        servers.on_change(self._on_servers)

    @property
    def available(self) -> bool:
        """Whether the router is connected and a service serves the key."""
        return self._session.connected and bool(self._servers.names)

    @property
    def server(self) -> str:
        """The service that serves the key, or served it last; the key itself if none was seen."""
        return self._server

    async def wait_available(self, timeout: float | None = None) -> None:
        """Return as soon as a service serves the key.

        Raises:
            NoResponder: none did within `timeout` seconds.
        """
        try:
            await self._servers.wait(bool, timeout)
        except TimeoutError:
            raise NoResponder(self.topic.key) from None

    def _on_servers(self, name: str, there: bool) -> None:
        self._server = name if there else self._server
        if not self._servers.names:
            for future in self._waiting:
                self._loop.call_later(_VANISH_SECONDS, _settle, future, None)

    async def call(self, request: Q, timeout: float = 5.0) -> A:
        """Send a request and return its answer.

        Args:
            request: to send.
            timeout: of the entire call [s], wall time.

        Raises:
            NoResponder: no service serves the key, or the router is not connected: nothing was sent.
            RemoteError: the responder refused, or its answer cannot be read.
            RequestLost: the responder or the router went away: the request may have been carried out.
            RequestTimeout: no answer in time: it may still be carried out.
        """
        if not isinstance(request, self.topic.message):
            raise TypeError(f"{self.topic.key} takes {self.topic.message.__name__}, not {type(request).__name__}")
        payload = encode(request)
        deadline = self._loop.time() + timeout
        if not self.available:
            if self._session.connected:  # a new client may not know its servers yet
                await self._servers.known(min(timeout, _DISCOVERY_SECONDS))
            if not self.available:
                raise NoResponder(self.topic.key)
        reply = await self._send(payload, max(0.0, deadline - self._loop.time()), timeout)
        if reply is None:
            raise RequestLost(self.topic.key)
        if reply.sample is None:
            refusal = decode_error(reply.error)
            if refusal is None:  # Zenoh's own time-out, a little later than ours
                raise RequestTimeout(self.topic.key, timeout)
            raise RemoteError(self.topic.key, *refusal)
        try:
            require_intact(decode_attachment(reply.sample.attachment), self._key, reply.sample.payload)
            return await decode_in_thread(self.topic.answer, reply.sample.payload, self._limit)
        except DecodeError as error:
            raise RemoteError(self.topic.key, "bad_answer", f"the answer cannot be read: {error}") from None

    async def _send(self, payload: bytes, seconds: float, timeout: float) -> RawReply | None:
        future: asyncio.Future[RawReply | None] = self._loop.create_future()
        self._sequence += 1
        attachment = encode_attachment(Attachment(
            self._service, self._sequence, trace=current_trace(), checksum=checksum_of(self._key, payload)))

        def settle(reply: RawReply | None) -> None:
            call_on_loop(self._loop, lambda: _settle(future, reply))

        cancel = self._session.get(
            self._key, settle, lambda: settle(None), payload=payload, encoding=encoding_of(self.topic.message),
            attachment=attachment, timeout=seconds + 1.0,
        )
        self._waiting[future] = None
        try:
            async with asyncio.timeout(seconds):  # wait_for of Python 3.11 can lose a cancellation
                return await future
        except TimeoutError:
            raise RequestTimeout(self.topic.key, timeout) from None
        finally:
            del self._waiting[future]
            cancel()


def _settle(future: asyncio.Future[T], value: T) -> None:
    if not future.done():
        future.set_result(value)
