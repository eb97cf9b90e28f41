"""What a Zenoh session declares and receives, as the parts of a `Session`: publishers, queries, undeclarations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import zenoh

from common.transport.endpoint import LARGE_BYTES
from common.transport.session import OnToken, RawSample, SendQueue


def direct(on_item: Callable[[Any], None], on_drop: Callable[[], None] | None = None) -> Any:
    """Return a handler that calls back on Zenoh's thread."""
    # The default, an indirect callback, starts a thread that keeps the interpreter from exiting.
    return zenoh.handlers.Callback(on_item, on_drop, indirect=False)


def raw_sample(sample: zenoh.Sample) -> RawSample:
    """Return a sample with its bytes."""
    attachment = sample.attachment
    return RawSample(
        str(sample.key_expr),
        sample.payload.to_bytes(),
        str(sample.encoding),
        attachment.to_bytes() if attachment is not None else None,
    )


class ZenohPublisher:
    """A stream, or a reliable publisher whose values wait in the send queue."""

    def __init__(self, declare: Callable[[zenoh.Priority], zenoh.Publisher], queue: SendQueue | None) -> None:
        """Declare a reliable publisher with a send queue, or a stream without one."""
        # Each on its own priority: small messages do not queue behind images, reliable ones not behind a stream.
        self._publisher = declare(zenoh.Priority.DATA if queue is None else zenoh.Priority.DATA_HIGH)
        self._declare = declare
        self._large: zenoh.Publisher | None = None  # of a stream, from its first large message on
        self._queue = queue
        self._undeclared = False

    @property
    def matched(self) -> bool:
        """Whether there is a subscriber."""
        return not self._undeclared and self._publisher.matching_status.matching  # type: ignore[attr-defined]

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Publish, or do nothing once undeclared."""
        if self._undeclared:
            return
        if self._queue is None:
            if self._large is None and len(payload) > LARGE_BYTES:
                self._large = self._declare(zenoh.Priority.DATA_LOW)
            (self._large or self._publisher).put(payload, attachment=attachment or None)
        else:
            self._queue.post(lambda: self._publisher.put(payload, attachment=attachment or None))

    def undeclare(self) -> None:
        """Undeclare it, after what is in the send queue."""
        if self._undeclared:
            return
        self._undeclared = True
        if self._queue is None:
            for publisher in filter(None, (self._large, self._publisher)):
                publisher.undeclare()  # type: ignore[no-untyped-call]
        else:  # a put may be running in the queue's thread; Zenoh refuses both at once
            self._queue.post(self._publisher.undeclare)


class ZenohQuery:
    """A received query, whose replies wait in the send queue."""

    def __init__(self, query: zenoh.Query, queue: SendQueue) -> None:
        self._query = query
        self._queue = queue
        self.key = str(query.key_expr)
        self.payload = query.payload.to_bytes() if query.payload is not None else None
        self.attachment = query.attachment.to_bytes() if query.attachment is not None else None

    def reply(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        """Send a reply."""
        self._queue.post(lambda: self._query.reply(key, payload, encoding=encoding, attachment=attachment))

    def refuse(self, payload: bytes) -> None:
        """Send an error."""
        self._queue.post(lambda: self._query.reply_err(payload, encoding="application/msgpack"))

    def finish(self) -> None:
        """End the query: there are no more replies."""
        self._queue.post(self._query.drop)


class Undeclare:
    """Runs a Zenoh undeclaration once."""

    def __init__(self, undeclare: Callable[[], Any]) -> None:
        self._undeclare: Callable[[], Any] | None = undeclare

    def undeclare(self) -> None:
        """Undeclare it, unless that was done."""
        undeclare, self._undeclare = self._undeclare, None
        if undeclare is not None:
            undeclare()


@dataclass(eq=False)
class TokenWatcher:
    """Calls back for tokens that match a pattern."""

    pattern: zenoh.KeyExpr
    on_token: OnToken
    reported: set[str] = field(default_factory=set)  # existing tokens, as Zenoh reported them
