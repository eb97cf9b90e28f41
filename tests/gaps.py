"""Gaps in the joint states of a cell of real processes, and whether the load of the machine caused them."""

import os
import threading
import time
from bisect import bisect_left, bisect_right
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from common import topics
from common.transport.bus import Bus
from common.transport.codec import decode_attachment
from common.transport.session import RawSample
from recording.sample import stamp_of

GAP = 0.05  # [s] between two joint states
SAMPLE_PERIOD = 0.01  # [s] of the executor's processor time


class Spent(NamedTuple):
    """Time of all threads of a process until `at` [ns]: computing, and waiting for a processor (or a VM's host)."""

    at: int
    computing: int
    waiting: int


def stolen() -> int:
    """Return the time [ns] that the host of a virtual machine withheld, summed over processors."""
    with suppress(OSError, IndexError):
        return int(Path("/proc/stat").read_text().split(maxsplit=9)[8]) * 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    return 0


class Spending:
    """Samples the processor time of a process in a thread; nothing where the system does not report it."""

    def __init__(self, pid: int) -> None:
        self._threads = Path(f"/proc/{pid}/task")
        self._ends = threading.Event()
        self.samples: list[Spent] = []
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stop sampling."""
        self._ends.set()
        self._thread.join()

    def _sample(self) -> None:
        while not self._ends.wait(SAMPLE_PERIOD):
            start, computing, waiting = time.time_ns(), 0, stolen()
            for thread in self._threads.glob("[0-9]*"):
                with suppress(OSError):
                    report = (thread / "schedstat").read_text().split()
                    computing, waiting = computing + int(report[0]), waiting + int(report[1])
            self.samples.append(Spent((start + time.time_ns()) // 2, computing, waiting))

    def between(self, begin: int, end: int) -> tuple[float, float]:
        """Return the time [s] computing and waiting between the samples around `begin` and `end` [ns]."""
        if not self.samples:
            return 0.0, 0.0
        first = self.samples[max(bisect_right(self.samples, begin, key=lambda each: each.at) - 1, 0)]
        last = self.samples[min(bisect_left(self.samples, end, key=lambda each: each.at), len(self.samples) - 1)]
        return (last.computing - first.computing) * 1e-9, (last.waiting - first.waiting) * 1e-9


@dataclass
class Side:
    """Joint states of a cell for some time, with or without an attack; numbers of gaps by their cause."""

    what: str
    seconds: float = 0.0
    states: int = 0
    computed: int = 0
    waited: int = 0
    held: int = 0
    lost: int = 0
    longest: float = 0.0
    computing: float = 0.0  # [s] of the executor
    waiting: float = 0.0
    own: list[str] = field(default_factory=list)  # gaps that the machine's load did not cause
    held_up: float = 0.0  # [s] in these gaps and those of lost messages

    def __str__(self) -> str:
        share, wait = (100 * part / max(self.seconds, 1e-9) for part in (self.computing, self.waiting))
        return (f"{self.what} {self.seconds:.0f} s: {self.states} joint states, "
                f"{self.computed + self.waited + self.held + self.lost} gaps above {1e3 * GAP:.0f} ms, the longest "
                f"{1e3 * self.longest:.0f} ms; the executor waited for a processor in {self.waited}, computed in "
                f"{self.computed}, was held up in {self.held}, and {self.lost} were lost in transport; it computed "
                f"{share:.0f} % of the time and waited {wait:.0f} %")


class Gaps:
    """Counts long gaps between the stamps of received joint states; `executor` is the process that sends them."""

    def __init__(self, bus: Bus, cell: str, executor: int) -> None:
        self._received: list[tuple[int, int]] = []  # stamps [ns] and sequence numbers
        self._spending = Spending(executor)
        self._start = time.time_ns()
        self._subscribed = bus.raw_subscriber(f"{cell}/{topics.JOINT_STATES.key}", self._receive)

    def _receive(self, sample: RawSample) -> None:
        sent = decode_attachment(sample.attachment)
        if sent is not None and (stamp := stamp_of(sample.payload)):  # forged messages have no attachment
            self._received.append((stamp, sent.sequence))

    def add_to(self, side: Side) -> None:
        """Add the gaps so far, and stop counting."""
        self._subscribed.undeclare()
        self._spending.end()
        now = time.time_ns()
        spent = self._spending.between(self._start, now)
        side.computing, side.waiting = side.computing + spent[0], side.waiting + spent[1]
        side.seconds += (now - self._start) * 1e-9
        side.states += len(self._received)
        for (before, number), (after, following) in pairwise(self._received):
            gap = (after - before) * 1e-9
            side.longest = max(side.longest, gap)
            if gap <= GAP:
                continue
            computing, waiting = self._spending.between(before, after)
            report = f"{side.what}: {1e3 * gap:.0f} ms, {1e3 * computing:.0f} computing, {1e3 * waiting:.0f} waiting"
            if following - number != 1:
                side.lost += 1
            elif computing > gap / 2:
                side.computed += 1
                side.own.append(report)
            elif computing + waiting > gap / 2:
                side.waited += 1
                continue
            else:
                side.held += 1
                side.own.append(report)
            side.held_up += gap
