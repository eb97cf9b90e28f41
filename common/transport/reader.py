"""Readers of a topic: streams and states keep the newest message, events all of them in a bounded queue."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Generic, TypeVar

from common.errors import DecodeError
from common.messages import Message
from common.topics import Topic
from common.transport.codec import (
    DEFAULT_LIMIT,
    Attachment,
    decode,
    decode_attachment,
    require_intact,
    set_trace,
)
from common.transport.session import LoopNotifier, RawSample, call_on_loop

M = TypeVar("M", bound=Message)
V = TypeVar("V")

_MAX_SENDERS = 1024  # remembered by their writer id
_MAX_UNREAD = 8  # senders whose newest unread message is queued
NO_SENDER = ""  # a sender without an attachment


class Refusals:
    """Counts refused messages and logs the first of each sender."""

    def __init__(self, key: str, loop: asyncio.AbstractEventLoop, log: logging.Logger) -> None:
        self.count = 0
        self._key = key
        self._loop = loop
        self._log = log
        self._reported: OrderedDict[str, None] = OrderedDict()

    def add(self, sender: str, error: Exception) -> None:
        """Count a refused message; log it if it is the first of that sender."""
        self.count += 1
        if sender not in self._reported:
            _remember(self._reported, sender, None)
            name = sender or "a plain client"
            # Later and on the loop: a log line is itself a message, which may arrive at this reader.
            report = partial(self._log.warning, "%s: refused a message of %s: %s", self._key, name, error)
            call_on_loop(self._loop, report)


def _remember(table: OrderedDict[str, V], key: str, value: V) -> None:
    table[key] = value
    table.move_to_end(key)
    if len(table) > _MAX_SENDERS:
        table.popitem(last=False)


class SequenceFilter:
    """Checks which messages are newer than earlier ones of the same writer."""

    def __init__(self) -> None:
        self._last: OrderedDict[str, int] = OrderedDict()

    def is_new(self, attachment: Attachment) -> bool:
        """Return whether the message is newer, and remember it then."""
        if attachment.sequence <= self._last.get(attachment.writer, -1):
            return False
        _remember(self._last, attachment.writer, attachment.sequence)
        return True

    def is_new_payload(self, attachment: bytes | None) -> bool:
        """Return the same for an encoded attachment; every message of a writer without one counts as new."""
        try:
            known = decode_attachment(attachment)
        except DecodeError:
            return True
        return known is None or self.is_new(known)


class Reader(Generic[M]):
    """Validated messages of one topic. Counters: `received`, `dropped`, `invalid`, `overflow`.

    A stream or state keeps only the newest message; one that is replaced unread counts as `dropped`. An event reader
    keeps `size` events in order; further ones replace the oldest, count as `overflow` and are logged as an error.
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
        self._sequences = SequenceFilter()
        self._lock = threading.Lock()
        self._changed = asyncio.Event()
        self._notifier = LoopNotifier(loop, self._wake)
        self._awaited = False  # whether a task waits in `next`: a reader that is only polled does not wake the loop
        if topic.kind == "event":
            self._unread = _Unread[M](size, lambda arrived: str(arrived.number))
        elif topic.signed:
            self._unread = _Unread[M](_MAX_SENDERS, lambda arrived: arrived.sample.key)
        else:
            # By sender, so that invalid messages of one cannot displace those of another.
            self._unread = _Unread[M](_MAX_UNREAD, lambda arrived: arrived.sender, newest_only=True)
        self._overflow_logged = 0
        self._behind = False  # whether an overflow was logged since the last read
        self._plain_logged = False  # whether a message under the plain key of a signed topic was logged

    @property
    def invalid(self) -> int:
        """Messages that did not parse or validate."""
        return self._refusals.count

    def arrive(self, sample: RawSample) -> None:
        """Take a message from the network; on any thread."""
        attachment = None
        try:
            attachment = decode_attachment(sample.attachment)
            if attachment is not None and self.topic.signed:  # no service affects the sequence of another
                attachment = attachment._replace(writer=f"{attachment.writer} under {sample.key}")
            require_intact(attachment, sample.key, sample.payload)
        except DecodeError as error:
            with self._lock:
                self._refusals.add(attachment.writer if attachment else NO_SENDER, error)
            return
        with self._lock:
            if attachment is not None and not self._sequences.is_new(attachment):
                return  # a repeated state, or one that came by `get` and by subscription
            self.received += 1
            lost = self._unread.add(_Arrived(sample, attachment, self.received))
            if self.topic.kind == "event":
                self.overflow += lost
            else:
                self.dropped += lost
            wakes = self._awaited or (lost and self.topic.kind == "event")
        if wakes:
            self._notifier.notify()

    def _wake(self) -> None:
        with self._lock:
            self._awaited = False
        self._changed.set()
        if self.overflow > self._overflow_logged and not self._behind:
            self._behind = True
            self._overflow_logged = self.overflow
            self._log.error("%s: reader fell behind, %d events lost so far", self.topic.key, self.overflow)

    def _decode(self, arrived: _Arrived[M]) -> bool:
        """Return whether the message is valid; it is decoded then."""
        if arrived.message is None:
            try:
                message = decode(self.topic.message, arrived.sample.payload, self._limit)
                if self.topic.signed:
                    self._require_own(arrived.sample.key, message)
                arrived.message = message
            except DecodeError as error:
                self._refusals.add(arrived.sender, error)
                return False
        return True

    def _require_own(self, key: str, message: M) -> None:
        """Return if a message names the service of its key, or came under the former plain key.

        Raises:
            DecodeError: it came under another service's key.
        """
        service, (_, plain, *under) = getattr(message, "service", ""), key.split("/")
        if not under:
            if not self._plain_logged:
                self._plain_logged = True
                self._log.warning("%s: a client publishes under %s; the next version no longer reads that key",
                                  self.topic.key, plain)
        elif "/".join(under) != service:
            raise DecodeError(f"{type(message).__name__}.service: must be {under[-1]!r} under {key}, not {service!r}")

    @property
    def latest(self) -> M | None:
        """The newest valid message so far, or None; does not change what `next` returns."""
        with self._lock:
            lost, message = self._unread.peek(self._decode)
            self.dropped += lost
        return message

    async def next(self) -> M:
        """Return the newest message of a stream or state that was not returned yet, or the next event; waits for it."""
        while True:
            with self._lock:
                self._behind = False  # read again: log the next overflow
                lost, arrived = self._unread.take(self._decode)
                self.dropped += lost
                if arrived is None:
                    self._changed.clear()
                    self._awaited = True
            if arrived is not None and arrived.message is not None:
                if arrived.attachment is not None:
                    set_trace(arrived.attachment.trace)
                return arrived.message
            await self._changed.wait()

    def __aiter__(self) -> AsyncIterator[M]:
        return self

    async def __anext__(self) -> M:
        return await self.next()


