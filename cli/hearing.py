"""What comes on one key: how often, how large and how old, without decoding it."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

from cli.measuring import Arrivals, Figures
from cli.stamps import DelayFigures, Delays, stamp_of

if TYPE_CHECKING:
    from common.clock import Clock
    from common.transport.session import RawSample


class Hearing:
    """Takes the messages of one key as the network hands them over, on any thread."""

    def __init__(self, clock: Clock) -> None:
        """Begin with nothing.

        Args:
            clock: the cell's: stamps are its times.
        """
        self.unstamped = 0
        self._clock = clock
        self._arrivals = Arrivals()
        self._delays = Delays()
        from common.transport.reader import Newness

        self._newness = Newness()
        self._lock = threading.Lock()

    def know(self, sample: RawSample) -> None:
        """Take note of the value of a state that was said before: its repetitions are no news."""
        with self._lock:
            self._newness.is_news(sample.attachment)

    def arrive(self, sample: RawSample) -> None:
        """Take a message."""
        now, stamp = time.monotonic(), stamp_of(sample.payload)
        with self._lock:
            self._arrivals.add(now, len(sample.payload))
            if stamp is None:
                self.unstamped += 1
            elif self._newness.is_news(sample.attachment):  # a state that is put again was made long ago
                self._delays.add(now, self._clock.age_ms(stamp))

    def arrivals(self) -> Figures:
        """Rate and size of what came lately."""
        with self._lock:
            return self._arrivals.figures(time.monotonic())

    def delays(self) -> DelayFigures:
        """Wall time [ms] from stamp to arrival of what came lately."""
        with self._lock:
            return self._delays.figures(time.monotonic())
