"""Writers of a topic: checked messages, encoded."""

from __future__ import annotations

from typing import Generic, TypeVar

from common.messages import Message
from common.topics import Topic
from common.transport.codec import encode, encoding_of
from common.transport.raw_writer import RawWriter
from common.transport.session import Session
from common.transport.trace import current_trace

M = TypeVar("M", bound=Message)


class Writer(Generic[M]):
    """Puts messages of one topic; from any thread."""

    def __init__(self, session: Session, cell: str, service: str, topic: Topic[M]) -> None:
        self.topic = topic
        self._raw = RawWriter(session, f"{cell}/{topic.key}", encoding_of(topic.message), topic.kind, service)

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

    def repeat(self) -> None:
        """Put the value of a state again under the same number: readers that have it ignore it."""
        self._raw.repeat()