class _Arrived(Generic[M]):
    __slots__ = ("attachment", "message", "number", "sample", "sender")

    def __init__(self, sample: RawSample, attachment: Attachment | None, number: int) -> None:
        self.sample = sample
        self.attachment = attachment
        self.sender = attachment.writer if attachment else NO_SENDER
        self.number = number
        self.message: M | None = None


class _Unread(Generic[M]):
    """Unread messages in order of arrival, one for each slot, up to a limit; the oldest give way."""

    def __init__(self, limit: int, slot: Callable[[_Arrived[M]], str], *, newest_only: bool = False) -> None:
        """Keep at most `limit` messages; a newer one of the same slot replaces an unread one.

        Args:
            limit: number of messages.
            slot: of a message.
            newest_only: whether reading the newest valid message drops the older ones.
        """
        self._limit, self._slot, self._newest_only = limit, slot, newest_only
        self._unread: OrderedDict[str, _Arrived[M]] = OrderedDict()
        self._last: _Arrived[M] | None = None  # newest that was read
        self._taken = True  # whether `take` returned it

    def add(self, arrived: _Arrived[M]) -> int:
        """Add a message; return how many unread ones are lost by it."""
        slot = self._slot(arrived)
        lost = int(self._unread.pop(slot, None) is not None)
        self._unread[slot] = arrived
        if len(self._unread) > self._limit:
            self._unread.popitem(last=False)
            lost += 1
        return lost

    def _settle(self, is_valid: Callable[[_Arrived[M]], bool]) -> int:
        """Make the newest valid message the last one, and drop all older ones; return their number."""
        while self._unread:
            _, arrived = self._unread.popitem()
            if is_valid(arrived):
                lost = len(self._unread)
                self._unread.clear()
                self._last, self._taken = arrived, False
                return lost
        return 0

    def peek(self, is_valid: Callable[[_Arrived[M]], bool]) -> tuple[int, M | None]:
        """Return how many were dropped, and the newest valid message, taken or not."""
        lost = self._settle(is_valid) if self._newest_only else 0
        while self._unread and not is_valid(self._unread[slot := next(reversed(self._unread))]):
            del self._unread[slot]
        newest = self._unread[next(reversed(self._unread))] if self._unread else self._last
        return lost, newest.message if newest is not None else None

    def take(self, is_valid: Callable[[_Arrived[M]], bool]) -> tuple[int, _Arrived[M] | None]:
        """Return how many were dropped, and the oldest valid message that is left and was not taken yet."""
        if self._newest_only:
            lost = self._settle(is_valid)
            taken, self._taken = self._taken, True
            return lost, None if taken else self._last
        while self._unread:
            _, arrived = self._unread.popitem(last=False)
            if is_valid(arrived):
                self._last = arrived
                return 0, arrived
        return 0, None
