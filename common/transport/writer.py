"""Writers of a topic, and of bytes under one key: each payload gets a sequence number, a state is repeated."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

from common.messages import Message
from common.sources import new_id
from common.topics import PublishedKind, Topic
from common.transport.codec import Attachment, checksum_of, encode, encode_attachment, encoding_of
from common.transport.session import Query, Session
from common.transport.trace import current_trace

M = TypeVar("M", bound=Message)

MOST_HELD = 1000  # events that wait until they may be sent


class Writer(Generic[M]):
    """Puts messages of one topic; from any thread."""

    def __init__(self, session: Session, cell: str, service: str, topic: Topic[M], *, held: bool = False) -> None:
        self.topic = topic
        key = f"{cell}/{topic.key}"
        self._raw = RawWriter(session, key, encoding_of(topic.message), topic.kind, service, held=held)

    @property
    def matched(self) -> bool:
        """Whether somebody listens."""
        return self._raw.matched

    def put(self, message: M) -> None:
        """Send a message; never blocks.

        Raises:
            TypeError: it is not the topic's message.
        """
        if not isinstance(message, self.topic.message):
            raise TypeError(f"{self.topic.key} carries {self.topic.message.__name__}, not {type(message).__name__}")
        self._raw.put(encode(message), current_trace())

    def release(self) -> None:
        """Send what was put so far, and from now on at once."""
        self._raw.release()

    def repeat(self) -> None:
        """Put the value of a state again under the same number: readers that have it ignore it."""
        self._raw.repeat()

    def close(self) -> None:
        """Send nothing any more, whatever is put."""
        self._raw.close()


class RawWriter:
    """Puts payloads under a full key; from any thread."""

    def __init__(
        self, session: Session, key: str, encoding: str, kind: PublishedKind, service: str, *, held: bool = False
    ) -> None:
        """Declare the key.

        Args:
            session: connection to the network.
            key: full key, such as `cell/camera/image_raw`.
            encoding: what the payloads are, as `encoding_of` says it.
            kind: stream, event or state.
            service: who writes, the first part of the writer id.
            held: whether nothing is sent, not even to who asks, before `release`: then the newest payload, or events.
        """
        self.kind = kind
        self._held: deque[tuple[bytes, str]] | None = None
        if held:
            self._held = deque(maxlen=MOST_HELD if kind == "event" else 1)
        self._key = key
        self._encoding = encoding
        # Of this writer alone: a service that was restarted counts from the start again.
        self._id = f"{service}.{new_id()}"
        self._sequence = 0
        self._lock = threading.Lock()
        self._last: tuple[bytes, bytes] | None = None
        self._publisher = session.publisher(key, encoding, reliable=kind != "stream")
        self._queryable = session.queryable(key, self._answer, complete=False) if kind == "state" else None

    @property
    def matched(self) -> bool:
        """Whether somebody listens."""
        return self._publisher.matched

    def put(self, payload: bytes, trace: str = "") -> None:
        """Send a payload, caused by what has the trace id; never blocks."""
        with self._lock:
            if self._held is not None:
                self._held.append((payload, trace))
                return
            self._sequence += 1
            attachment = encode_attachment(
                Attachment(self._id, self._sequence, trace=trace, checksum=checksum_of(self._key, payload))
            )
            if self.kind == "state":
                self._last = (payload, attachment)
            self._publisher.put(payload, attachment)

    def release(self) -> None:
        """Send what was put so far, and from now on at once."""
        with self._lock:
            held, self._held = self._held or (), None
        for payload, trace in held:
            self.put(payload, trace)

    def repeat(self) -> None:
        """Put the value of a state again under the same number: readers that have it ignore it."""
        with self._lock:
            if self._last is not None:
                self._publisher.put(*self._last)

    def close(self) -> None:
        """Send nothing any more, whatever is put, and answer nobody."""
        with self._lock:
            self._publisher.undeclare()
        if self._queryable is not None:
            self._queryable.undeclare()

    def _answer(self, query: Query) -> None:
        last = self._last
        if last is not None:
            query.reply(self._key, last[0], self._encoding, last[1])
        query.finish()
