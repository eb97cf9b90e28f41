"""Gaps in the joint states of a cell of real processes, and whether they are the machine's load: who tests that nothing
delays the executor must distinguish them.
"""

from __future__ import annotations

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
LOOK = 0.01  # [s] between two looks at what the executor spends


class Spent(NamedTuple):
    """What the threads of a process have spent together until some time [ns]: computing, waiting for a processor.

    Waiting is also what a virtual machine does while its host has others run.
    """

    at: int
    computing: int
    waiting: int


def stolen() -> int:
    """Time [ns] in which the host of a virtual machine gave its processors to others, all of them together."""
    with suppress(OSError, IndexError):
        return int(Path("/proc/stat").read_text().split(maxsplit=9)[8]) * 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    return 0


class Spending:
    """Samples the processor time of a process in a thread; nothing where the system does not report it."""

    def __init__(self, pid: int) -> None:
        self._threads = Path(f"/proc/{pid}/task")
        self._ends = threading.Event()
        self.looks: list[Spent] = []
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Look no more."""
        self._ends.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._ends.wait(LOOK):
            began, computing, waiting = time.time_ns(), 0, 0
            for thread in self._threads.glob("[0-9]*"):
                with suppress(OSError):
                    report = (thread / "schedstat").read_text().split()
                    computing, waiting = computing + int(report[0]), waiting + int(report[1])
            waiting += stolen()
            self.looks.append(Spent((began + time.time_ns()) // 2, computing, waiting))

    def between(self, begin: int, end: int) -> tuple[float, float]:
        """Seconds that were spent computing, and waiting, from the last look before a time [ns] to the first after."""
        if not self.looks:
            return 0.0, 0.0
        first = self.looks[max(bisect_right(self.looks, begin, key=lambda look: look.at) - 1, 0)]
        last = self.looks[min(bisect_left(self.looks, end, key=lambda look: look.at), len(self.looks) - 1)]
        return (last.computing - first.computing) * 1e-9, (last.waiting - first.waiting) * 1e-9


@dataclass
class Side:
    """A cell for some time, with or without being attacked."""

    what: str
    seconds: float = 0.0
    states: int = 0
    computed: int = 0  # gaps
    waited: int = 0
    held: int = 0
    lost: int = 0
    longest: float = 0.0
    computing: float = 0.0  # [s] of the executor
    waiting: float = 0.0
    own: list[str] = field(default_factory=list)  # gaps that were not the machine's load
    held_up: float = 0.0  # [s] in gaps that were not the machine's load, those on the way among them

    @property
    def gaps(self) -> int:
        """All that are too long."""
        return self.computed + self.waited + self.held + self.lost

    def __str__(self) -> str:
        share, wait = (100 * part / max(self.seconds, 1e-9) for part in (self.computing, self.waiting))
        return (f"{self.what} {self.seconds:.0f} s: {self.states} joint states, {self.gaps} gaps above "
                f"{1e3 * GAP:.0f} ms, the longest {1e3 * self.longest:.0f} ms; the executor waited for a processor in "
                f"{self.waited}, computed in {self.computed}, was held up in {self.held}, and {self.lost} were lost on "
                f"the way; it computed {share:.0f} % of the time and waited {wait:.0f} %")


class Gaps:
    """Counts long gaps between the times at which joint states were taken, of those that arrive."""

    def __init__(self, bus: Bus, cell: str, executor: int) -> None:
        """Begin to; `executor` is the process that sends them."""
        self._taken: list[tuple[int, int]] = []  # stamp and number of each
        self._spending = Spending(executor)
        self._began = time.time_ns()
        self._subscribed = bus.raw_subscriber(f"{cell}/{topics.JOINT_STATES.key}", self._arrive)

    def _arrive(self, sample: RawSample) -> None:
        sent = decode_attachment(sample.attachment)
        if sent is not None and (stamp := stamp_of(sample.payload)):  # what is made up here says nothing of itself
            self._taken.append((stamp, sent.sequence))

    def add_to(self, side: Side) -> None:
        """Add what there was so far; no more is counted."""
        self._subscribed.undeclare()
        self._spending.end()
        now = time.time_ns()
        spent = self._spending.between(self._began, now)
        side.computing, side.waiting = side.computing + spent[0], side.waiting + spent[1]
        side.seconds += (now - self._began) * 1e-9
        side.states += len(self._taken)
        for (before, number), (after, following) in pairwise(self._taken):
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
