"""Writers of a topic: each message gets a sequence number; the value of a state can be asked for and is repeated."""

from __future__ import annotations

import secrets
import threading
from typing import Generic, TypeVar

from common.messages import Message
from common.topics import Topic
from common.transport.codec import Attachment, encode, encode_attachment, encoding_of
from common.transport.session import Query, Session
from common.transport.trace import current_trace

M = TypeVar("M", bound=Message)


class Writer(Generic[M]):
    """Puts messages of one topic; from any thread."""

    def __init__(self, session: Session, cell: str, service: str, topic: Topic[M]) -> None:
        self.topic = topic
        self._key = f"{cell}/{topic.key}"
        self._encoding = encoding_of(topic.message)
        # Of this writer alone: a service that was restarted counts from the start again.
        self._id = f"{service}.{secrets.token_hex(4)}"
        self._sequence = 0
        self._lock = threading.Lock()
        self._last: tuple[bytes, bytes] | None = None
        self._publisher = session.publisher(self._key, self._encoding, reliable=topic.kind != "stream")
        if topic.kind == "state":
            session.queryable(self._key, self._answer, complete=False)

    @property
    def matched(self) -> bool:
        """Whether somebody listens."""
        return self._publisher.matched

    def put(self, message: M) -> None:
        """Send a message; never blocks.

        Raises:
            TypeError: it is not the topic's message.
        """
        if not isinstance(message, self.topic.message):
            raise TypeError(f"{self.topic.key} carries {self.topic.message.__name__}, not {type(message).__name__}")
        payload = encode(message)
        with self._lock:
            self._sequence += 1
            attachment = encode_attachment(Attachment(self._id, self._sequence, trace=current_trace()))
            if self.topic.kind == "state":
                self._last = (payload, attachment)
            self._publisher.put(payload, attachment)

    def repeat(self) -> None:
        """Put the value of a state again under the same number: readers that have it ignore it."""
        with self._lock:
            if self._last is not None:
                self._publisher.put(*self._last)

    def _answer(self, query: Query) -> None:
        last = self._last
        if last is not None:
            query.reply(self._key, last[0], self._encoding, last[1])
        query.finish()
