"""Readers of a topic: streams and states keep the newest message, events keep them all in a bounded queue."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import OrderedDict, deque
from collections.abc import AsyncIterator
from functools import partial
from typing import Generic, Protocol, TypeVar

from common.errors import DecodeError
from common.messages import Message
from common.topics import Topic
from common.transport.codec import DEFAULT_LIMIT, Attachment, decode, decode_attachment, require_whole
from common.transport.handoff import Doorbell, call_on_loop
from common.transport.session import RawSample
from common.transport.trace import follow

M = TypeVar("M", bound=Message)

_MOST_SENDERS = 1024  # remembered by their writer id
_MOST_UNREAD = 8  # senders whose newest unread message is kept
NO_SENDER = ""  # a sender without an attachment


class Refusals:
    """Counts messages that were refused and reports the first of each sender."""

    def __init__(self, key: str, loop: asyncio.AbstractEventLoop, log: logging.Logger) -> None:
        self.count = 0
        self._key = key
        self._loop = loop
        self._log = log
        self._reported: OrderedDict[str, None] = OrderedDict()

    def add(self, sender: str, error: Exception) -> None:
        """Count one; log it if it is the first of that sender."""
        self.count += 1
        if sender not in self._reported:
            _remember(self._reported, sender, None)
            who = sender or "a plain client"
            # Later and on the loop: a log line is itself a message, which may come back to the reader that says it.
            report = partial(self._log.warning, "%s: refused a message of %s: %s", self._key, who, error)
            call_on_loop(self._loop, report)


V = TypeVar("V")


def _remember(table: OrderedDict[str, V], key: str, value: V) -> None:
    table[key] = value
    table.move_to_end(key)
    if len(table) > _MOST_SENDERS:
        table.popitem(last=False)


class Newness:
    """Tells which messages are newer than what the same writer sent before."""

    def __init__(self) -> None:
        self._last: OrderedDict[str, int] = OrderedDict()

    def is_new(self, attachment: Attachment) -> bool:
        """Whether the message is newer; it is remembered then."""
        if attachment.sequence <= self._last.get(attachment.writer, -1):
            return False
        _remember(self._last, attachment.writer, attachment.sequence)
        return True

    def is_news(self, attachment: bytes | None) -> bool:
        """The same of an attachment as it came; a writer that says nothing about itself only has news."""
        try:
            known = decode_attachment(attachment)
        except DecodeError:
            return True
        return known is None or self.is_new(known)


class Reader(Generic[M]):
    """Messages of one topic, checked. Counters: `received`, `dropped`, `invalid`, `overflow`.

    Of a stream or state only the newest is kept; what it replaced unread is counted as `dropped`. An event reader
    keeps `size` events in order; what does not fit is counted as `overflow` and logged as an error.
    """

    def __init__(
        self, topic: Topic[M], loop: asyncio.AbstractEventLoop, log: logging.Logger, *, size: int = 1000,
        limit: int = DEFAULT_LIMIT,
    ) -> None:
        self.topic = topic
        self.received = 0
        self.dropped = 0
        self.overflow = 0
        self._log = log
        self._limit = limit
        self._refusals = Refusals(topic.key, loop, log)
        self._newness = Newness()
        self._lock = threading.Lock()
        self._changed = asyncio.Event()
        self._doorbell = Doorbell(loop, self._wake)
        self._awaited = False  # whether somebody waits for the next: the loop is not woken for who only looks at times
        self._queue: _Newest[M] | _NewestOfEach[M] | _InOrder[M] = (
            _InOrder(size) if topic.kind == "event" else _NewestOfEach() if topic.signed else _Newest())
        self._overflow_logged = 0
        self._plain = False  # whether something came under the plain key of a signed topic

    @property
    def invalid(self) -> int:
        """Messages that did not parse or validate."""
        return self._refusals.count

    def arrive(self, sample: RawSample) -> None:
        """Take a message as it came from the network; on any thread."""
        attachment = None
        try:
            attachment = decode_attachment(sample.attachment)
            if attachment is not None and self.topic.signed:  # numbered apart: nobody counts for another
                attachment = attachment._replace(writer=f"{attachment.writer} under {sample.key}")
            require_whole(attachment, sample.key, sample.payload)
        except DecodeError as error:
            with self._lock:
                self._refusals.add(attachment.writer if attachment else NO_SENDER, error)
            return
        with self._lock:
            if attachment is not None and not self._newness.is_new(attachment):
                return  # a state that is put again each second, or came by `get` and by subscription
            self.received += 1
            lost = self._queue.add(_Arrived(sample, attachment))
            if self.topic.kind == "event":
                self.overflow += lost
            else:
                self.dropped += lost
            woken = self._awaited or (lost and self.topic.kind == "event")
        if woken:
            self._doorbell.ring()

    def _wake(self) -> None:
        with self._lock:
            self._awaited = False
        self._changed.set()
        if self.overflow > self._overflow_logged and not self._queue.reported:
            self._queue.reported = True
            self._overflow_logged = self.overflow
            self._log.error("%s: reader fell behind, %d events lost so far", self.topic.key, self.overflow)

    def _decode(self, arrived: _Arrived[M]) -> bool:
        """Whether the message is one; it is decoded then."""
        if arrived.message is None:
            try:
                message = decode(self.topic.message, arrived.sample.payload, self._limit)
                if self.topic.signed:
                    self._require_own(arrived.sample.key, message)
                arrived.message = message
            except DecodeError as error:
                sender = arrived.attachment.writer if arrived.attachment else NO_SENDER
                self._refusals.add(sender, error)
                return False
        return True

    def _require_own(self, key: str, message: M) -> None:
        """Return when a message came under the key of the service that it says, or under the plain one of before.

        Raises:
            DecodeError: it came under another service's.
        """
        said, (_, plain, *under) = getattr(message, "service", ""), key.split("/")
        if not under:
            if not self._plain:
                self._plain = True
                self._log.warning("%s: somebody writes %s, which nobody reads any more from the next version on",
                                  self.topic.key, plain)
        elif "/".join(under) != said:
            raise DecodeError(f"{type(message).__name__}.service: must be {under[-1]!r} under {key}, not {said!r}")

    @property
    def latest(self) -> M | None:
        """The newest valid message so far, or None; what `next` returns does not change by it."""
        with self._lock:
            lost, message = self._queue.peek(self._decode)
            self.dropped += lost
        return message

    async def next(self) -> M:
        """The newest message of a stream or state that was not returned yet, the next event in order; waits for one."""
        while True:
            with self._lock:
                lost, arrived = self._queue.take(self._decode)
                self.dropped += lost
                if arrived is None:
                    self._changed.clear()
                    self._awaited = True
            if arrived is not None and arrived.message is not None:
                if arrived.attachment is not None:
                    follow(arrived.attachment.trace)
                return arrived.message
            await self._changed.wait()

    def __aiter__(self) -> AsyncIterator[M]:
        return self

    async def __anext__(self) -> M:
        return await self.next()


class _Arrived(Generic[M]):
    __slots__ = ("attachment", "message", "sample")

    def __init__(self, sample: RawSample, attachment: Attachment | None) -> None:
        self.sample = sample
        self.attachment = attachment
        self.message: M | None = None


class _Decode(Protocol[M]):
    def __call__(self, arrived: _Arrived[M], /) -> bool: ...


class _Newest(Generic[M]):
    """The newest message of each sender, so that rubbish from one cannot displace what another said."""

    def __init__(self) -> None:
        self.reported = False
        self._unread: OrderedDict[str, _Arrived[M]] = OrderedDict()
        self._read: _Arrived[M] | None = None  # decoded; the newest
        self._returned = True

    def add(self, arrived: _Arrived[M]) -> int:
        sender = arrived.attachment.writer if arrived.attachment else NO_SENDER
        lost = 1 if self._unread.pop(sender, None) is not None else 0
        self._unread[sender] = arrived
        if len(self._unread) > _MOST_UNREAD:
            self._unread.popitem(last=False)
            lost += 1
        return lost

    def _read_newest(self, decode_one: _Decode[M]) -> int:
        """Decode the newest valid message; the number of older ones that it replaces."""
        while self._unread:
            _, arrived = self._unread.popitem()
            if decode_one(arrived):
                lost = len(self._unread)
                self._unread.clear()
                self._read, self._returned = arrived, False
                return lost
        return 0

    def peek(self, decode_one: _Decode[M]) -> tuple[int, M | None]:
        lost = self._read_newest(decode_one)
        return lost, self._read.message if self._read is not None else None

    def take(self, decode_one: _Decode[M]) -> tuple[int, _Arrived[M] | None]:
        lost = self._read_newest(decode_one)
        if self._returned:
            return lost, None
        self._returned = True
        return lost, self._read


class _NewestOfEach(Generic[M]):
    """The newest message of each key that is not read yet, so that nobody displaces what another said."""

    def __init__(self) -> None:
        self.reported = False
        self._unread: OrderedDict[str, _Arrived[M]] = OrderedDict()
        self._last: _Arrived[M] | None = None

    def add(self, arrived: _Arrived[M]) -> int:
        lost = self._unread.pop(arrived.sample.key, None) is not None
        self._unread[arrived.sample.key] = arrived
        if len(self._unread) > _MOST_SENDERS:
            self._unread.popitem(last=False)
            lost = True
        return int(lost)

    def peek(self, decode_one: _Decode[M]) -> tuple[int, M | None]:
        for key in reversed(self._unread):
            if decode_one(self._unread[key]):
                return 0, self._unread[key].message
        return 0, self._last.message if self._last is not None else None

    def take(self, decode_one: _Decode[M]) -> tuple[int, _Arrived[M] | None]:
        while self._unread:
            _, arrived = self._unread.popitem(last=False)
            if decode_one(arrived):
                self._last = arrived
                return 0, arrived
        return 0, None


class _InOrder(Generic[M]):
    """All messages in order, up to a number; the oldest give way."""

    def __init__(self, size: int) -> None:
        self.reported = False
        self._size = size
        self._waiting: deque[_Arrived[M]] = deque()
        self._last: _Arrived[M] | None = None

    def add(self, arrived: _Arrived[M]) -> int:
        self._waiting.append(arrived)
        if len(self._waiting) <= self._size:
            return 0
        self._waiting.popleft()
        return 1

    def peek(self, decode_one: _Decode[M]) -> tuple[int, M | None]:
        while self._waiting and not decode_one(self._waiting[-1]):
            self._waiting.pop()
        newest = self._waiting[-1] if self._waiting else self._last
        return 0, newest.message if newest is not None else None

    def take(self, decode_one: _Decode[M]) -> tuple[int, _Arrived[M] | None]:
        self.reported = False  # it is being read again: the next overflow is news
        while self._waiting:
            arrived = self._waiting.popleft()
            if decode_one(arrived):
                self._last = arrived
                return 0, arrived
        return 0, None
