"""Sends what must arrive without ever holding the loop."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

import zenoh

log = logging.getLogger(__name__)

_OUTBOX_SIZE = 10_000


class Outbox:
    """A thread that sends what must arrive: such a put blocks while the network is congested, the loop never does."""

    def __init__(self) -> None:
        self.lost = 0
        self._calls: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._busy = False
        self._closed = False
        threading.Thread(target=self._work, name="outbox", daemon=True).start()

    def post(self, call: Callable[[], None]) -> None:
        """Have the call made in order; what does not fit is counted and reported."""
        with self._changed:
            if self._closed:
                return
            if len(self._calls) >= _OUTBOX_SIZE:
                self.lost += 1
                first = self.lost == 1
            else:
                self._calls.append(call)
                self._changed.notify_all()
                return
        if first:
            log.error("the network takes nothing: %d messages wait, further ones are lost", _OUTBOX_SIZE)

    def close(self, timeout: float) -> None:
        """Wait until all was sent, at most `timeout` seconds, and stop."""
        with self._changed:
            self._changed.wait_for(lambda: not self._calls and not self._busy, timeout)
            self._closed = True
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._calls or self._closed)
                if self._closed:
                    return
                call = self._calls.popleft()
                self._busy = True
            try:
                call()
            except zenoh.ZError as error:  # the session closed, or the other side is gone: as a message lost on the way
                log.debug("not sent: %s", error)
            except Exception:  # a bug; without this thread the service would be mute
                log.exception("sending failed")
