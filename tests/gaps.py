"""Gaps in the joint states of a cell of real processes, and whether the load of the machine caused them."""

import os
import threading
import time
from bisect import bisect_left, bisect_right
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from common import topics
from common.transport.bus import Bus
from common.transport.codec import decode_attachment
from common.transport.session import RawSample
from recording.sample import stamp_of

GAP = 0.05  # [s] between two joint states
SAMPLE_PERIOD = 0.01  # [s] of the executor's processor time


def stolen() -> int:
    """Return the time [ns] that the host of a virtual machine withheld, summed over processors."""
    with suppress(OSError, IndexError):
        return int(Path("/proc/stat").read_text().split(maxsplit=9)[8]) * 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    return 0


class ProcessorTime:
    """Samples the processor time of a process in a thread; nothing where the system does not report it."""

    def __init__(self, pid: int) -> None:
        self._threads = Path(f"/proc/{pid}/task")
        self._ends = threading.Event()
        self._samples: list[tuple[int, int, int]] = []  # time, computing, waiting for a processor [ns]
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
            self._samples.append(((start + time.time_ns()) // 2, computing, waiting))

    def between(self, begin: int, end: int) -> tuple[float, float]:
        """Return the time [s] computing and waiting between the samples around `begin` and `end` [ns]."""
        if not self._samples:
            return 0.0, 0.0
        first = self._samples[max(bisect_right(self._samples, (begin, 0, 0)) - 1, 0)]
        last = self._samples[min(bisect_left(self._samples, (end, 0, 0)), len(self._samples) - 1)]
        return (last[1] - first[1]) * 1e-9, (last[2] - first[2]) * 1e-9


@dataclass
class Side:
    """Joint states of a cell for some time, with or without an attack."""

    what: str
    seconds: float = 0.0
    states: int = 0
    waited: int = 0  # gaps in which the executor waited for a processor
    lost: int = 0  # gaps of messages lost in transport
    own: list[str] = field(default_factory=list)  # all other gaps
    held_up: float = 0.0  # [s] in lost and own gaps

    def __str__(self) -> str:
        return (f"{self.what} {self.seconds:.0f} s: {self.states} joint states; gaps above {1e3 * GAP:.0f} ms: "
                f"{self.waited} while the executor waited for a processor, {self.lost} by lost messages, "
                f"{len(self.own)} others")


class Gaps:
    """Counts long gaps between the stamps of received joint states; `executor` is the process that sends them."""

    def __init__(self, bus: Bus, cell: str, executor: int) -> None:
        self._received: list[tuple[int, int]] = []  # stamps [ns] and sequence numbers
        self._processor = ProcessorTime(executor)
        self._start = time.time_ns()
        self._subscribed = bus.raw_subscriber(f"{cell}/{topics.JOINT_STATES.key}", self._receive)

    def _receive(self, sample: RawSample) -> None:
        sent = decode_attachment(sample.attachment)
        if sent is not None and (stamp := stamp_of(sample.payload)):  # forged messages have no attachment
            self._received.append((stamp, sent.sequence))

    def add_to(self, side: Side) -> None:
        """Add the gaps so far, and stop counting."""
        self._subscribed.undeclare()
        self._processor.end()
        side.seconds += (time.time_ns() - self._start) * 1e-9
        side.states += len(self._received)
        for (before, number), (after, following) in pairwise(self._received):
            gap = (after - before) * 1e-9
            if gap <= GAP:
                continue
            computing, waiting = self._processor.between(before, after)
            if following - number == 1 and computing <= gap / 2 < computing + waiting:
                side.waited += 1
                continue
            side.held_up += gap
            if following - number != 1:
                side.lost += 1
            else:
                side.own.append(f"{side.what}: {1e3 * gap:.0f} ms, {1e3 * computing:.0f} computing, "
                                f"{1e3 * waiting:.0f} waiting")
