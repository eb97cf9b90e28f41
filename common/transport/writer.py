"""Writers of topics, and raw access to any key: each payload has a sequence number, states are repeated."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any, Generic, TypeVar

from common.messages import Message
from common.time_source import new_id
from common.topics import COUNTERS, LOG, PublishedKind, Topic
from common.transport.codec import Attachment, checksum_of, current_trace, encode, encode_attachment, encoding_of
from common.transport.session import (
    Declaration,
    LoopNotifier,
    OnSample,
    Publisher,
    Query,
    RawReply,
    RawSample,
    Session,
    call_on_loop,
)
from common.transport.tokens import tokens_now

M = TypeVar("M", bound=Message)

MAX_DEFERRED = 1000  # events that wait for `release`
MAX_RAW = 1000  # samples that wait in a `raw_reader`
COPY = encode_attachment(Attachment("copy", 0))  # of a message repeated under a plain key for plain Zenoh clients


class Writer(Generic[M]):
    """Publishes messages of one topic; from any thread."""

    def __init__(self, session: Session, cell: str, service: str, topic: Topic[M], *, deferred: bool = False) -> None:
        self.topic = topic
        key = f"{cell}/{topic.key}"
        self.raw = RawWriter(session, key, encoding_of(topic.message), topic.kind, service, deferred=deferred)

    @property
    def matched(self) -> bool:
        """Whether there is a subscriber."""
        return self.raw.matched

    def put(self, message: M) -> None:
        """Publish a message; never blocks.

        Raises:
            TypeError: it is not of the topic's message class.
        """
        if not isinstance(message, self.topic.message):
            raise TypeError(f"{self.topic.key} carries {self.topic.message.__name__}, not {type(message).__name__}")
        self.raw.put(encode(message), current_trace())


class RawWriter:
    """Publishes payloads under a full key; from any thread."""

    def __init__(
        self, session: Session, key: str, encoding: str, kind: PublishedKind, service: str, *, deferred: bool = False
    ) -> None:
        """Declare the key.

        Args:
            session: connection to the network.
            key: full key, such as `cell/camera/image_raw`.
            encoding: of the payloads, from `encoding_of`.
            kind: stream, event or state.
            service: name of the writing service, first part of the writer id.
            deferred: keep the newest payload (or all events) until `release`; a `get` gets no reply before.
        """
        self.kind = kind
        self._deferred: deque[tuple[bytes, str]] | None = None
        if deferred:
            self._deferred = deque(maxlen=MAX_DEFERRED if kind == "event" else 1)
        self._key = key
        self._encoding = encoding
        # Unique to this writer: the sequence of a restarted service starts at 1 again.
        self._id = f"{service}.{new_id()}"
        self._sequence = 0
        self._lock = threading.Lock()
        self._last: tuple[bytes, bytes] | None = None
        self._publisher = session.publisher(key, encoding, reliable=kind != "stream")
        self._queryable = session.queryable(key, self._answer, complete=False) if kind == "state" else None

    @property
    def matched(self) -> bool:
        """Whether there is a subscriber."""
        return self._publisher.matched

    def put(self, payload: bytes, trace: str = "") -> None:
        """Publish a payload with the trace id of its cause; never blocks."""
        with self._lock:
            if self._deferred is not None:
                self._deferred.append((payload, trace))
                return
            self._sequence += 1
            attachment = encode_attachment(
                Attachment(self._id, self._sequence, trace=trace, checksum=checksum_of(self._key, payload))
            )
            if self.kind == "state":
                self._last = (payload, attachment)
            self._publisher.put(payload, attachment)

    def release(self) -> None:
        """Publish what was deferred, and later payloads at once."""
        with self._lock:
            deferred, self._deferred = self._deferred or (), None
        for payload, trace in deferred:
            self.put(payload, trace)

    def repeat(self) -> None:
        """Publish the value of a state again under the same number: readers that have it ignore it."""
        with self._lock:
            if self._last is not None:
                self._publisher.put(*self._last)

    def close(self) -> None:
        """Publish and reply nothing more; later puts have no effect."""
        with self._lock:
            self._publisher.undeclare()
        if self._queryable is not None:
            self._queryable.undeclare()

    def _answer(self, query: Query) -> None:
        last = self._last
        if last is not None:
            query.reply(self._key, last[0], self._encoding, last[1])
        query.finish()


class RawAccess:
    """Bytes under any full key expression, for tools; on the event loop."""

    def __init__(self, session: Session, service: str) -> None:
        self._session, self.service = session, service
        self._loop = asyncio.get_running_loop()
        self._raw_states: list[RawWriter] = []

    async def raw_reader(self, key: str) -> AsyncIterator[RawSample]:
        """Yield what is published under a full key expression, such as `cell/**`, from now on; drops the oldest."""
        waiting: deque[RawSample] = deque(maxlen=MAX_RAW)
        received = asyncio.Event()
        notifier = LoopNotifier(self._loop, received.set)

        def on_sample(sample: RawSample) -> None:
            waiting.append(sample)
            notifier.notify()

        declared = self.raw_subscriber(key, on_sample)
        try:
            while True:
                while waiting:
                    yield waiting.popleft()
                received.clear()
                await received.wait()
        finally:
            declared.undeclare()

    def raw_subscriber(self, key: str, on_sample: OnSample) -> Declaration:
        """Call back, on a network thread, for each value under a full key expression; it must return at once."""
        return self._session.subscriber(key, lambda sample: None if is_copy(sample) else on_sample(sample))

    def raw_watch_tokens(self, key: str, on_token: Callable[[str], None]) -> Declaration:
        """Call back, on any thread, for each liveliness token under a full key expression that exists or appears."""
        return self._session.watch_tokens(
            key, lambda token, there: on_token(token) if there else None, on_token, lambda: None
        )

    def raw_writer(self, key: str, encoding: str, kind: PublishedKind) -> RawWriter:
        """Return a writer of bytes under a full key, such as a recorded one."""
        writer = RawWriter(self._session, key, encoding, kind, self.service)
        if kind == "state":
            self._raw_states.append(writer)
        return writer

    def raw_publisher(self, key: str, encoding: str, *, reliable: bool) -> Publisher:
        """Return a publisher of bytes with any attachment under a full key."""
        return self._session.publisher(key, encoding, reliable=reliable)

    async def raw_get(
        self, key: str, timeout: float = 1.0, *, payload: bytes | None = None, encoding: str = ""
    ) -> list[RawSample]:
        """Return the replies to a `get` of a full key expression; request keys refuse one without a payload."""
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
        """Return the existing liveliness tokens that match a full key expression, such as `*/alive/*`."""
        return await tokens_now(self._session, key, self._loop, timeout)


def plain_key(topic: Topic[Any]) -> str:
    """Return the key, without the cell, that a signed topic had before it got one for each service."""
    return topic.key.partition("/")[0]


_PLAIN_KEYS = (plain_key(LOG), plain_key(COUNTERS))


def is_copy(sample: RawSample) -> bool:
    """Return whether a message is a copy under a plain key: our readers skip it, plain Zenoh clients read it."""
    return sample.attachment == COPY and sample.key.partition("/")[2] in _PLAIN_KEYS
