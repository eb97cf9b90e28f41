"""Writers of bytes under one key: each payload gets a sequence number; a state can be asked for and is repeated."""

from __future__ import annotations

import threading

from common.sources import new_id
from common.topics import PublishedKind
from common.transport.codec import Attachment, checksum_of, encode_attachment
from common.transport.session import Query, Session


class RawWriter:
    """Puts payloads under a full key; from any thread."""

    def __init__(self, session: Session, key: str, encoding: str, kind: PublishedKind, service: str) -> None:
        """Declare the key.

        Args:
            session: connection to the network.
            key: full key, such as `panda/camera/image_raw`.
            encoding: what the payloads are, as `encoding_of` says it.
            kind: stream, event or state.
            service: who writes, the first part of the writer id.
        """
        self.kind = kind
        self._key = key
        self._encoding = encoding
        # Of this writer alone: a service that was restarted counts from the start again.
        self._id = f"{service}.{new_id()}"
        self._sequence = 0
        self._lock = threading.Lock()
        self._last: tuple[bytes, bytes] | None = None
        self._publisher = session.publisher(key, encoding, reliable=kind != "stream")
        if kind == "state":
            session.queryable(key, self._answer, complete=False)

    @property
    def matched(self) -> bool:
        """Whether somebody listens."""
        return self._publisher.matched

    def put(self, payload: bytes, trace: str = "") -> None:
        """Send a payload, caused by what has the trace id; never blocks."""
        with self._lock:
            self._sequence += 1
            attachment = encode_attachment(
                Attachment(self._id, self._sequence, trace=trace, checksum=checksum_of(self._key, payload))
            )
            if self.kind == "state":
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
